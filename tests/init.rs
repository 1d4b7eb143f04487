//! `calmwalk init` for a campaign of one's own, and the recipes of docs/first-campaign.md.

use std::fs;
use std::path::Path;

use atoms::extxyz::{ExtxyzValue, Frame};
use atoms::read_extxyz;
use serde_json::Value;

use crate::common::{calmwalk, config, refuse, stderr, succeed, write_frames};

const CONFIG: &str = "own/campaign.toml";

/// Writes the model into `own`, and two seed structures beside it.
fn prepare(here: &Path) {
    fs::create_dir(here.join("own")).unwrap();
    fs::copy(config("data/al_eam_1l/kokkos.npz"), here.join("own/model.npz")).unwrap();
    let seeds = read_extxyz(&config("data/aluminium_seeds.extxyz")).unwrap();
    let wanted =
        |frame: &&Frame| ["fcc-100", "slab-111"].map(ExtxyzValue::from).contains(&frame.info["name"]);
    write_frames(&here.join("seeds.extxyz"), &seeds.iter().filter(wanted).cloned().collect::<Vec<_>>());
}

/// The options of `init own`, with labels of this kind and further options.
fn options(label: &str, more: &[&str]) -> Vec<String> {
    let artifact = config("data/al_eam_1l/gmm_artifacts.npz").display().to_string();
    let given = ["init", "own", "--model", "own/model.npz", "--artifact", &artifact];
    let given = given.into_iter().chain(["--structures", "seeds.extxyz", "--label", label]);
    given.chain(more.iter().copied()).map(str::to_owned).collect()
}

fn teacher() -> String {
    config("data/Al_mm.eam.fs").display().to_string()
}

fn written(here: &Path) -> String {
    fs::read_to_string(here.join(CONFIG)).unwrap()
}

/// Names of the keys, also of those that are commented out.
fn keys(text: &str) -> Vec<&str> {
    let is_key = |name: &&str| !name.is_empty() && name.chars().all(|c| c.is_ascii_lowercase() || c == '_');
    let lines = text.lines().map(|line| line.strip_prefix("# ").unwrap_or(line).trim_start());
    lines.filter_map(|line| line.split_once(" = ").map(|(name, _)| name)).filter(is_key).collect()
}

#[test]
fn a_campaign_of_ones_own_is_valid_as_it_stands() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let teacher = teacher();
    for more in [&[][..], &["--full"]] {
        let options = options("potential", &[&["--label-source", &teacher][..], more].concat());
        let printed = succeed(here, &options);
        assert!(
            printed.contains("for 2 seed structures; next:\n  calmwalk validate own/campaign.toml"),
            "{printed}"
        );
        let text = written(here);
        let seeds = here.join("seeds.extxyz");
        assert!(text.contains("\nmodel = \"model.npz\" "), "{text}");
        assert!(text.contains(&format!("\nfiles = [\"{}\"] ", seeds.display())), "{text}");
        assert!(text.contains(&format!("kind = \"eam_fs\", file = \"{teacher}\"")), "{text}");
        assert!(
            text.contains("\ntau = 0.3 ") && text.contains("\ntemperatures = [300.0, 1000.0, 2000.0] "),
            "{text}"
        );
        assert!(text.contains("zbl = { rule = \"uniform\", ") && text.contains("(usual: 10 to "), "{text}");
        let in_force = text.lines().filter(|line| !line.is_empty() && !line.starts_with(['#', '[']));
        let number = in_force.filter(|line| !line.starts_with(' ')).count();
        assert!((15..=24).contains(&number), "{number} keys:\n{text}");
        let shown = succeed(here, ["validate", CONFIG]);
        assert!(shown.contains("is a valid campaign"), "{shown}");
        let message = refuse(here, &options);
        assert!(message.contains("own/campaign.toml already exists"), "{message}");
        assert_eq!(written(here), text);
        if !more.is_empty() {
            let demo = fs::read_to_string(config("aluminium.toml")).unwrap();
            let listed = keys(&text);
            let left_out: Vec<_> = keys(&demo).into_iter().filter(|key| !listed.contains(key)).collect();
            assert!(left_out.is_empty(), "{left_out:?}");
            assert!(text.contains("\n#   replay = [\"training_frames.extxyz\"] "), "{text}");
        }
        for name in ["campaign.toml", "campaign.schema.json"] {
            fs::remove_file(here.join("own").join(name)).unwrap();
        }
    }
}

#[test]
fn values_that_only_the_user_has_are_refused_until_they_are_there() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    for kind in ["abinit", "ase", "command", "cp2k", "espresso", "gpaw", "vasp"] {
        let printed = succeed(here, options(kind, &[]));
        let text = written(here);
        let output = calmwalk(here, ["validate", CONFIG]);
        let message = stderr(&output);
        let unfilled = text.matches("\"FILL IN: ").count();
        assert_eq!(printed.contains("that begin with FILL IN:"), unfilled > 0, "{printed}");
        assert_eq!(message.matches(" is not filled in yet; expected ").count(), unfilled, "{message}");
        // Programs that this host lacks are not the fault of the file.
        let is_right = output.status.code() == Some(0) || message.contains(&format!("label.method.{kind}"));
        assert!(is_right, "{message}");
        if kind == "vasp" {
            let line = 1 + text.lines().position(|line| line.starts_with("version = ")).unwrap();
            let expected = format!(
                "own/campaign.toml:{line}: label.method.vasp.version is not filled in yet; expected the version"
            );
            assert!(unfilled == 2 && message.contains(&expected), "{message}");
            assert!(text.contains("\nelements = [\"Al\"] "), "{text}");
            let message = refuse(here, ["label-file", "seeds.extxyz", "--config", CONFIG]);
            assert!(message.contains("label.method.vasp.version is not filled in yet"), "{message}");
        }
        for name in ["campaign.toml", "campaign.schema.json"] {
            fs::remove_file(here.join("own").join(name)).unwrap();
        }
    }
    fs::write(here.join("own/label.sh"), "exit 5\n").unwrap();
    succeed(here, options("command", &["--label-source", "own/label.sh"]));
    let text = written(here);
    assert!(
        text.contains("\ncommand = [\"sh\", \"label.sh\"] ") && text.contains("\nfiles = [\"label.sh\"] "),
        "{text}"
    );
    fs::write(here.join(CONFIG), text.replace("\"FILL IN: ", "\"")).unwrap();
    succeed(here, ["validate", CONFIG]);
}

#[test]
fn what_is_wrong_is_said_and_nothing_is_written() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let oxygen = "2\nLattice=\"4 0 0 0 4 0 0 0 4\" Properties=species:S:1:pos:R:3\nO 0 0 0\nO 0 0 1.3\n";
    fs::write(here.join("oxygen.extxyz"), oxygen).unwrap();
    fs::write(here.join("model.pt"), "").unwrap();
    let teacher = teacher();
    let refused = |arguments: &[&str], words: &[&str]| {
        let message = refuse(here, ["init", "new"].iter().chain(arguments));
        for word in words {
            assert!(message.contains(word), "{message}\nexpected {word}");
        }
        assert!(!here.join("new").exists());
    };
    let model = ["--model", "own/model.npz", "--structures"];
    refused(&model[..2], &["--structures, --label missing", "on a terminal"]);
    refused(&["--full"], &["--model, --structures, --label missing"]);
    let seeds = [&model[..], &["seeds.extxyz", "--label"]].concat();
    refused(&[&seeds[..], &["potential"]].concat(), &["--label-source missing"]);
    refused(&[&seeds[..], &["qe"]].concat(), &["abinit", "potential"]);
    let labels = ["--label", "potential", "--label-source"];
    let by = |file: &str, words: &[&str]| {
        refused(&[&model[..], &["seeds.extxyz"], &labels, &[file]].concat(), words);
    };
    by("own/model.npz", &["--label-source: own/model.npz is the model itself"]);
    by("model.pt", &["model.pt is no potential of a known format", ".eam.alloy"]);
    by("none.sw", &["--label-source: cannot read none.sw: "]);
    let of_oxygen = [&model[..], &["oxygen.extxyz"], &labels, &[teacher.as_str()]].concat();
    refused(
        &of_oxygen,
        &["nothing is written", "new/campaign.toml:", "seed_structures.files: ", "oxygen.extxyz"],
    );
}

/// One crystal and a model of one element: cell-biased walks from four volumes at constant pressure.
#[test]
fn a_model_of_one_phase_gets_the_collection_of_the_paper() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let crystal = &read_extxyz(&here.join("seeds.extxyz")).unwrap()[..1];
    write_frames(&here.join("seeds.extxyz"), crystal);
    let teacher = teacher();
    for more in [&["--full"][..], &[]] {
        let options = options("potential", &[&["--label-source", &teacher][..], more].concat());
        succeed(here, options);
        let text = written(here);
        let lines = [
            "min_atoms = 108 ",
            "barostat = { pressure = 1.0 } ",
            "cell_bias = {} ",
            "start_volumes = [0.94, 0.97, 1.03, 1.06] ",
            "max_per_walk = 50 ",
            "max_structures = 200 ",
            "update = \"per_walk\" ",
            "walks_per_round = 1 ",
        ];
        for line in lines {
            assert!(text.contains(&format!("\n{line}")), "{line}: {text}");
        }
        assert!(!text.contains("\nvolume_ramp") && !text.contains("\ncovariance_update"), "{text}");
        assert!(succeed(here, ["validate", CONFIG]).contains("is a valid campaign"));
        if more.is_empty() {
            // Shorter, and of a smaller crystal.
            let short = text.replace("min_atoms = 108", "min_atoms = 32");
            let short = short.replace("biased_steps = 100000", "biased_steps = 30\nreference_steps = 20");
            let short = short.replace("\ntau = ", "\nequilibration_steps = 10\ntau = ");
            fs::write(here.join(CONFIG), short).unwrap();
            succeed(here, ["run", "--in-process", CONFIG]);
            let status: Value = serde_json::from_str(&succeed(here, ["status", "own", "--json"])).unwrap();
            let walks = status["walks"].as_array().unwrap();
            let constant = |walk: &Value| walk["conditions"]["constant_pressure"].clone();
            let biased = walks.iter().filter(|walk| walk["origin"] == "biased");
            let volumes: Vec<_> =
                biased.map(|walk| constant(walk)["start_volume"].as_f64().unwrap()).collect();
            assert_eq!(volumes, [0.94, 0.97, 1.03, 1.06], "{status}");
            assert!(walks.iter().all(|walk| constant(walk)["cell_bias"] == true), "{status}");
        }
        for name in ["campaign.toml", "campaign.schema.json"] {
            fs::remove_file(here.join("own").join(name)).unwrap();
        }
    }
}

#[test]
fn without_an_artifact_the_mixture_of_the_model_stays_as_it_is() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let (model, teacher) = ("own/model.npz", teacher());
    let given = ["init", "own", "--model", model, "--structures", "seeds.extxyz"];
    succeed(here, given.iter().chain(&["--label", "potential", "--label-source", &teacher]));
    assert!(written(here).contains("\nupdate = \"never\" "));
    succeed(here, ["validate", CONFIG]);
}

/// The recipes with two seed structures and short walks.
#[test]
fn the_recipes_of_the_first_campaign_work() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    succeed(here, options("potential", &["--label-source", &teacher()]));
    let text = written(here);
    let steps = "biased_steps = 15000";
    assert!(text.contains(steps));
    let text =
        text.replace(steps, "equilibration_steps = 20\nbiased_steps = 100") + "\n[budget]\nlabels = 4\n";
    fs::write(here.join(CONFIG), text).unwrap();
    succeed(here, ["run", "--in-process", CONFIG]);
    let status: Value = serde_json::from_str(&succeed(here, ["status", "own", "--json"])).unwrap();
    assert_eq!(status["finished"], true, "{status}");
    let known = config("data/al_eam_1l/seed_frames.extxyz").display().to_string();
    let printed = succeed(here, ["import", "own", &known]);
    assert!(printed.starts_with("imported ") && printed.contains("of protocol 'potential'"), "{printed}");
    succeed(here, ["export", "own", "--output", "dataset.extxyz", "--imported"]);
}

/// The recipe of a warm start, with few training data, two seed structures and short walks.
#[test]
fn the_recipe_of_a_warm_start_works() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    prepare(here);
    let known = read_extxyz(&config("data/al_eam_1l/seed_frames.extxyz")).unwrap();
    write_frames(&here.join("known.extxyz"), &known[..20]);
    succeed(here, ["calm", "build", "--model", "own/model.npz", "known.extxyz", "--output", "warm.npz"]);
    let teacher = teacher();
    let given = ["init", "own", "--model", "own/model.npz", "--artifact", "warm.npz", "--structures"];
    let labels = ["seeds.extxyz", "--label", "potential", "--label-source", &teacher];
    succeed(here, given.iter().chain(&labels));
    let text = written(here);
    assert!(text.contains("warm.npz\"") && !text.contains("\nupdate = \"never\""), "{text}");
    let steps = "biased_steps = 15000";
    assert!(text.contains(steps));
    let text = text.replace(steps, "equilibration_steps = 20\nbiased_steps = 100");
    let with_labels = |labels: u32| {
        fs::write(here.join(CONFIG), format!("{text}\n[budget]\nlabels = {labels}\n")).unwrap();
        succeed(here, ["run", "--in-process", CONFIG]);
        let status: Value = serde_json::from_str(&succeed(here, ["status", "own", "--json"])).unwrap();
        assert_eq!(status["finished"], true, "{status}");
        let [found, imported] = ["accepted", "imported"].map(|key| status["candidates"][key].as_u64());
        (found.unwrap(), imported.or(status["imported"].as_u64()))
    };
    // The first run creates the campaign, and the second goes on with what it knows.
    let (before, _) = with_labels(2);
    let printed = succeed(here, ["import", "own", "known.extxyz"]);
    assert!(printed.starts_with("imported 20 "), "{printed}");
    let (after, imported) = with_labels(6);
    assert!(before == 1 && after > before && imported == Some(20), "{before} {after} {imported:?}");
    succeed(here, ["export", "own", "--output", "dataset.extxyz", "--imported"]);
    let frames = read_extxyz(&here.join("dataset.extxyz")).unwrap();
    assert_eq!(frames.len() as u64, after + 20);
    assert!(frames.iter().all(|frame| frame.labels().unwrap().forces.is_some()));
}
