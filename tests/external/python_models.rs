//! Campaigns on models behind a program in Python. Needs a Python with numpy, named by `CALMWALK_PYTHON`; one test needs a Python with
//! MACE, `CALMWALK_MACE_PYTHON` (`.ci/loaders` makes it).

use std::fs;
use std::path::Path;
use std::process::Command;
use std::thread::sleep;
use std::time::Duration;

use serde_json::Value;

use crate::common::{Running, config, program, refuse, stderr, succeed};

/// Least number of faults of the server in the campaign that is disturbed: 20, or `CALMWALK_FAULTS`.
fn wanted_faults() -> u32 {
    std::env::var("CALMWALK_FAULTS").map_or(20, |number| number.parse().unwrap())
}

/// Biased steps of a walk of the disturbed campaign, enough for 20 faults.
const STEPS_OF_20_FAULTS: u32 = 400;

/// Calls of the server between two of them.
const CALLS_BETWEEN: usize = 60;

/// A campaign on the radial model of the Python tests, with these lines in `[potential.python]`.
pub fn write_campaign(directory: &Path, python: &str) {
    let data = |file: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join(file).display().to_string();
    let (model, seeds, eam) = (
        data("python/tests/data/radial-al.json"),
        data("configs/data/aluminium_seeds.extxyz"),
        data("configs/data/Al_mm.eam.fs"),
    );
    let potential = format!("[potential]\nmodel = {model:?}\n[potential.python]\n{python}\n");
    fs::write(directory.join("model.toml"), &potential).unwrap();
    let rule = "rule = \"atom_count\", threshold = 1.1, fraction = 0.02, min_atoms = 2";
    let text = format!(
        "[campaign]\nmode = \"reproducible\"\nrng_seed = 7\n{potential}[calm]\nartifact = \"al.npz\"\n\
         [seed_structures]\nfiles = [{seeds:?}]\n\
         [walk]\ntemperature = 600.0\nbiased_steps = 400\nequilibration_steps = 20\ntau = 0.3\n\
         [collect]\ncriterion = {{ {rule} }}\nupdate_target = {{ {rule}, target = 1.0 }}\nmin_interval = 10\nmax_per_walk = 8\n\
         [guard]\nzbl = {{ rule = \"uniform\", inner = 1.6, outer = 2.4 }}\n\
         [label]\nmethod = {{ potential = {{ kind = \"eam_fs\", file = {eam:?} }} }}\nconcurrency = 1\n\
         [run]\nwalkers = 2\nwalks_per_round = 2\n"
    );
    fs::write(directory.join("campaign.toml"), text).unwrap();
}

pub fn adapter(name: &str, more: &str) -> String {
    let python = std::env::var("CALMWALK_PYTHON").expect("CALMWALK_PYTHON names a Python with numpy");
    format!("environment = {python:?}\nadapter = {name:?}\n{more}")
}

pub fn build(directory: &Path) {
    let frames = config("data/al_eam_1l/seed_frames.extxyz").display().to_string();
    let build = [
        "calm",
        "build",
        "--model",
        "model.toml",
        &frames,
        "--projection-dimension",
        "8",
        "--output",
        "al.npz",
    ];
    succeed(directory, build);
}

fn export(directory: &Path, campaign: &str) -> String {
    succeed(directory, ["export", campaign, "--control", "--output", "out.extxyz"]);
    let found = fs::read_to_string(directory.join("out.extxyz")).unwrap();
    fs::remove_file(directory.join("out.extxyz")).unwrap();
    found
}

/// The server dies, stops, has no memory and answers nonsense again and again: the data set has the same bytes.
#[test]
fn faults_of_the_server_change_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &adapter("radial", ""));
    build(here);
    let (control, count) = (here.join("control"), here.join("count"));
    write_campaign(
        here,
        &adapter(
            "simulated",
            &format!(
                "timeout = \"3s\"\ncompile_timeout = \"20s\"\noptions = {{ control = {control:?}, count = {count:?} }}"
            ),
        ),
    );
    let wanted = wanted_faults();
    let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
    let (usual, steps) =
        (format!("biased_steps = {STEPS_OF_20_FAULTS}"), STEPS_OF_20_FAULTS * wanted.div_ceil(20));
    assert!(text.contains(&usual));
    fs::write(here.join("campaign.toml"), text.replace(&usual, &format!("biased_steps = {steps}"))).unwrap();
    succeed(here, ["run", "campaign.toml", "--directory", "plain", "--in-process"]);
    fs::remove_file(&count).unwrap();
    let faults = run_disturbed(here, &count, |number| disturb(here, number));
    assert!(faults >= wanted, "the campaign was over after {faults} faults");
    let (plain, disturbed) = (export(here, "plain"), export(here, "disturbed"));
    assert!(plain == disturbed, "{} and {} bytes", plain.len(), disturbed.len());
    let status = succeed(here, ["status", "--all", "disturbed"]);
    assert!(status.contains("simulated on cpu") && status.contains("restart"), "{status}");
}

/// With one gradient for forces and bias in most steps, walks collect structures, whose forces are the model's alone. Walkers in processes,
/// faults of the server and another trace change nothing.
#[test]
fn one_gradient_for_forces_and_bias_gives_a_campaign() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &adapter("radial", ""));
    build(here);
    let (control, count) = (here.join("control"), here.join("count"));
    let write = |interval: u32| {
        let options = format!("options = {{ control = {control:?}, count = {count:?} }}");
        write_campaign(here, &adapter("simulated", &options));
        let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
        let walk = format!("[walk]\nbias_norm_interval = {interval}\ntrace_interval = {}\n", 7 * interval);
        fs::write(here.join("campaign.toml"), text.replace("[walk]\n", &walk)).unwrap();
    };
    write(5);
    succeed(here, ["run", "campaign.toml", "--directory", "plain", "--in-process"]);
    let calls = fs::read_to_string(&count).unwrap();
    let made = |name: &str| calls.lines().filter(|line| line.split(' ').next() == Some(name)).count();
    // Each biased step pulls back once; equilibration and control walks do not.
    let (seldom, all) = (made("evaluate_without_forces"), made("pull_back"));
    assert!(2 * seldom > all && seldom < all, "{seldom} of {all}");
    fs::remove_file(&count).unwrap();
    let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
    fs::write(here.join("campaign.toml"), text.replace("trace_interval = 35", "trace_interval = 9")).unwrap();
    let faults = run_disturbed(here, &count, |number| {
        let Some(fault) = ["exit", "nan", "memory"].get(number as usize) else { return false };
        fs::write(here.join("control.part"), fault).unwrap();
        fs::rename(here.join("control.part"), &control).unwrap();
        true
    });
    assert_eq!(faults, 3);
    let plain = export(here, "plain");
    assert!(plain == export(here, "disturbed") && plain.matches("origin=biased").count() > 2, "{plain}");
    write(6);
    let refused = refuse(here, ["run", "campaign.toml", "--directory", "plain"]);
    assert!(refused.contains("walk.bias_norm_interval"), "{refused}");
}

/// Two devices have half of the walkers each, and the data set has the same bytes, with walkers in processes and in one process.
#[test]
fn several_devices_change_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &adapter("radial", ""));
    build(here);
    succeed(here, ["run", "campaign.toml", "--directory", "one"]);
    write_campaign(here, &adapter("simulated", "device = [\"simulated:0\", \"simulated:1\"]"));
    succeed(here, ["run", "campaign.toml", "--directory", "two"]);
    succeed(here, ["run", "campaign.toml", "--directory", "threads", "--in-process"]);
    let one = export(here, "one");
    for campaign in ["two", "threads"] {
        assert!(export(here, campaign) == one, "{campaign}");
        let json: Value = serde_json::from_str(&succeed(here, ["status", "--json", campaign])).unwrap();
        let devices = json["devices"].as_array().unwrap();
        assert_eq!(devices.len(), 2);
        for (number, device) in devices.iter().enumerate() {
            assert_eq!(device["device"], format!("simulated:{number}"));
            assert!(device["structures"].as_u64().unwrap() > 100, "{campaign}: {device}");
        }
        let sum: u64 = devices.iter().map(|device| device["structures"].as_u64().unwrap()).sum();
        assert_eq!(json["device"]["structures"], sum);
    }
    let status = succeed(here, ["status", "--all", "two"]);
    assert!(status.contains("simulated on simulated:0, simulated:1: busy"), "{status}");
    assert!(status.contains("simulated on simulated:1: busy"), "{status}");
}

/// Runs the campaign into the directory `disturbed`. Between calls of the server, `disturb` may make a fault, whose number it gets. Returns the
/// number of faults.
fn run_disturbed(here: &Path, count: &Path, mut disturb: impl FnMut(u32) -> bool) -> u32 {
    let mut run =
        Running(program(here).args(["run", "campaign.toml", "--directory", "disturbed"]).spawn().unwrap());
    let (mut faults, mut last) = (0, 100);
    while run.0.try_wait().unwrap().is_none() {
        sleep(Duration::from_millis(20));
        let calls = fs::read_to_string(count).map_or(0, |text| text.lines().count());
        // Three failures without a result in between would end the walks.
        if calls > last + CALLS_BETWEEN && disturb(faults) {
            (faults, last) = (faults + 1, calls);
        }
    }
    assert!(run.0.wait().unwrap().success());
    faults
}

/// One fault of the server of the campaign in this directory. Returns whether there was one.
fn disturb(directory: &Path, number: u32) -> bool {
    let signal = |signal: &str| {
        let servers = Command::new("pgrep").args(["-f", "calmwalk.server"]).output().unwrap();
        let pids = String::from_utf8_lossy(&servers.stdout).into_owned();
        // Other tests have servers, too.
        let Some(pid) = pids.lines().find(|pid| belongs_to(pid, directory)) else { return false };
        Command::new("kill").args([signal, pid]).status().unwrap().success()
    };
    match number % 12 {
        0 | 6 => signal("-KILL"),
        5 => signal("-STOP"),
        kind => {
            let control = directory.join("control");
            if control.exists() {
                return false;
            }
            let faults = ["nan", "exception", "memory", "shape", "exit"];
            fs::write(directory.join("draft"), faults[kind as usize % faults.len()]).unwrap();
            fs::rename(directory.join("draft"), control).unwrap();
            true
        }
    }
}

/// Whether the parent of a process runs the campaign of this directory.
fn belongs_to(pid: &str, directory: &Path) -> bool {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let parent =
        status.lines().find_map(|line| line.strip_prefix("PPid:")).map(str::trim).unwrap_or_default();
    fs::read_link(format!("/proc/{parent}/cwd")).is_ok_and(|found| found == directory)
}

/// A program that fails at every call ends the walks with the reason; what was collected is labelled.
#[test]
fn a_program_that_fails_for_good_ends_walks_but_not_labels() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &adapter("radial", ""));
    build(here);
    let control = here.join("control");
    write_campaign(here, &adapter("simulated", &format!("options = {{ control = {control:?} }}")));
    let output = fs::File::create(here.join("said")).unwrap();
    let mut run = Running(
        program(here).args(["run", "campaign.toml", "--directory", "c"]).stderr(output).spawn().unwrap(),
    );
    let status = loop {
        if let Some(status) = run.0.try_wait().unwrap() {
            break status;
        }
        sleep(Duration::from_millis(20));
        let said = fs::read_to_string(here.join("said")).unwrap();
        if said.contains("accepted") && !control.exists() {
            fs::write(here.join("draft"), "exit").unwrap();
            fs::rename(here.join("draft"), &control).unwrap();
        }
    };
    let said = fs::read_to_string(here.join("said")).unwrap();
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.contains("failed three times in a row") && said.contains("adapter simulated"), "{said}");
    let queue = succeed(here, ["queue", "c", "list", "--state", "queued"]);
    let labelled = succeed(here, ["queue", "c", "list", "--state", "labelled"]);
    assert!(labelled.lines().count() > 1 && queue.lines().count() <= 2, "{labelled}\n{queue}");
    fs::remove_file(&control).ok();
    let goes_on = program(here).args(["run", "campaign.toml", "--directory", "c"]).output().unwrap();
    assert!(goes_on.status.success(), "{}", stderr(&goes_on));
}

/// What is wrong is said by the name of its key, before anything runs.
#[test]
fn wrong_models_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &adapter("radial", ""));
    build(here);
    let wrong = [
        (adapter("simulated", "options = { bend = { forces = 1.1 } }"), "the force of a cluster"),
        (adapter("simulated", "options = { noise = 1e-13 }"), "campaign.mode"),
        (adapter("simulated", "options = { crowd = 1e-13 }"), "potential.python.max_batch = 1"),
        (adapter("simulated", "options = { crowd_gradients = 1e-13 }"), "potential.python.max_batch = 1"),
        (adapter("nothing", ""), "nothing"),
        ("environment = \"/nowhere\"\nadapter = \"radial\"".to_owned(), "/nowhere"),
        (adapter("radial", "max_batch = 0"), "max_batch"),
        (adapter("radial", "device = []"), "a list with at least one"),
        (adapter("radial", "device = 1"), "a device such as"),
    ];
    for (python, expected) in wrong {
        write_campaign(here, &python);
        let said = refuse(here, ["validate", "campaign.toml"]);
        assert!(said.contains("campaign.toml:") && said.contains(expected), "{python}: {said}");
    }
}

/// Bits that differ in large batches only are found before the first walk, with the structures of the campaign.
#[test]
fn batches_of_the_campaign_have_the_same_bits() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_campaign(here, &adapter("radial", ""));
    build(here);
    let write = |max_batch: u32| {
        let options = format!("options = {{ crowd = 1e-13, crowd_above = 4 }}\nmax_batch = {max_batch}");
        write_campaign(here, &adapter("simulated", &options));
        let text = fs::read_to_string(here.join("campaign.toml")).unwrap();
        let text =
            text.replace("walkers = 2", "walkers = 8").replace("biased_steps = 400", "biased_steps = 10");
        fs::write(here.join("campaign.toml"), text).unwrap();
    };
    write(32);
    let said = refuse(here, ["run", "campaign.toml", "--directory", "c"]);
    assert!(said.contains("largest seed structure") && said.contains("max_batch = 1"), "{said}");
    write(4);
    succeed(here, ["run", "campaign.toml", "--directory", "d"]);
}

/// `calmwalk md` takes the section `[potential]` of a campaign; energies are those of the adapter.
#[test]
fn dynamics_with_an_ase_calculator() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    fs::write(here.join("emt.py"), "from ase.calculators.emt import EMT\n\ncalculator = EMT()\n").unwrap();
    let seeds = config("data/aluminium_seeds.extxyz").display().to_string();
    let python = adapter("ase", "options = { elements = [\"Al\"] }");
    let text = format!(
        "structure = {seeds:?}\n[potential]\nmodel = \"emt.py\"\n[potential.python]\n{python}\n\
         [dynamics]\nsteps = 20\ntemperature = 300\ntime_step = 1\nthermostat = {{ none = {{}} }}\n\
         [output]\ntrajectory = \"out.extxyz\"\nevery = 10\n"
    );
    fs::write(here.join("md.toml"), &text).unwrap();
    succeed(here, ["md", "md.toml"]);
    let check = "
import sys
from ase.calculators.emt import EMT
from ase.io import read

frames = read('out.extxyz', ':')
assert len(frames) == 3, len(frames)
for atoms in frames:
    energy, forces = atoms.get_potential_energy(), atoms.get_forces()
    atoms.calc = EMT()
    assert abs(atoms.get_potential_energy(force_consistent=True) - energy) < 1e-6
    assert abs(atoms.get_forces() - forces).max() < 1e-6
";
    let python = std::env::var("CALMWALK_PYTHON").unwrap();
    let checked = Command::new(python).args(["-c", check]).current_dir(here).output().unwrap();
    assert!(checked.status.success(), "{}", stderr(&checked));
    fs::write(here.join("md.toml"), text.replace("adapter = ", "adaptor = ")).unwrap();
    let said = refuse(here, ["md", "md.toml"]);
    assert!(said.contains("adaptor") && said.contains("adapter"), "{said}");
}

/// MACE with random weights: mixture, its validation, scores, selection, and a campaign whose labels are those of an ASE calculator.
#[test]
fn mace_has_a_campaign() {
    let python =
        std::env::var("CALMWALK_MACE_PYTHON").expect("CALMWALK_MACE_PYTHON names a Python with MACE");
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let maker = Path::new(env!("CARGO_MANIFEST_DIR")).join("python/tests/make_mace.py");
    let made = Command::new(&python).arg(maker).arg("mace.model").current_dir(here).output().unwrap();
    assert!(made.status.success(), "{}", stderr(&made));
    write_campaign(here, &format!("environment = {python:?}\nadapter = \"mace\"\nmax_batch = 1"));
    for file in ["model.toml", "campaign.toml"] {
        let text = fs::read_to_string(here.join(file)).unwrap();
        let line = text.lines().find(|line| line.starts_with("model = ")).unwrap();
        let mut text =
            text.replace(line, "model = \"mace.model\"").replace("biased_steps = 400", "biased_steps = 60");
        if let Some(line) = text.lines().find(|line| line.starts_with("method = ")).map(str::to_owned) {
            let ase = format!("method = {{ ase = {{ command = [{python:?}], calculator = \"emt.py\" }} }}");
            text = text.replace(&line, &ase);
        }
        fs::write(here.join(file), text).unwrap();
    }
    let calculator =
        "from ase.calculators.emt import EMT\n\nversion = \"1\"\n\n\ndef calculator():\n    return EMT()\n";
    fs::write(here.join("emt.py"), calculator).unwrap();
    build(here);
    let validate =
        ["calm", "validate", "--model", "model.toml", "--artifact", "al.npz", "--output", "validation"];
    let quick = ["--elements", "Al", "--no-relax", "--collision-evaluations", "0", "--scan-steps", "10"];
    succeed(here, validate.into_iter().chain(quick));
    assert!(here.join("validation/validation.html").exists());
    let seeds = config("data/aluminium_seeds.extxyz").display().to_string();
    succeed(
        here,
        [
            "calm",
            "score",
            "--model",
            "model.toml",
            "--artifact",
            "al.npz",
            &seeds,
            "--output",
            "scores.extxyz",
        ],
    );
    succeed(
        here,
        [
            "select",
            "--model",
            "model.toml",
            "--artifact",
            "al.npz",
            &seeds,
            "-n",
            "3",
            "--output",
            "picks.extxyz",
        ],
    );
    succeed(here, ["run", "campaign.toml", "--directory", "c"]);
    assert!(export(here, "c").contains("Al"));
    let labelled = succeed(here, ["queue", "c", "list", "--state", "labelled"]);
    assert!(labelled.lines().count() > 1, "{labelled}");
}
