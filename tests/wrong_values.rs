//! Implausible values, misspelt names, and all errors of a file at once.

use std::fs;

use crate::common;
use crate::common::config_tester::{ConfigTester, changed, line, without_refit};
use crate::common::{calmwalk, config, refuse, stderr, succeed};

/// The warnings of `validate`, which equal those of `run`, for a valid variant of the demo.
fn warnings(tester: &ConfigTester, text: &str) -> Vec<String> {
    tester.write("c.toml", text);
    let output = calmwalk(tester.path(), ["validate", "c.toml"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    let warnings: Vec<_> = stderr(&output).lines().map(str::to_owned).collect();
    let shown = String::from_utf8(output.stdout).unwrap();
    let count = match warnings.len() {
        0 => "none".to_owned(),
        count => format!("{count}, see above"),
    };
    assert!(shown.contains(&format!("  warnings         {count}\n")), "{shown}{warnings:?}");
    warnings
}

#[test]
fn unusual_values_are_warned_of_at_their_own_lines() {
    let tester = ConfigTester::new();
    for (from, to, expected) in [
        (
            "# time_step = 2.0",
            "time_step = 0.002",
            "walk.time_step: 0.002 fs is unusual (0.1 to 5 fs is usual); it is in fs",
        ),
        ("tau = 0.15", "tau = 15", "walk.tau: 15 is unusual (0.01 to 5 is usual)"),
        (
            "# thermostat = { langevin = { friction = 0.01 } }",
            "thermostat = { langevin = { friction = 10 } }",
            "walk.thermostat.langevin.friction: 10 1/fs is unusual",
        ),
        (
            "temperature = 600.0",
            "temperature = 1",
            "walk.temperature: 1 K is unusual (10 to 10000 K is usual)",
        ),
        ("from = 1.0, to = 1.4", "from = 1.0, to = 14", "walk.volume_ramp.to: 14 V/V₀ is unusual"),
        ("# time_limit = \"1day\"", "time_limit = \"1s\"", "label.time_limit: 1s is unusual"),
    ] {
        let found = warnings(&tester, &changed(from, to));
        let at = format!("WARNING: c.toml:{}: ", line(from));
        let [warning] = found.as_slice() else { panic!("{to}: {found:?}") };
        assert!(warning.starts_with(&at) && warning.contains(expected), "{warning}\nexpected {at}{expected}");
    }
    assert!(warnings(&tester, &common::demo("aluminium.toml")).is_empty());
}

#[test]
fn run_gives_the_same_warnings_and_continues() {
    let tester = ConfigTester::new();
    let text = changed("biased_steps = 2000 ", "biased_steps = 5 ")
        .replace("# equilibration_steps = 500", "equilibration_steps = 1");
    let text = without_refit(&text);
    let expected = warnings(&tester, &text);
    assert_eq!(expected.len(), 1, "{expected:?}");
    let output = calmwalk(tester.path(), ["run", "c.toml"]);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    assert_eq!(stderr(&output).lines().next(), Some(expected[0].as_str()));
}

#[test]
fn implausible_values_are_refused() {
    let tester = ConfigTester::new();
    for (from, to, expected) in [
        (
            "from = 1.0, to = 1.4",
            "from = 100, to = 140",
            "walk.volume_ramp.from is 100; expected 0.05 to 20 V/V₀: it is V/V₀ and no percentage: +40 % is 1.4",
        ),
        ("# time_step = 2.0", "time_step = 50", "walk.time_step is 50; expected at most 20 fs"),
        ("# skin = 0.5", "skin = 50", "walk.skin is 50; expected at most 10 Å"),
        (
            "# heartbeat_timeout = \"2m\"",
            "heartbeat_timeout = \"1s\"",
            "run.heartbeat_timeout is 1s; expected 5s to 10days",
        ),
        ("# time_limit = \"1day\"", "time_limit = \"0s\"", "label.time_limit is 0s; expected 1s to 30days"),
        (
            "# agent_heartbeat_timeout = \"1m\"",
            "agent_heartbeat_timeout = \"0s\"",
            "run.agent_heartbeat_timeout is 0s; expected 100ms to 10days",
        ),
    ] {
        tester.refused_with(from, to, &[&format!("c.toml:{}: ", line(from)), expected]);
    }
    // The same in a separate table.
    let abinit = "[label.method.abinit]\npseudopotentials = \"/\"\ncutoff = 10\nk_spacing = 6\n";
    let text = changed("method = { potential", "# method = { potential")
        .replace("\n[budget]", &format!("\n{abinit}\n[budget]"));
    let message = tester.refused(&text);
    let at = |words: &str| 1 + text.lines().position(|line| line == words).unwrap();
    for expected in [
        "2 errors in c.toml:\n".to_owned(),
        format!(
            "c.toml:{}: label.method.abinit.cutoff is 10; expected 20 to 1e5 eV: it is in eV: 1 Ry is",
            at("cutoff = 10")
        ),
        format!(
            "c.toml:{}: label.method.abinit.k_spacing is 6; expected 0.005 to 5 1/Å",
            at("k_spacing = 6")
        ),
    ] {
        assert!(message.contains(&expected), "{message}\nexpected {expected}");
    }
}

#[test]
fn all_errors_are_reported_together() {
    let tester = ConfigTester::new();
    let mut text = changed("tau = 0.15 ", "# ").replace("temperature = 600.0", "temprature = 600.0");
    for (from, to) in [
        ("model = ", "modle = "),
        ("# rng_seed = 1 ", "rng_seed = -1 "),
        ("from = 1.0, to = 1.4", "from = 1.0, to = 140"),
        ("# min_interval = 200", "min_interval = \"200\""),
        ("update_target = ", "# update_target = "),
        ("inner = 1.6, outer = 2.4", "inner = 1.6"),
        ("# walkers = 0", "walkers = 5000"),
        ("[notify]", "[notifi]"),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replacen(from, to, 1);
    }
    let message = tester.refused(&text);
    let lines: Vec<_> = message.lines().filter(|line| line.starts_with("c.toml:")).collect();
    let expected = [
        ("rng_seed", "campaign.rng_seed: invalid value: integer `-1`"),
        (
            "modle",
            "unknown key `modle`, expected one of `model`, `precision`, `python`; did you mean `model`?",
        ),
        ("[walk]", "missing key `tau`"),
        ("temprature", "unknown key `temprature`, expected one of"),
        ("to = 140", "walk.volume_ramp.to is 140; expected"),
        ("[collect]", "missing key `update_target`"),
        (
            "min_interval = \"200\"",
            "collect.min_interval: invalid type: string \"200\", expected a whole number",
        ),
        ("zbl = {", "missing key `outer`"),
        ("walkers = 5000", "run.walkers is 5000; expected at most 1024"),
        ("[notifi]", "unknown key `notifi`, expected one of"),
    ];
    assert!(message.starts_with("calmwalk: 10 errors in c.toml:\n"), "{message}");
    for (of, words) in expected {
        let number = 1 + text.lines().position(|line| line.contains(of)).unwrap();
        let at = format!("c.toml:{number}:");
        assert!(
            lines.iter().any(|line| line.starts_with(&at) && line.contains(words)),
            "{at} {words}\n{message}"
        );
    }
}

#[test]
fn missing_keys_are_reported_together() {
    let tester = ConfigTester::new();
    let message = tester.refused("[walk]\n[potential]\n");
    for key in ["temperature", "biased_steps", "tau", "model", "calm", "seed_structures", "collect", "label"]
    {
        assert!(message.contains(&format!("missing key `{key}`")), "{key}: {message}");
    }
    let md = fs::read_to_string(config("md-aluminium.toml")).unwrap();
    tester.write(
        "md.toml",
        md.replace("temperature = ", "temprature = ").replace("trajectory = ", "# trajectory = "),
    );
    let message = refuse(tester.path(), ["md", "md.toml"]);
    for words in ["2 errors in md.toml", "did you mean `temperature`?", "missing key `trajectory`"] {
        assert!(message.contains(words), "{words}: {message}");
    }
    tester.write("md.toml", md.replace("time_step = 2.0", "time_step = 200.0"));
    let message = refuse(tester.path(), ["md", "md.toml"]);
    assert!(message.contains("dynamics.time_step is 200; expected at most 20 fs"), "{message}");
}

#[test]
fn names_that_are_nearly_right_get_a_hint() {
    let tester = ConfigTester::new();
    for (from, to, expected) in [
        ("temperature = 600.0", "temperature = 600.0\nmin_interval = 100", "it belongs in [collect]"),
        (
            "temperature = 600.0",
            "temperature = 600.0\ntime_limit = \"100s\"",
            "it belongs in [label] or [notify]",
        ),
        ("temperature = 600.0", "temperature = 600.0\ndt = 1", "did you mean `time_step`?"),
        ("# min_interval = 200", "min_intervall = 200", "did you mean `min_interval`?"),
        ("[campaign]", "tau = 1\n[campaign]", "it belongs in [walk]"),
        (
            "method = { potential",
            "method = { quantum_espresso",
            "Quantum ESPRESSO is `espresso`: see docs/dft-codes.md",
        ),
        (
            "method = { potential",
            "method = { siesta",
            "siesta makes labels through `ase`: see docs/dft-codes.md",
        ),
    ] {
        tester.refused_with(from, to, &[expected]);
    }
    let abinit = "\n[label.method.abinit]\necut = 400\n[budget]";
    let text = changed("method = { potential", "# method = { potential").replacen("\n[budget]", abinit, 1);
    let message = tester.refused(text);
    assert!(
        message.contains("unknown key `ecut`") && message.contains("did you mean `cutoff`?"),
        "{message}"
    );
}

#[test]
fn other_things_in_the_place_of_files_are_reported() {
    let tester = ConfigTester::new();
    let seeds = config("data/aluminium_seeds.extxyz").display().to_string();
    for (name, expected) in [
        ("seeds.cif", "convert it with `ase convert seeds.cif seeds.extxyz`"),
        ("seeds.pdb", "convert it with `ase convert seeds.pdb seeds.extxyz`"),
        ("folder", "folder: cannot be opened: it is a directory; expected a file"),
        ("folder.extxyz", "folder.extxyz: cannot be opened: it is a directory; expected a file"),
    ] {
        match name.starts_with("folder") {
            true => fs::create_dir(tester.path().join(name)).unwrap(),
            false => tester.write(name, "data_Al\n_cell_length_a 4.05\n"),
        }
        tester.refused_with(&seeds, name, &["seed_structures.files: ", expected]);
    }
    let model = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let score = |input: &str| {
        refuse(tester.path(), ["calm", "score", "--model", &model, input, "--output", "out.extxyz"])
    };
    assert!(score("seeds.cif").contains("expected extended XYZ; convert it with `ase convert seeds.cif"));
    assert!(score("folder").contains("it is a directory"));
    // The directory that `init` creates, given instead of its configuration.
    succeed(tester.path(), ["init", "mine"]);
    let message = refuse(tester.path(), ["validate", "mine"]);
    assert!(
        message.contains("cannot read mine: Is a directory")
            && message.contains("did you mean mine/campaign.toml?"),
        "{message}"
    );
}

#[test]
fn urls_of_no_known_kind_are_no_directories() {
    let tester = ConfigTester::new();
    let store = "postgre://user:secret@host/database";
    let told = |message: String| {
        assert!(message.contains("postgre://user@host/database"), "{message}");
        assert!(
            message.contains("it must begin with postgres://") && !message.contains("secret"),
            "{message}"
        );
    };
    told(tester.refused(changed("[run]", &format!("[run]\nstore = \"{store}\""))));
    told(refuse(tester.path(), ["status", store]));
    told(refuse(tester.path(), ["label", "--store", store]));
    tester.write("c.toml", common::demo("aluminium.toml"));
    let message = refuse(tester.path(), ["run", "c.toml", "--directory", store]);
    assert!(message.contains("--directory is a URL") && !message.contains("secret"), "{message}");
    assert!(!tester.path().join("postgre:").exists());
}

#[test]
fn arguments_that_are_nearly_right_get_a_hint() {
    let tester = ConfigTester::new();
    tester.write("c.toml", common::demo("aluminium.toml"));
    for (arguments, expected) in [
        (vec!["run", "c.toml", "--dashboard", "8080"], "expected ADDRESS:PORT, such as 127.0.0.1:8080"),
        (vec!["run", "c.toml", "--metrics", ":9464"], "expected ADDRESS:PORT, such as 127.0.0.1:9464"),
        (vec!["dashboard", "c", "--address", "here"], "expected ADDRESS:PORT, such as 127.0.0.1:8080"),
        (vec!["run", "c.toml", "--wait-timeout", "10"], "found '10', expected a time with its unit, such as"),
        (
            vec!["label", "--store", "c", "--grace-period", "soon"],
            "found 'soon', expected a time with its unit",
        ),
        (vec!["watch", "c", "--interval", "1ms"], "expected 200ms to 1h"),
        (vec!["walks", "c", "pause", "all"], "to select all walks, use --all"),
        (vec!["walks", "c", "pause", "x"], "expected the number of a walk"),
        (vec!["export", "c", "--output", "o", "--where", "gama > 1"], "did you mean 'gamma'?"),
        (vec!["export", "c", "--output", "o", "--where", "forces > 1"], "did you mean 'max_force'?"),
        (vec!["export", "c", "--output", "o", "--where", "origin = bias"], "did you mean 'biased'?"),
        (
            vec!["export", "c", "--output", "o", "--where", "gamma > 1 && atoms > 1"],
            "joined by the word 'and'",
        ),
    ] {
        let message = refuse(tester.path(), &arguments);
        assert!(message.contains(expected), "{arguments:?}: {message}");
    }
}
