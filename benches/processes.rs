//! What it costs to have walkers and labellers in processes of their own: the aluminium campaign of `configs/`, lengthened,
//! all in one process and in processes, in turn. Both make the same steps, to the last bit.
//!
//! `cargo bench --bench processes`; a number behind `--` is how many pairs are run.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use serde_json::Value;

/// Pairs of runs, if not given.
const PAIRS: usize = 5;

fn main() {
    let pairs = std::env::args().skip(1).find_map(|text| text.parse().ok()).unwrap_or(PAIRS);
    println!("campaign steps a second (all in one process, in processes of their own), and their ratio");
    let mut ratios = Vec::new();
    for pair in 0..pairs {
        // Whichever goes first in one pair goes second in the next.
        let (alone, apart) = if pair % 2 == 0 {
            let alone = steps_a_second(&["--in-process"]);
            (alone, steps_a_second(&[]))
        } else {
            let apart = steps_a_second(&[]);
            (steps_a_second(&["--in-process"]), apart)
        };
        println!("{alone:8.1} {apart:8.1}   {:.3}", apart / alone);
        ratios.push(apart / alone);
    }
    ratios.sort_by(f64::total_cmp);
    println!("median ratio {:.3}", ratios[ratios.len() / 2]);
}

/// Runs the whole campaign, start and end included.
fn steps_a_second(options: &[&str]) -> f64 {
    let directory = tempfile::tempdir().expect("a directory for temporary files");
    let here = directory.path();
    std::fs::write(here.join("campaign.toml"), text()).expect("a file that can be written");
    let begun = Instant::now();
    let arguments = ["run", "campaign.toml", "--directory", "."].iter().chain(options);
    assert!(
        calmwalk(here).args(arguments).stderr(Stdio::null()).output().expect("the program").status.success()
    );
    let seconds = begun.elapsed().as_secs_f64();
    let status = calmwalk(here).args(["status", ".", "--json"]).output().expect("the program");
    let status: Value = serde_json::from_slice(&status.stdout).expect("JSON");
    let steps = status["walks"].as_array().expect("walks").iter().map(|walk| walk["step"].as_u64());
    steps.map(|step| step.expect("a step") as f64).sum::<f64>() / seconds
}

fn calmwalk(directory: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_calmwalk"));
    command.current_dir(directory);
    command
}

/// The demo with longer walks, so that starting takes a small part of the time.
fn text() -> String {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let text = std::fs::read_to_string(configs.join("aluminium.toml")).expect("a file of the project");
    let longer =
        text.replace("\nsteps = 2000 ", "\nsteps = 6000 ").replace("# per_seed = 3 ", "per_seed = 9 ");
    assert_ne!(longer, text, "the keys stand in the file as they are replaced here");
    longer.replace("\"data/", &format!("\"{}/", configs.join("data").display()))
}
