//! The overhead of walkers and labellers in separate processes: the aluminium campaign of `configs/`,
//! lengthened, run once in a single process and once in several. Both make the same steps, bit for bit.
//!
//! Both campaigns of a pair run concurrently and alternate: one is stopped while the other runs for a fraction
//! of a second. Both therefore see the same machine load. The speed of a virtual machine varies from minute to
//! minute by more than the difference to be measured.
//!
//! `cargo bench --bench processes`; a number after `--` sets the number of pairs.

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// Default number of pairs.
const PAIRS: usize = 5;
/// Time slice of a campaign.
const TIME_SLICE: Duration = Duration::from_millis(500);
/// How often the bench checks whether a campaign has ended.
const POLL_INTERVAL: Duration = Duration::from_millis(1);

fn main() {
    let pairs = std::env::args().skip(1).find_map(|text| text.parse().ok()).unwrap_or(PAIRS);
    println!("campaign steps a second (all in one process, in processes of their own), and their ratio");
    let mut ratios = Vec::new();
    for pair in 0..pairs {
        let mut both = [RunningCampaign::new(&["--in-process"]), RunningCampaign::new(&[])];
        // Alternate which campaign of a pair goes first.
        let mut turn = pair % 2;
        while both.iter().any(|campaign| !campaign.ended) {
            both[turn].advance();
            turn = 1 - turn;
        }
        let [alone, apart] = both.map(|campaign| campaign.steps_a_second());
        println!("{alone:8.1} {apart:8.1}   {:.3}", apart / alone);
        ratios.push(apart / alone);
    }
    ratios.sort_by(f64::total_cmp);
    println!("median ratio {:.3}", ratios[ratios.len() / 2]);
}

/// A complete campaign, including start and end.
struct RunningCampaign {
    directory: TempDir,
    options: Vec<&'static str>,
    run: Option<Child>,
    /// Time during which it ran.
    time: Duration,
    ended: bool,
}

impl RunningCampaign {
    fn new(options: &[&'static str]) -> Self {
        let directory = tempfile::tempdir().expect("a directory for temporary files");
        fs::write(directory.path().join("campaign.toml"), text()).expect("a file that can be written");
        Self { directory, options: options.to_vec(), run: None, time: Duration::ZERO, ended: false }
    }

    /// Runs it for one time slice.
    fn advance(&mut self) {
        let begun = Instant::now();
        if self.run.is_none() {
            self.run = Some(self.start());
        } else {
            self.signal(Signal::CONT);
        }
        let run = self.run.as_mut().expect("it was started above");
        while !self.ended && begun.elapsed() < TIME_SLICE {
            std::thread::sleep(POLL_INTERVAL);
            if let Some(status) = run.try_wait().expect("a child of this process") {
                assert!(status.success());
                self.ended = true;
            }
        }
        self.time += begun.elapsed();
        self.signal(Signal::STOP);
    }

    fn start(&self) -> Child {
        let mut command = calmwalk(self.directory.path());
        command.args(["run", "campaign.toml", "--directory", "."]).args(&self.options);
        command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("the program")
    }

    /// Signals all of its processes, which are those that work in its directory.
    fn signal(&self, signal: Signal) {
        for entry in fs::read_dir("/proc").expect("/proc").flatten() {
            let number = entry.file_name().to_str().and_then(|name| name.parse().ok());
            let Some(pid) = number.and_then(Pid::from_raw) else { continue };
            if fs::read_link(entry.path().join("cwd")).is_ok_and(|cwd| cwd == self.directory.path()) {
                // A process that has exited needs no signal.
                let _ = kill_process(pid, signal);
            }
        }
    }

    fn steps_a_second(&self) -> f64 {
        let status = calmwalk(self.directory.path()).args(["status", ".", "--json"]).output();
        let status: Value = serde_json::from_slice(&status.expect("the program").stdout).expect("JSON");
        let steps = status["walks"].as_array().expect("walks").iter().map(|walk| walk["step"].as_u64());
        steps.map(|step| step.expect("a step") as f64).sum::<f64>() / self.time.as_secs_f64()
    }
}

fn calmwalk(directory: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_calmwalk"));
    command.current_dir(directory);
    command
}

/// The demo with longer walks, so that the start takes a small part of the time.
fn text() -> String {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("configs");
    let text = fs::read_to_string(configs.join("aluminium.toml")).expect("a file of the project");
    let longer = text
        .replace("\nsteps = 2000 ", "\nsteps = 6000 ")
        .replace("# max_per_walk = 3 ", "max_per_walk = 9 ");
    assert_ne!(longer, text, "the keys stand in the file as they are replaced here");
    longer.replace("\"data/", &format!("\"{}/", configs.join("data").display()))
}
