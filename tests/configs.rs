//! Every file of `configs/` but `silicon-dft.toml` runs here, and its results can be read. The demos run with shorter walks and trainings,
//! those for foundation models with a small model and three seed structures. `CALMWALK_WHOLE_DEMOS=1 cargo test --test integration
//! configs::` runs the demos as they stand.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use atoms::extxyz::{ExtxyzValue, Frame};
use atoms::{Evaluation, NeighbourList, Potential, ShortestDistances, read_extxyz, shortest_distance};
use potentials::{Eam, EamStyle, StillingerWeber};
use serde_json::Value;

use crate::common::{config, demo, deviation, refuse, stderr, succeed, write_frames};

/// Writes a demo with these lines replaced: each is given by its begin, and by what that becomes. With `CALMWALK_WHOLE_DEMOS` the demo
/// stays as it is. Returns the path of the configuration.
fn shorter(directory: &Path, name: &str, changes: &[[&str; 2]]) -> PathBuf {
    if runs_whole_demos() {
        return config(name);
    }
    let path = directory.join(name);
    fs::write(&path, changed(name, changes)).unwrap();
    path
}

fn runs_whole_demos() -> bool {
    std::env::var_os("CALMWALK_WHOLE_DEMOS").is_some()
}

/// The text of a demo with these lines replaced.
fn changed(name: &str, changes: &[[&str; 2]]) -> String {
    changes.iter().fold(demo(name), |text, [before, after]| {
        let [before, after] = [before, after].map(|begin| format!("\n{begin}"));
        assert!(text.contains(&before), "{name} has no line {before}");
        text.replacen(&before, &after, 1)
    })
}

/// Runs a demo with this number of biased walks to its end, and checks its results. Returns its labelled frames, including
/// control frames. No two atoms may be closer than `least` Å.
fn campaign(directory: &Path, file: &Path, walks: usize, least: f64) -> Vec<Frame> {
    // By default the campaign would be written beside its configuration, in the repository.
    let here = directory.join("campaign").display().to_string();
    let summary = succeed(directory, ["run", &file.display().to_string(), "--directory", &here]);
    assert!(summary.contains(&format!("walks            {walks} biased")), "{summary}");
    let status: Value = serde_json::from_str(&succeed(directory, ["status", &here, "--json"])).unwrap();
    assert_eq!(status["finished"], true, "{status}");
    let labels = &status["labels"];
    assert_eq!((&labels["queued"], &labels["leased"], &labels["failed"]), (&0.into(), &0.into(), &0.into()));
    let walks = status["walks"].as_array().unwrap();
    let biased: Vec<_> = walks.iter().filter(|walk| walk["origin"] == "biased").collect();
    let collected = biased.iter().filter(|walk| walk["accepted"].as_u64() > Some(0)).count();
    assert!(2 * collected > biased.len(), "most walks find something: {status}");
    assert!(
        biased.iter().all(|walk| walk["state"] == "quota_reached" || walk["state"] == "completed"),
        "{status}"
    );
    let accepted = status["candidates"]["accepted"].as_u64().unwrap();
    let control = status["candidates"]["control"].as_u64().unwrap();

    let output = directory.join("dataset.extxyz");
    let arguments = ["export", &here, "--control", "--output", &output.display().to_string()];
    succeed(directory, arguments);
    let frames = read_extxyz(&output).unwrap();
    assert_eq!(frames.len() as u64, accepted + control);
    check_frames(&frames, accepted as usize, least);
    read_by_ase(&output, &frames);
    frames
}

fn text<'a>(frame: &'a Frame, key: &str) -> &'a str {
    frame.info[key].text().unwrap()
}

/// Structures are physical, and those of biased walks are new to the model.
fn check_frames(frames: &[Frame], accepted: usize, least: f64) {
    let mut neighbours = NeighbourList::new(6.0, 0.0);
    let mut biased = 0;
    for frame in frames {
        neighbours.update(&frame.structure).unwrap();
        let (_, _, shortest) = shortest_distance(&frame.structure, &neighbours).unwrap();
        assert!(shortest > least, "{shortest} Å");
        let volume: f64 = frame.info["relative_volume"].number().unwrap();
        assert!((0.88..=1.4).contains(&volume), "V/V₀ = {volume}");
        if text(frame, "origin") == "biased" {
            biased += 1;
            let gamma = frame.arrays["gamma"].reals().unwrap();
            assert!(gamma.iter().any(|gamma| *gamma > 1.0), "{gamma:?}");
        }
    }
    assert_eq!(biased, accepted);
}

/// The labels equal evaluations by the configured potential.
fn check_labels(frames: &[Frame], potential: &mut dyn Potential) {
    let mut neighbours = NeighbourList::new(potential.cutoff(), 0.0);
    let mut expected = Evaluation::default();
    for frame in frames {
        neighbours.update(&frame.structure).unwrap();
        potential.evaluate(&frame.structure, &neighbours, &mut expected).unwrap();
        let labels = frame.labels().unwrap();
        let close = |found: &[f64], expected: &[f64]| deviation(found, expected) < 1e-12;
        assert!(close(&[labels.energy.unwrap()], &[expected.energy()]));
        assert!(close(labels.forces.unwrap().as_flattened(), expected.forces.as_flattened()));
        let stress = expected.stress(&frame.structure).unwrap();
        assert!(close(labels.stress.unwrap().as_flattened(), stress.as_flattened()));
    }
}

/// Checks that ASE reads the same structures and labels.
fn read_by_ase(path: &Path, frames: &[Frame]) {
    let Some(python) = std::env::var_os("CALMWALK_PYTHON") else {
        eprintln!("CALMWALK_PYTHON is not set: no comparison with ASE");
        return;
    };
    let script = "import json, sys, ase.io\n\
                  frames = ase.io.read(sys.argv[1], ':')\n\
                  print(json.dumps([dict(symbols=list(a.symbols), positions=a.positions.ravel().tolist(),\n\
                      cell=a.cell.array.ravel().tolist(), energy=a.get_potential_energy(),\n\
                      forces=a.get_forces().ravel().tolist(), stress=a.get_stress(voigt=False).ravel().tolist(),\n\
                      gamma=a.arrays['gamma'].tolist(), walk=int(a.info['walk'])) for a in frames]))";
    let output = Command::new(python).args(["-c", script]).arg(path).env("PYTHONUTF8", "1").output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let read: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(read.len(), frames.len());
    for (found, frame) in read.iter().zip(frames) {
        let labels = frame.labels().unwrap();
        let numbers = |key: &str| -> Vec<f64> { serde_json::from_value(found[key].clone()).unwrap() };
        let symbols: Vec<_> = frame.structure.species.iter().map(|species| species.symbol()).collect();
        assert_eq!(found["symbols"], serde_json::json!(symbols));
        assert_eq!(numbers("positions"), frame.structure.positions.as_flattened());
        assert_eq!(numbers("cell"), frame.structure.cell.0.as_flattened());
        assert_eq!(found["energy"].as_f64(), labels.energy);
        assert_eq!(numbers("forces"), labels.forces.unwrap().as_flattened());
        // ASE converts to Voigt components, which symmetrises the stress.
        assert!(deviation(&numbers("stress"), labels.stress.unwrap().as_flattened()) < 1e-12);
        assert_eq!(numbers("gamma"), frame.arrays["gamma"].reals().unwrap());
    }
}

#[test]
fn aluminium_runs() {
    let directory = tempfile::tempdir().unwrap();
    let changes = [
        ["biased_steps = 2000 ", "biased_steps = 800 "],
        ["method = { native = { epochs = 10,", "method = { native = { epochs = 4,"],
    ];
    let file = shorter(directory.path(), "aluminium.toml", &changes);
    let frames = campaign(directory.path(), &file, 24, 1.2);
    let mut potential = Eam::load_as(config("data/Al_mm.eam.fs"), EamStyle::FinnisSinclair).unwrap();
    check_labels(&frames, &mut potential);
    check_loop(directory.path(), &file);
}

/// Each version has smaller errors of the forces on the hot crystal and the liquid than the first model, in the whole demo also than the
/// version before. The summary shows the errors on all data sets.
fn check_loop(directory: &Path, file: &Path) {
    let here = directory.join("campaign").display().to_string();
    let figures = |number: u32| -> Value {
        let shown = succeed(directory, ["versions", &here, "show", &number.to_string(), "--json"]);
        serde_json::from_str::<Value>(&shown).unwrap()["figures"]["sets"].take()
    };
    let sets: Vec<_> = (1..=3).map(figures).collect();
    let names: Vec<_> = sets[0].as_array().unwrap().iter().map(|set| set["name"].as_str().unwrap()).collect();
    assert_eq!((names.len(), names.iter().collect::<BTreeSet<_>>().len()), (7, 7), "{names:?}");
    for name in ["hot", "liquid"] {
        let error = |sets: &Value, model: &str| {
            let set = sets.as_array().unwrap().iter().find(|set| set["name"] == name).unwrap();
            set[model]["force_mae"].as_f64().unwrap()
        };
        let mut errors = vec![error(&sets[0], "first")];
        errors.extend(sets.iter().map(|sets| error(sets, "version")));
        assert!(errors[1..].iter().all(|of_version| *of_version < errors[0]), "{name}: {errors:?}");
        let fall = errors.windows(2).all(|pair| pair[1] < pair[0]);
        assert!(fall || !runs_whole_demos(), "{name}: {errors:?}");
    }
    let summary = succeed(directory, ["run", &file.display().to_string(), "--directory", &here]);
    assert!(names.iter().all(|name| summary.contains(name)), "{names:?}\n{summary}");
}

#[test]
fn silicon_runs() {
    let directory = tempfile::tempdir().unwrap();
    let changes = [["biased_steps = 2000 ", "biased_steps = 800 "]];
    let file = shorter(directory.path(), "silicon.toml", &changes);
    let frames = campaign(directory.path(), &file, 8, 1.2);
    check_labels(&frames, &mut StillingerWeber::load(config("data/Si.sw")).unwrap());
}

#[test]
fn nickel_aluminium_hydrogen_runs() {
    let directory = tempfile::tempdir().unwrap();
    let changes = [
        ["biased_steps = 2000 ", "biased_steps = 400 "],
        ["equilibration_steps = 200 ", "equilibration_steps = 40 "],
    ];
    let file = shorter(directory.path(), "nickel-aluminium-hydrogen.toml", &changes);
    // Three temperatures for 8 seed structures, and two more for the 7 with hydrogen. The configuration limits the distance
    // of two hydrogen atoms.
    let frames = campaign(directory.path(), &file, 38, 0.6);
    let mut potential = Eam::load_as(config("data/NiAlH_jea.eam.alloy"), EamStyle::Alloy).unwrap();
    check_labels(&frames, &mut potential);
    check_conditions(&frames);
}

/// Checks that the frames cover all temperatures, both directions of the volume ramp, and bonds of hydrogen.
fn check_conditions(frames: &[Frame]) {
    let numbers =
        |key: &str| frames.iter().map(|frame| frame.info[key].number().unwrap()).collect::<Vec<_>>();
    let temperatures: BTreeSet<_> = numbers("temperature").into_iter().map(|t| t as u32).collect();
    assert_eq!(temperatures, BTreeSet::from([300, 450, 600, 750, 900]));
    let volumes = numbers("relative_volume");
    assert!(volumes.iter().any(|v| *v < 0.99) && volumes.iter().any(|v| *v > 1.01), "{volumes:?}");
    let mut neighbours = NeighbourList::new(3.0, 0.0);
    let mut bonded = BTreeSet::new();
    for Frame { structure, .. } in frames {
        neighbours.update(structure).unwrap();
        let shortest = ShortestDistances::from_neighbours(structure, &neighbours);
        let bonds = shortest.iter().filter(|(pair, distance)| *distance < 1.3 * pair.covalent_radii());
        bonded.extend(bonds.map(|(pair, _)| pair.to_string()));
    }
    assert!(["H-H", "H-Ni"].iter().all(|pair| bonded.contains(*pair)), "{bonded:?}");
}

#[test]
fn unbiased_dynamics_run_as_they_stand() {
    let directory = tempfile::tempdir().unwrap();
    succeed(directory.path(), ["md", &config("md-aluminium.toml").display().to_string()]);
    let frames = read_extxyz(&directory.path().join("md-aluminium.extxyz")).unwrap();
    assert_eq!(frames.len(), 21);
    let mut potential = Eam::load_as(config("data/Al_mm.eam.fs"), EamStyle::FinnisSinclair).unwrap();
    check_labels(&frames, &mut potential);
}

#[test]
fn the_foundation_expansion_runs_once_its_files_are_there() {
    let text = foundation_campaign("foundation-expansion.toml", 3);
    assert!(text.contains("\nbiased_steps = 15000") && text.contains("\n# equilibration_steps = 500"));
}

#[test]
fn the_foundation_campaign_runs_once_its_files_are_there() {
    let text = foundation_campaign("foundation-campaign.toml", 5 * 3);
    assert!(text.contains("\ncovariance_update = \"additive\"") && text.contains("\n[[walks]]"));
}

/// Runs a configuration for foundation models with a small model, three seed structures and short walks. Returns its text.
fn foundation_campaign(name: &str, walks: usize) -> String {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let text = fs::read_to_string(config(name)).unwrap();
    fs::write(here.join("campaign.toml"), &text).unwrap();
    let message = refuse(here, ["validate", "campaign.toml"]);
    assert!(message.contains("potential.model: model/kokkos.npz: cannot be read"), "{message}");
    for (file, from) in [
        ("model/kokkos.npz", "data/al_eam_1l/kokkos.npz"),
        ("model/gmm_artifacts.npz", "data/al_eam_1l/gmm_artifacts.npz"),
        ("reference/kokkos.npz", "data/al_eam_1l/kokkos.npz"),
    ] {
        let place = here.join(file);
        fs::create_dir_all(place.parent().unwrap()).unwrap();
        fs::copy(config(from), place).unwrap();
    }
    let seeds = read_extxyz(&config("data/aluminium_seeds.extxyz")).unwrap();
    let chosen = ["fcc-100", "vacancy", "slab-111"].map(ExtxyzValue::from);
    let seeds: Vec<_> = seeds.into_iter().filter(|frame| chosen.contains(&frame.info["name"])).collect();
    write_frames(&here.join("seeds.extxyz"), &seeds);
    succeed(here, ["validate", "campaign.toml"]);
    let short = text.replace("\nbiased_steps = 15000", "\nbiased_steps = 60");
    let short = short.replace("\n# equilibration_steps = 500", "\nequilibration_steps = 20");
    fs::write(here.join("campaign.toml"), short).unwrap();
    let summary = succeed(here, ["run", "campaign.toml"]);
    assert!(summary.contains(&format!("walks            {walks} biased")), "{summary}");
    let status: Value = serde_json::from_str(&succeed(here, ["status", "campaign", "--json"])).unwrap();
    assert_eq!(status["finished"], true, "{status}");
    text
}

/// With walks of 150 instead of 100,000 biased steps.
fn driven_walks(name: &str, version_of_each: bool) {
    let directory = tempfile::tempdir().unwrap();
    let changes = [
        ["biased_steps = 100000\n", "biased_steps = 150\n"],
        ["reference_steps = 5000\n", "reference_steps = 40\n"],
        ["equilibration_steps = 500\n", "equilibration_steps = 30\n"],
    ];
    fs::write(directory.path().join("c.toml"), changed(name, &changes)).unwrap();
    succeed(directory.path(), ["run", "c.toml", "--directory", "here"]);
    let status: Value =
        serde_json::from_str(&succeed(directory.path(), ["status", "here", "--json"])).unwrap();
    let walks = status["walks"].as_array().unwrap();
    let volumes: Vec<_> = walks.iter().map(|walk| walk["relative_volume"].as_f64().unwrap()).collect();
    assert!(walks.iter().all(|walk| walk["state"] == "completed" && walk["step"] == 180), "{status}");
    assert!(volumes.iter().all(|volume| (0.75..=1.3).contains(volume)), "{volumes:?}");
    let starts: Vec<_> =
        walks.iter().map(|walk| walk["conditions"]["constant_pressure"]["start_volume"].as_f64()).collect();
    assert_eq!(starts, [0.94, 0.97, 1.03, 1.06].map(Some));
    // With a mixture of its own, each walk begins with that of the potential.
    let seeds: BTreeSet<_> = walks.iter().map(|walk| walk["seed_structure"].to_string()).collect();
    assert_eq!(seeds.len(), if version_of_each { 4 } else { 1 });
}

#[test]
fn driven_walks_in_aluminium_run() {
    driven_walks("al-collect.toml", true);
    driven_walks("al-collect-shared.toml", false);
}

#[test]
fn driven_walks_in_silicon_run() {
    driven_walks("si-collect.toml", true);
}

/// With 400 instead of 22,000 steps.
#[test]
fn the_unbiased_collections_run() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    for (element, atoms) in [("al", 108), ("si", 128)] {
        for temperature in [300, 500] {
            let name = format!("md-{element}-{temperature}");
            let text = demo(&format!("{name}.toml"));
            assert!(text.contains("\nsteps = 22000 ") && text.contains("\nbarostat = { pressure = 1.0 }\n"));
            fs::write(here.join("md.toml"), text.replace("\nsteps = 22000 ", "\nsteps = 400 ")).unwrap();
            succeed(here, ["md", "md.toml"]);
            let frames = read_extxyz(&here.join(format!("{name}.extxyz"))).unwrap();
            let volumes: Vec<_> = frames.iter().map(|frame| frame.structure.cell.volume()).collect();
            assert_eq!((frames.len(), frames[0].structure.len()), (3, atoms));
            assert!(volumes[1] != volumes[0], "{volumes:?}");
            assert!(frames.iter().all(|frame| frame.labels().unwrap().stress.is_some()));
        }
    }
}

#[test]
fn every_file_of_configs_is_run_by_a_test() {
    // `cargo test --test external dft::` runs silicon-dft.toml, and `batch_systems` campaigns with lsf.toml and pbs.toml.
    let run = [
        "al-collect-shared.toml",
        "al-collect.toml",
        "aluminium.toml",
        "foundation-campaign.toml",
        "foundation-expansion.toml",
        "lsf.toml",
        "md-al-300.toml",
        "md-al-500.toml",
        "md-aluminium.toml",
        "md-si-300.toml",
        "md-si-500.toml",
        "nickel-aluminium-hydrogen.toml",
        "pbs.toml",
        "si-collect.toml",
        "silicon-dft.toml",
        "silicon.toml",
    ];
    let entries =
        fs::read_dir(config("")).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut files: Vec<_> = entries.filter(|name| name.ends_with(".toml")).collect();
    files.sort();
    assert_eq!(files, run);
}
