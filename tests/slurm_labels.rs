//! Labels as jobs of their own on a real Slurm of one node: `SLURM_CONF=$(.ci/slurm start) cargo test --test slurm_labels`.

mod common;

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, MutexGuard, PoisonError};

use common::campaign::{Small, outcome_at};
use common::place::{Place, on_store};
use common::processes::{carrying_out, processes_in, signal, wait_until};
use common::{Running, program, stderr};
use serde_json::Value;
use store::{ExportFilter, Store};
use tempfile::TempDir;

/// One campaign at a time: one test kills slurmctld.
static NODE: Mutex<()> = Mutex::new(());

/// Says that it has begun, and leaves a label when it may.
const SCRIPT: &str = r#"
pwd >> $HERE/begun
while [ ! -e $HERE/go ]; do sleep 0.1; done
awk '
    NR == 1 { print; next }
    NR == 2 { sub(/Properties=[^ ]*/, "Properties=species:S:1:pos:R:3:forces:R:3"); print $0 " energy=-1.5"; next }
    { print $0, 0.25, 0, 0 }
' structure.extxyz > unfinished
mv unfinished label.extxyz
"#;

/// A campaign whose labels are jobs of their own.
struct Jobs {
    place: Place,
    /// Its scratch directory is there, and what tells the script what to do.
    home: TempDir,
    _node: MutexGuard<'static, ()>,
}

impl Jobs {
    fn new() -> Self {
        assert!(std::env::var_os("SLURM_CONF").is_some(), "SLURM_CONF=$(.ci/slurm start) is needed");
        let _node = NODE.lock().unwrap_or_else(PoisonError::into_inner);
        let home = tempfile::tempdir().unwrap();
        let scratch = home.path().canonicalize().unwrap().join("scratch");
        fs::create_dir(&scratch).unwrap();
        let command =
            r#"{ command = { command = ["sh", "label.sh"], files = ["label.sh"], version = "1" } }"#;
        let keys = format!(
            "[label]\nslots = 0\nscratch = {:?}\nbatch_system = \"slurm\"\nbatch_options = [\"--comment=label\"]\nmethod = {command} # ",
            scratch.display().to_string()
        );
        let small = Small { walkers: 1, steps: 120, ..Small::default() };
        let place = Place::new(&small, &[("[label]\nmethod", &keys)]);
        let script = SCRIPT.replace("$HERE", &home.path().display().to_string());
        fs::write(place.path().join("label.sh"), script).unwrap();
        Self { place, home, _node }
    }

    /// Has every calculation end.
    fn go(&self) {
        fs::write(self.home.path().join("go"), "").unwrap();
    }

    /// Directories in which calculations have begun, one for each time.
    fn begun(&self) -> Vec<String> {
        let text = fs::read_to_string(self.home.path().join("begun")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    /// Number, state and name of each job that Slurm knows.
    fn jobs(&self) -> Vec<[String; 3]> {
        let text = slurm(&["squeue", "--noheader", "--states=all", "--format=%i|%T|%j|%Z"]);
        let scratch = self.home.path().canonicalize().unwrap();
        let job = |line: &str| {
            let [id, state, name, directory] = line.split('|').collect::<Vec<_>>()[..] else {
                panic!("{line}")
            };
            Path::new(directory).starts_with(&scratch).then(|| [id, state, name].map(str::to_owned))
        };
        text.lines().filter_map(job).collect()
    }

    /// Lets the campaign come to its end, and checks that each label is there once. Returns their number.
    fn finish(&self, mut run: Running, mut label: Running) -> usize {
        wait_until("the campaign is over", || {
            if label.0.try_wait().unwrap().is_some() {
                label = self.place.label(&["--slots", "2"]);
            }
            run.0.try_wait().unwrap().is_some()
        });
        assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", self.place.said());
        label.0.wait().unwrap();
        outcome_at(self.place.argument(), self.place.path());
        wait_until("nobody is left", || processes_in(self.place.path()).is_empty());
        on_store(self.place.location(), are_single)
    }

    /// The queue, as `queue list` has it.
    fn attempts(&self) -> Vec<Value> {
        let list = common::succeed(self.place.path(), ["queue", ".", "list", "--json"]);
        let jobs: Vec<Value> = serde_json::from_str(&list).unwrap();
        let show = |job: &Value| {
            let id = job["candidate"].as_str().unwrap();
            let text = common::succeed(self.place.path(), ["queue", ".", "show", id, "--json"]);
            let details: Value = serde_json::from_str(&text).unwrap();
            details["attempts_made"].as_array().unwrap().clone()
        };
        jobs.iter().flat_map(show).collect()
    }

    /// Kills whoever makes labels, with no time to tidy up.
    fn kill(&self, label: &mut Running) {
        carrying_out(self.place.path(), "labeller").into_iter().for_each(|pid| signal(pid, "KILL"));
        label.0.kill().unwrap();
        label.0.wait().unwrap();
    }
}

impl Drop for Jobs {
    fn drop(&mut self) {
        if std::thread::panicking() {
            ci("revive");
        }
        self.jobs().iter().for_each(|[id, ..]| drop(slurm(&["scancel", "--quiet", id])));
    }
}

fn slurm(arguments: &[&str]) -> String {
    let output = Command::new(arguments[0]).args(&arguments[1..]).output().expect("Slurm's commands");
    assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
    String::from_utf8(output.stdout).unwrap()
}

/// `.ci/slurm`, which started what is tested on.
fn ci(order: &str) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join(".ci/slurm");
    assert!(Command::new(script).arg(order).status().unwrap().success(), "{order}");
}

/// Each label once, and no other result beside it.
async fn are_single(store: &Store) -> usize {
    let protocol = store.protocols().await.unwrap()[0].hash;
    let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
    let rows = store.labelled(&filter, None, u32::MAX).await.unwrap();
    for row in &rows {
        let structure = wire::ContentHash::of(&row.structure);
        assert_eq!(store.label_history(structure, protocol).await.unwrap().len(), 1);
        assert_eq!((row.label.energy, row.label.forces[0]), (-1.5, [0.25, 0.0, 0.0]));
    }
    // Two walks may have come by the same structure.
    rows.iter().map(|row| wire::ContentHash::of(&row.structure).0).collect::<BTreeSet<_>>().len()
}

/// No job of a name was there twice, and no calculation begun twice; so many were.
fn once_each(jobs: &Jobs, expected: usize) {
    let mut names: Vec<_> = jobs.jobs().into_iter().map(|[_, _, name]| name).collect();
    let mut begun = jobs.begun();
    assert_eq!((names.len(), begun.len()), (expected, expected), "{names:?}\n{}", jobs.place.said());
    names.sort();
    names.dedup();
    begun.sort();
    begun.dedup();
    assert_eq!((names.len(), begun.len()), (expected, expected), "{names:?}");
}

#[test]
fn a_labeller_that_is_killed_is_followed_by_one_that_finds_its_job() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let mut label = jobs.place.label(&["--wait", "2"]);
    wait_until("a job is at work", || jobs.begun().len() == 1);
    let name = jobs.jobs()[0][2].clone();
    jobs.kill(&mut label);
    // As many as there are structures: none of them ends before it may.
    let label = jobs.place.label(&["--slots", "20"]);
    let waits = || {
        jobs.attempts()
            .iter()
            .filter(|a| a["calculation"].as_str().is_some_and(|c| c.contains(&name)))
            .count()
    };
    wait_until("another waits for the same job", || waits() == 2);
    jobs.go();
    let labels = jobs.finish(run, label);
    assert!(labels > 2);
    once_each(&jobs, labels);
    let seconds: f64 = jobs.attempts().iter().filter_map(|a| a["core_seconds"].as_f64()).sum();
    assert!(seconds > 0.0);
}

/// Its `sbatch` hangs, and goes on when the job was submitted by another already.
#[test]
fn a_job_that_is_submitted_twice_calculates_once() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let (bin, here) = (jobs.home.path().join("bin"), jobs.home.path().display());
    fs::create_dir(&bin).unwrap();
    let real = Command::new("sh").args(["-c", "command -v sbatch"]).output().unwrap().stdout;
    let real = String::from_utf8(real).unwrap();
    let slow = format!(
        "#!/bin/sh\necho $$ > {here}/asked\nwhile [ ! -e {here}/go ]; do sleep 0.1; done\n{} \"$@\"\ntouch {here}/late\n",
        real.trim()
    );
    fs::write(bin.join("sbatch"), slow).unwrap();
    fs::set_permissions(bin.join("sbatch"), fs::Permissions::from_mode(0o755)).unwrap();
    let path = std::env::join_paths(
        [bin].into_iter().chain(std::env::split_paths(&std::env::var_os("PATH").unwrap())),
    );
    let mut slowly = program(jobs.place.path());
    slowly.env("PATH", path.unwrap());
    let mut label = jobs.place.spawn(slowly, &["label", "--store", ".", "--wait", "2"]);
    wait_until("a job is being submitted", || jobs.home.path().join("asked").exists());
    jobs.kill(&mut label);
    assert!(jobs.jobs().is_empty() && jobs.begun().is_empty());
    let label = jobs.place.label(&["--slots", "2"]);
    wait_until("it is submitted by another", || !jobs.begun().is_empty());
    let first = PathBuf::from(&jobs.begun()[0]);
    jobs.go();
    let labels = jobs.finish(run, label);
    wait_until("it is submitted late", || jobs.home.path().join("late").exists());
    wait_until("that is over", || {
        jobs.jobs().iter().all(|[_, state, _]| state == "COMPLETED" || state == "FAILED")
    });
    assert_eq!(jobs.begun().len(), labels);
    assert_eq!(jobs.begun().iter().filter(|path| Path::new(path) == first).count(), 1);
}

#[test]
fn a_job_that_is_cancelled_is_lost_and_tried_again() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait", "2"]);
    wait_until("a job is at work", || jobs.begun().len() == 1);
    slurm(&["scancel", &jobs.jobs()[0][0]]);
    wait_until("it is begun again", || jobs.begun().len() == 2);
    jobs.go();
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels + 1);
    let attempts = jobs.attempts();
    let lost: Vec<_> = attempts.iter().filter(|attempt| attempt["class"] == "lost_node").collect();
    assert_eq!(lost.len(), 1, "{attempts:?}");
    assert!(lost[0]["log"].as_str().unwrap().contains("is CANCELLED"), "{lost:?}");
    // Whoever has ended it did not mean the node.
    assert!(!lost[0]["calculation"].as_str().unwrap().contains("node"), "{lost:?}");
}

#[test]
fn while_slurm_does_not_answer_nothing_is_concluded() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait", "2"]);
    wait_until("a job is at work", || jobs.begun().len() == 1);
    // Slurm has to have written down that it runs.
    let state = PathBuf::from(std::env::var_os("SLURM_CONF").unwrap()).with_file_name("state/job_state");
    let written = |path: &Path| fs::metadata(path).and_then(|file| file.modified()).ok();
    let begun = written(&jobs.home.path().join("begun"));
    wait_until("Slurm has written down the job", || written(&state) > begun);
    ci("kill");
    jobs.go();
    wait_until("its label is read without Slurm", || jobs.place.jobs("labelled") == 1);
    ci("revive");
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels);
    assert!(jobs.attempts().iter().all(|attempt| attempt["outcome"] == "labelled"));
}
