//! Wrong configurations and files: exit code 2, a message with the place, the value found and the one expected, and no
//! output.

use std::fs;
use std::io::{Cursor, Read, Write};

use npyz::npz::{NpzArchive, NpzWriter, file_name_from_array_name};

use crate::common::config_tester::{ConfigTester, changed, line, without_refit};
use crate::common::{calmwalk, config, refuse, stderr, succeed};

const MODEL: &str = "data/al_eam_1l/kokkos.npz";
const ARTIFACT: &str = "data/al_eam_1l/gmm_artifacts.npz";

#[test]
fn every_wrong_key_is_named_with_its_line() {
    let tester = ConfigTester::new();
    let distances = "# min_distances = { rule = \"per_pair\", bonded = 0.75, nonbonded = 0.65, bond_cutoff = 1.3, pairs = {} }";
    let langevin = "# thermostat = { langevin = { friction = 0.01 } }";
    for (from, to, expected) in [
        ("temperature = 600.0", "temprature = 600.0", "unknown key `temprature`, expected one of"),
        ("temperature = 600.0", "temprature = 600.0", "did you mean `temperature`?"),
        ("[guard]", "[gaurd]", "did you mean `guard`?"),
        ("temperature = 600.0", "temperature = -600.0", "found -600, expected a finite number above 0"),
        ("temperature = 600.0", "temperature = nan", "found NaN, expected a finite number above 0"),
        ("temperature = 600.0", "temperature = inf", "found inf, expected a finite number above 0"),
        ("temperature = 600.0", "temperature = \"600\"", "string \"600\", expected a number"),
        ("temperature = 600.0", "temperature = = 600", "extra `=`"),
        ("temperature = 600.0", "temperature = 600.0\ntemperature = 600.0", "duplicate key"),
        ("biased_steps = 2000 ", "biased_steps = 0 ", "integer `0`, expected a whole number above 0"),
        ("biased_steps = 2000 ", "biased_steps = -1 ", "integer `-1`, expected a whole number above 0"),
        (
            "biased_steps = 2000 ",
            "biased_steps = 20.5 ",
            "floating point `20.5`, expected a whole number above 0",
        ),
        (
            "biased_steps = 2000 ",
            "biased_steps = 9223372036854775807 ",
            "walk.biased_steps is 9223372036854776000; expected at most",
        ),
        ("tau = 0.15", "tau = 0", "found 0, expected a finite number above 0"),
        ("# mode = \"reproducible\"", "mode = \"reproducable\"", "did you mean `reproducible`?"),
        ("rule = \"atom_count\"", "rule = \"atom_cont\"", "did you mean `atom_count`?"),
        ("fraction = 0.15", "fracton = 0.15", "did you mean `fraction`?"),
        ("fraction = 0.15", "fraction = 1.5", "found 1.5, expected a number above 0 and not above 1"),
        (
            "# forgetting_alarm = 0.2",
            "forgetting_alarm = 20",
            "found 20, expected a number above 0 and not above 1",
        ),
        (
            "# alpha_values = [0.05, 0.1,",
            "alpha_values = [0.05, 0.01,",
            "expected at least one value, ascending",
        ),
        (
            "# alpha_values = [0.05, 0.1, 0.2, 0.4, 0.7, 1.0]",
            "alpha_values = []",
            "expected at least one value, ascending",
        ),
        (
            "fraction = 0.15, min_atoms = 3, target = 1.25",
            "fraction = 0.25, min_atoms = 3, target = 1.25",
            "collect.update_target is atom_count: fewer than 8 atoms with γ > 1.3, else γ_max below 1.25; expected a rule after",
        ),
        (
            langevin,
            "thermostat = { langevin = { friction = 0 } }",
            "walk.thermostat.langevin.friction is 0; expected",
        ),
        (langevin, "thermostat = { langevin = { fricton = 1 } }", "did you mean `friction`?"),
        (langevin, "thermostat = { langvin = { friction = 1 } }", "did you mean `langevin`?"),
        (
            langevin,
            "thermostat = { nose_hoover = { relaxation_time = 100, chain_length = 0 } }",
            "walk.thermostat.nose_hoover.chain_length is 0; expected 1 to 100",
        ),
        ("from = 1.0, to = 1.4", "from = 0.0, to = 1.4", "found 0, expected a finite number above 0"),
        (
            "inner = 1.6, outer = 2.4",
            "inner = 2.6, outer = 2.4",
            "inner 2.6 and outer 2.4; expected inner below outer",
        ),
        (
            "inner = 1.6, outer = 2.4",
            "inner = 1.6, outer = 7",
            "expected at most the cutoff of the model, 6.5 Å",
        ),
        ("inner = 1.6, outer = 2.4", "inner = 1.6", "missing key `outer`"),
        (
            distances,
            "min_distances = { rule = \"per_pair\", pairs = { O-H = -1 } }",
            "guard.min_distances.pairs.H-O is -1; expected above 0, at most 10 Å",
        ),
        (
            distances,
            "min_distances = { rule = \"per_pair\", pairs = { O-X = 1 } }",
            "'O-X' is not a pair of elements",
        ),
        (
            distances,
            "min_distances = { rule = \"per_pair\", bonded = 1.5 }",
            "guard.min_distances.bonded is 1.5; expected 0.01 to 1: it is a fraction",
        ),
        (distances, "min_distances = { rule = \"uniform\", bonded = 0.7 }", "unknown key `bonded`"),
        (distances, "min_distances = { rule = \"papers\" }", "unknown value `papers`"),
        (
            "rule = \"uniform\", inner = 1.6,",
            "rule = \"per_pair\", inner = 3.6,",
            "expected inner below outer",
        ),
        ("# max_temperature = 20000.0", "max_temperature = 500", "more than walk.temperature = 600 K"),
        (
            "# update = \"cumulative\"",
            "update = \"per_seed_structure\"",
            "expected mode = \"reproducible\" and run.walks_per_round = 1",
        ),
        ("files = [\"", "files = [] # [\"", "seed_structures.files is an empty list"),
        ("# max_structures = 100", "max_structures = 0", "expected a whole number above 0"),
        ("# walkers = 0", "walkers = -1", "integer `-1`, expected a whole number, 0 or more"),
        ("# walkers = 0", "walkers = 100000", "run.walkers is 100000; expected at most 1024"),
        (
            "kind = \"eam_fs\"",
            "kind = \"eam\"",
            "expected one of `grace`, `eam_alloy`, `eam_fs`, `stillinger_weber`",
        ),
        (
            "method = { potential",
            "method = { dft",
            "unknown value `dft`, expected one of `potential`, `abinit`, ",
        ),
    ] {
        let message = tester.refused(changed(from, to));
        let line = line(from);
        let at = [format!("c.toml:{line}: "), format!("c.toml:{line}:"), format!("c.toml:{}:", line + 1)];
        assert!(at.iter().any(|at| message.contains(at)), "{message}\nexpected line {line} for {to}");
        assert!(message.contains(expected), "{message}\nexpected {expected}");
    }
}

#[test]
fn whole_sections_and_files_that_are_none_are_reported() {
    let tester = ConfigTester::new();
    tester.refused_with("[potential]\nmodel", "model", &["c.toml:", "`model`"]);
    tester.refused_with("tau = 0.15 ", "# ", &["missing key `tau`", "[walk]"]);
    tester.refused_with(
        "[seed_structures]",
        "[walk]",
        &[&format!("c.toml:{}:", line("[walk]")), "duplicate key"],
    );
    assert!(tester.refused("").contains("c.toml:1:1: missing key `potential`"));
    let binary: Vec<u8> = (0..=255).collect();
    assert!(
        tester
            .refused(binary)
            .contains("c.toml:2: found bytes that are not text; expected a configuration in TOML")
    );
    assert!(tester.refused("[walk\n").contains("c.toml:1:"));
    fs::remove_file(tester.path().join("c.toml")).unwrap();
    assert!(refuse(tester.path(), ["run", "c.toml"]).contains("cannot read c.toml: No such file"));
    fs::create_dir(tester.path().join("c.toml")).unwrap();
    assert!(refuse(tester.path(), ["run", "c.toml"]).contains("cannot read c.toml: Is a directory"));
}

/// The bytes of an npz file without some of its arrays.
fn without(file: &str, unwanted: impl Fn(&str) -> bool) -> Vec<u8> {
    let bytes = fs::read(config(file)).unwrap();
    let mut source = NpzArchive::new(Cursor::new(&bytes[..])).unwrap();
    let mut names: Vec<_> = source.array_names().map(str::to_owned).collect();
    names.sort();
    let mut out = NpzWriter::new(Cursor::new(Vec::new()));
    for name in names.into_iter().filter(|name| !unwanted(name)) {
        let file = file_name_from_array_name(&name);
        let mut array = Vec::new();
        source.zip_archive().by_name(&file).unwrap().read_to_end(&mut array).unwrap();
        out.zip_writer().start_file(file, Default::default()).unwrap();
        out.zip_writer().write_all(&array).unwrap();
    }
    out.zip_writer().finish().unwrap().into_inner()
}

/// The path of a data file as the demo writes it.
fn path(file: &str) -> String {
    config(file).display().to_string()
}

#[test]
fn broken_models_and_artifacts_are_named() {
    let tester = ConfigTester::new();
    for (file, key) in [(MODEL, "potential.model"), (ARTIFACT, "calm.artifact")] {
        let at = format!("c.toml:{}: {key}: ", line(&path(file)));
        // An artifact replaces the mixture of the model, which is then not read.
        let whole = match file {
            MODEL => without(MODEL, |name| name.starts_with("uq_")),
            _ => fs::read(config(file)).unwrap(),
        };
        for size in [0, 1, 100, whole.len() / 10, whole.len() / 2, whole.len() - 1] {
            tester.write("cut.npz", &whole[..size]);
            tester.refused_with(&path(file), "cut.npz", &[&at, "cut.npz", "npz a"]);
        }
        for place in 1..10 {
            let mut damaged = whole.clone();
            damaged[whole.len() * place / 10] ^= 0xff;
            tester.write("cut.npz", damaged);
            tester.refused_with(&path(file), "cut.npz", &["c.toml:", "cut.npz"]);
        }
        tester.write("cut.npz", "units metal\natom_style atomic\n");
        tester.refused_with(&path(file), "cut.npz", &[&at, "cut.npz", "npz archive"]);
        tester.refused_with(&path(file), "absent.npz", &[&at, "absent.npz", "No such file"]);
        tester.refused_with(&path(file), ".", &[&at, "directory"]);
    }
    tester.refused_with(&path(MODEL), &path(ARTIFACT), &["gmm_artifacts.npz", "not a kokkos.npz export"]);
}

#[test]
fn a_model_without_feature_arrays_cannot_be_graded_with() {
    let tester = ConfigTester::new();
    tester.write("bare.npz", without(MODEL, |name| name.starts_with("uq_")));
    // The artifact would provide the features.
    let text = changed(&path(MODEL), "bare.npz").replacen("artifact = ", "# artifact = ", 1);
    let text = text.replacen("[calm]", "[calm]\nupdate = \"never\"", 1);
    let message = tester.refused(without_refit(&text));
    assert!(message.contains("potential.model: bare.npz: no feature projection (uq_* arrays)"), "{message}");
}

#[test]
fn an_artifact_must_belong_to_the_model() {
    let tester = ConfigTester::new();
    let silicon = path("data/si_sw_1l/gmm_artifacts.npz");
    let expected =
        ["calm.artifact: ", &silicon, "another model: its list of elements is Si, the model's is Al"];
    tester.refused_with(&path(ARTIFACT), &silicon, &expected);
}

#[test]
fn a_mixture_without_statistics_can_be_scored_with_but_not_updated() {
    let tester = ConfigTester::new();
    let advice = "grade structures but cannot be updated; give the gmm_artifacts.npz of the build, or leave calm.artifact out";
    let export = path(MODEL);
    tester.refused_with(&path(ARTIFACT), &export, &["calm.artifact: ", &export, advice]);
    tester.write("stripped.npz", without(ARTIFACT, |name| name.starts_with("scatter_")));
    tester.refused_with(&path(ARTIFACT), "stripped.npz", &["stripped.npz", advice]);
    let left_out = tester.refused(changed("artifact = ", "# artifact = "));
    assert!(
        left_out.contains(&format!("c.toml:{}: calm.artifact is left out", line("[calm]"))),
        "{left_out}"
    );

    // Without updates the mixture of the export suffices.
    let never =
        changed("artifact = ", "update = \"never\" # ").replace("biased_steps = 2000 ", "biased_steps = 60 ");
    let never = without_refit(&never);
    tester.write("c.toml", never.replace("# equilibration_steps = 500", "equilibration_steps = 10"));
    let valid = succeed(tester.path(), ["validate", "c.toml"]);
    assert!(valid.contains("it can grade structures but not be updated"), "{valid}");
    let summary = succeed(tester.path(), ["run", "c.toml"]);
    assert!(summary.contains("mixture          version 0"), "{summary}");
}

#[test]
fn options_of_label_jobs_must_leave_them_where_they_are_found() {
    let tester = ConfigTester::new();
    for option in ["--clusters=other", "-Mother"] {
        let keys =
            format!("[label]\nbatch_system = \"slurm\"\nscratch = \"/s\"\nbatch_options = [{option:?}]");
        tester.refused_with(
            "[label]",
            &keys,
            &["label.batch_options", option, "the cluster of the labeller's host"],
        );
    }
}

#[test]
fn training_frames_and_label_potentials_must_fit() {
    let tester = ConfigTester::new();
    let (frames, label) = (path("data/al_eam_1l/seed_frames.extxyz"), path("data/Al_mm.eam.fs"));
    tester.refused_with(&frames, "absent.extxyz", &["calm.training_frames: absent.extxyz"]);
    let silicon = path("data/si_sw_1l/seed_frames.extxyz");
    tester.refused_with(&frames, &silicon, &[&format!("{silicon}:1: atom 0 is Si"), "(it supports Al)"]);
    tester.write("empty.extxyz", "");
    let expected = "empty.extxyz: found no frames with atoms, expected at least one";
    tester.refused_with(&frames, "empty.extxyz", &["calm.training_frames: ", expected]);
    tester.refused_with(
        &label,
        "absent.eam",
        &["label.method.potential.file: ", "absent.eam", "No such file"],
    );
    tester.refused_with(&label, &path("data/Si.sw"), &["label.method.potential.file: ", "Si.sw"]);
    tester.refused_with("\"eam_fs\"", "\"stillinger_weber\"", &["Al_mm.eam.fs, line 2: found 22 words"]);
    let of_silicon = format!("{{ kind = \"stillinger_weber\", file = \"{}\" }}", path("data/Si.sw"));
    let expected = [
        "Si.sw: the label potential knows Si, but the structure has Al (seed structure 'fcc-100', ",
        ".extxyz:1)",
    ];
    tester.refused_with(&format!("{{ kind = \"eam_fs\", file = \"{label}\" }}"), &of_silicon, &expected);
    for size in [0, 20, 2000] {
        tester.write("cut.eam", &fs::read(&label).unwrap()[..size]);
        tester.refused_with(&label, "cut.eam", &["label.method.potential.file: ", "cut.eam"]);
    }
}

#[test]
fn an_unknown_command_line_is_refused() {
    let here = tempfile::tempdir().unwrap();
    for arguments in [vec!["rnu"], vec!["run"], vec!["run", "c.toml", "--directry", "x"], vec![]] {
        let output = calmwalk(here.path(), &arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {}", stderr(&output));
        assert!(stderr(&output).contains("Usage: calmwalk"), "{}", stderr(&output));
    }
}
