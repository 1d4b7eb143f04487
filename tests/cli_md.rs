//! `calmwalk md`: molecular dynamics with a potential, from a configuration to a trajectory.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use atoms::cell::dot;
use atoms::extxyz::Frame;
use atoms::units::{ACCELERATION, BOLTZMANN};
use atoms::{Evaluation, NeighbourList, Potential, read_extxyz};
use potentials::{Eam, EamStyle};

use crate::common::{Running, calmwalk, config, deviation, program, refuse, stderr, succeed, write_frames};

/// A configuration for `steps` steps of the first aluminium seed structure.
fn configuration(steps: u64, rng_seed: u64, thermostat: &str) -> String {
    let (structure, potential) = (config("data/aluminium_seeds.extxyz"), config("data/Al_mm.eam.fs"));
    format!(
        "structure = {structure:?}\n\
         [potential]\nkind = \"eam_fs\"\nfile = {potential:?}\n\
         [dynamics]\nsteps = {steps}\ntemperature = 300\nrng_seed = {rng_seed}\nthermostat = {thermostat}\n\
         [output]\ntrajectory = \"out.extxyz\"\nevery = 20\n"
    )
}

fn run(here: &Path, configuration: &str) -> Vec<Frame> {
    fs::write(here.join("md.toml"), configuration).unwrap();
    succeed(here, ["md", "md.toml"]);
    read_extxyz(&here.join("out.extxyz")).unwrap()
}

/// ½ Σ p²/m, eV, of momenta in ASE's unit √(u eV).
fn kinetic_energy(frame: &Frame) -> f64 {
    let momenta = frame.arrays["momenta"].reals().unwrap();
    let masses = frame.structure.species.iter().map(|species| species.mass());
    momenta.as_chunks::<3>().0.iter().zip(masses).map(|(p, m)| dot(*p, *p) / (2.0 * m)).sum()
}

fn number(frame: &Frame, key: &str) -> f64 {
    frame.info[key].number().unwrap()
}

#[test]
fn energy_is_conserved_and_frames_say_what_the_potential_says() {
    let directory = tempfile::tempdir().unwrap();
    let frames = run(directory.path(), &configuration(100, 1, "{ none = {} }"));
    let steps: Vec<_> = frames.iter().map(|frame| number(frame, "step")).collect();
    assert_eq!(steps, [0.0, 20.0, 40.0, 60.0, 80.0, 100.0]);
    let mut potential = Eam::load_as(config("data/Al_mm.eam.fs"), EamStyle::FinnisSinclair).unwrap();
    let mut neighbours = NeighbourList::new(potential.cutoff(), 0.0);
    let mut totals = Vec::new();
    for frame in &frames {
        let mut expected = Evaluation::default();
        neighbours.update(&frame.structure).unwrap();
        potential.evaluate(&frame.structure, &neighbours, &mut expected).unwrap();
        let labels = frame.labels().unwrap();
        assert!(deviation(&[labels.energy.unwrap()], &[expected.energy()]) < 1e-12);
        assert!((number(frame, "time_fs") - 2.0 * number(frame, "step")).abs() < 1e-9);
        if number(frame, "step") > 0.0 {
            // In the initial perfect crystal, forces and shear stress vanish up to rounding.
            assert!(deviation(&labels.forces.unwrap().concat(), &expected.forces.concat()) < 1e-10);
            assert!(
                deviation(
                    &labels.stress.unwrap().concat(),
                    &expected.stress(&frame.structure).unwrap().concat()
                ) < 1e-10
            );
        }
        let freedom = 3.0 * (frame.structure.len() - 1) as f64;
        let temperature = 2.0 * kinetic_energy(frame) / (freedom * BOLTZMANN);
        assert!(deviation(&[number(frame, "temperature")], &[temperature]) < 1e-12);
        totals.push(labels.energy.unwrap() + kinetic_energy(frame));
    }
    assert!((number(&frames[0], "temperature") - 300.0).abs() < 1e-9);
    // Half of the kinetic energy has become potential energy; Verlet's relative error of the exchanged energy is of order (ω
    // dt)²/24 ≈ 10⁻³.
    let exchanged = kinetic_energy(&frames[0]);
    let spread = totals.iter().fold(0.0, |worst: f64, total| worst.max((total - totals[0]).abs()));
    assert!(spread < 5e-3 * exchanged, "{spread} of {exchanged} eV");
}

#[test]
fn momenta_are_the_motion_of_the_atoms() {
    let directory = tempfile::tempdir().unwrap();
    let text = configuration(2, 1, "{ none = {} }").replace("every = 20", "every = 1");
    let frames =
        run(directory.path(), &text.replace("temperature = 300", "temperature = 300\ntime_step = 0.01"));
    // Central difference over two steps of 0.01 fs: its error, x⃛ dt²/6 ≈ 10⁻⁹ Å/fs, is 10⁻⁷ of the velocities.
    let (before, after) = (&frames[0].structure.positions, &frames[2].structure.positions);
    let velocities = before.iter().zip(after).flat_map(|(a, b)| [0, 1, 2].map(|k| (b[k] - a[k]) / 0.02));
    let mass = frames[1].structure.species[0].mass();
    let momenta: Vec<_> = velocities.map(|v| mass * v / ACCELERATION.sqrt()).collect();
    assert!(deviation(&momenta, &frames[1].arrays["momenta"].reals().unwrap()) < 1e-6);
}

#[test]
fn the_same_random_seed_gives_the_same_bytes() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let trajectory = |rng_seed, thermostat: &str| {
        run(here, &configuration(40, rng_seed, thermostat));
        fs::read(here.join("out.extxyz")).unwrap()
    };
    for thermostat in ["{ langevin = { friction = 0.01 } }", "{ nose_hoover = { relaxation_time = 50 } }"] {
        let first = trajectory(7, thermostat);
        assert_eq!(first, trajectory(7, thermostat));
        assert_ne!(first, trajectory(8, thermostat));
    }
}

#[test]
fn the_configuration_in_configs_runs() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let printed =
        succeed(here, ["md", config("md-aluminium.toml").to_str().unwrap(), "--output", "t.extxyz"]);
    assert!(printed.starts_with("2000 steps of 32 atoms"), "{printed}");
    let frames = read_extxyz(&here.join("t.extxyz")).unwrap();
    assert_eq!(frames.len(), 21);
    // The mean of 20 nearly independent frames: √(2/93/20) of 300 K is 10 K.
    let mean = frames[1..].iter().map(|frame| number(frame, "temperature")).sum::<f64>() / 20.0;
    assert!((mean - 300.0).abs() < 50.0, "{mean} K");
}

/// The cell relaxes from 3 % above the volume at which the potential has no pressure, and then follows the set pressure.
#[test]
fn a_barostat_moves_the_cell_to_its_pressure() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let mut seed = read_extxyz(&config("data/aluminium_seeds.extxyz")).unwrap().remove(0);
    md::scale_volume(&mut seed.structure, 1.05);
    write_frames(&here.join("start.extxyz"), &[seed]);
    let mean_volume = |pressure: f64| {
        let thermostat = format!(
            "{{ nose_hoover = {{ relaxation_time = 100 }} }}\nbarostat = {{ pressure = {pressure}, relaxation_time = 200.0 }}"
        );
        let text = configuration(3000, 1, &thermostat)
            .replace(&format!("{:?}", config("data/aluminium_seeds.extxyz")), "\"start.extxyz\"");
        fs::write(here.join("md.toml"), text).unwrap();
        let output = calmwalk(here, ["md", "md.toml"]);
        assert!(output.status.success(), "{}", stderr(&output));
        let printed = stderr(&output);
        assert!(printed.contains("pressure (GPa)") && printed.contains("volume/first"), "{printed}");
        let frames = read_extxyz(&here.join("out.extxyz")).unwrap();
        let volumes: Vec<f64> =
            frames.iter().map(|frame| frame.structure.cell.volume() / frame.structure.len() as f64).collect();
        let (first, last) = (volumes[0], &volumes[50..]);
        let mean = last.iter().sum::<f64>() / last.len() as f64;
        let last_row = printed.lines().rfind(|line| line.trim_start().starts_with("3000 ")).unwrap();
        let ratio: f64 = last_row.rsplit(' ').next().unwrap().parse().unwrap();
        assert!((ratio - volumes.last().unwrap() / first).abs() < 1e-4, "{printed}");
        mean
    };
    // 4.0738 Å at 300 K and 1 bar (docs/dynamics.md); fluctuations of the volume are 1 %, of which 20 are nearly independent.
    let relaxed = mean_volume(1.0);
    assert!((relaxed / (4.0738_f64.powi(3) / 4.0) - 1.0).abs() < 0.01, "{relaxed} Å³");
    // With a bulk modulus of 80 GPa that grows by about 5 GPa for each GPa.
    let pressed = mean_volume(40_000.0);
    assert!((0.945..0.967).contains(&(pressed / relaxed)), "{pressed} Å³, {relaxed} Å³");
}

#[test]
fn impossible_barostats_are_refused_at_their_key() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let refused = |barostat: &str| {
        let thermostat = format!("{{ langevin = {{ friction = 0.01 }} }}\nbarostat = {barostat}");
        fs::write(here.join("md.toml"), configuration(10, 1, &thermostat)).unwrap();
        refuse(here, ["md", "md.toml"])
    };
    for (barostat, expected) in [
        ("{ relaxation_time = 0.0 }", "dynamics.barostat.relaxation_time is 0"),
        ("{ pressure = nan }", "dynamics.barostat.pressure"),
        ("{ pressure = 1e9 }", "1 GPa is 10000 bar"),
        ("{ presure = 1.0 }", "presure"),
    ] {
        let said = refused(barostat);
        assert!(said.contains(expected) && said.contains("md.toml:"), "{barostat}: {said}");
    }
    // A cluster has no cell that could move.
    let mut cluster = read_extxyz(&config("data/aluminium_seeds.extxyz")).unwrap().remove(0);
    cluster.structure.periodic = [false; 3];
    write_frames(&here.join("cluster.extxyz"), &[cluster]);
    let text = configuration(10, 1, "{ none = {} }\nbarostat = {}")
        .replace(&format!("{:?}", config("data/aluminium_seeds.extxyz")), "\"cluster.extxyz\"");
    fs::write(here.join("md.toml"), text).unwrap();
    let said = refuse(here, ["md", "md.toml"]);
    assert!(said.contains("dynamics.barostat: a cluster has no periodic direction"), "{said}");
}

#[test]
fn an_interrupted_run_leaves_a_valid_trajectory() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let endless = configuration(1_000_000_000, 1, "{ langevin = { friction = 0.01 } }");
    fs::write(here.join("md.toml"), endless).unwrap();
    let log = fs::File::create(here.join("log")).unwrap();
    let mut run = Running(program(here).args(["md", "md.toml"]).stderr(log).spawn().unwrap());
    let begun = Instant::now();
    while fs::metadata(here.join("out.extxyz")).map_or(0, |found| found.len()) < 20_000 {
        assert!(begun.elapsed() < Duration::from_secs(60), "no frames");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(Command::new("kill").args(["-INT", &run.0.id().to_string()]).status().unwrap().success());
    assert_eq!(run.0.wait().unwrap().code(), Some(130));
    assert!(fs::read_to_string(here.join("log")).unwrap().contains("energy (eV)"));
    let frames = read_extxyz(&here.join("out.extxyz")).unwrap();
    let steps: Vec<_> = frames.iter().map(|frame| number(frame, "step")).collect();
    assert!(steps.is_sorted_by(|a, b| a < b) && steps.len() > 3, "{steps:?}");
}

#[test]
fn a_trajectory_takes_the_place_of_no_input() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let potential = here.join("own.eam.fs");
    fs::copy(config("data/Al_mm.eam.fs"), &potential).unwrap();
    let text = configuration(10, 1, "{ none = {} }");
    let text = text.replace(config("data/Al_mm.eam.fs").to_str().unwrap(), "own.eam.fs");
    fs::write(here.join("md.toml"), &text).unwrap();
    for (output, what) in [("own.eam.fs", "the potential"), ("md.toml", "the configuration")] {
        let message = refuse(here, ["md", "md.toml", "--output", output]);
        assert!(message.contains(what), "{message}");
    }
    assert_eq!(fs::read_to_string(here.join("md.toml")).unwrap(), text);
    assert_eq!(fs::read(potential).unwrap(), fs::read(config("data/Al_mm.eam.fs")).unwrap());
}

#[test]
fn mistakes_are_named_with_their_line() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let good = configuration(10, 1, "{ none = {} }");
    let refused = |text: String| {
        fs::write(here.join("md.toml"), text).unwrap();
        refuse(here, ["md", "md.toml"])
    };
    let silicon = config("data/silicon_seeds.extxyz");
    let aluminium = config("data/aluminium_seeds.extxyz");
    for (text, place, reason) in [
        (good.replace("temperature", "temprature"), "md.toml:7:1:", "did you mean `temperature`?"),
        (good.replace("= 300", "= -300"), "md.toml:7:15:", "expected a finite number above 0"),
        (good.replace("none = {}", "nose_hover = {}"), "md.toml:9:", "did you mean `nose_hoover`?"),
        (good.replace("none = {}", "none = { friction = 1 }"), "md.toml:9:", "friction"),
        (good.replace("eam_fs", "eam_sf"), "md.toml:3:8:", "did you mean `eam_fs`?"),
        (good.replace("eam_fs", "stillinger_weber"), "md.toml:4: potential.file:", "Al_mm.eam.fs"),
        (good.replace("Al_mm.eam.fs", "missing"), "md.toml:4: potential.file:", "missing"),
        (
            good.replace(aluminium.to_str().unwrap(), silicon.to_str().unwrap()),
            "md.toml:1: structure:",
            "silicon_seeds.extxyz:1: atom 0 is Si; the potential supports Al",
        ),
        (
            good.replace("none = {}", "nose_hoover = { relaxation_time = 9, chain_length = 1000000000000 }"),
            "md.toml:9:",
            "expected 1 to 100",
        ),
        (good.replace("steps = 10", ""), "md.toml:5:1:", "missing key `steps`"),
    ] {
        let message = refused(text);
        assert!(
            message.contains(place) && message.contains(reason),
            "{message}\nexpected {place} … {reason}"
        );
    }
    assert!(refuse(here, ["md", "absent.toml"]).contains("cannot read absent.toml"));
    assert!(!here.join("out.extxyz").exists());
    fs::copy(&aluminium, here.join("seed.extxyz")).unwrap();
    fs::write(here.join("md.toml"), good.replace(aluminium.to_str().unwrap(), "seed.extxyz")).unwrap();
    assert!(refuse(here, ["md", "md.toml", "--output", "seed.extxyz"]).contains("name another file"));
}
