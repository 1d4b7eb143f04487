//! A campaign whose labels are made by Slurm jobs.

use std::fs;
use std::path::Path;
use std::sync::MutexGuard;

use serde_json::Value;
use tempfile::TempDir;

use crate::common::campaign::{Small, outcome_at};
use crate::common::label_campaign::{LabelCampaign, WRITE_FIXED_LABEL, check_single_labels, on_store};
use crate::common::processes::{processes_in, processes_running, signal, wait_until};
use crate::common::slurm::{ci, hold, slurm};
use crate::common::{Running, succeed};

/// Appends its directory to `begun`, and ends once `go` exists; takes 400 MB if `eat` exists.
const SCRIPT: &str = r#"
pwd >> $HERE/begun
if [ -e $HERE/eat ]; then
    { head -c 400000000 /dev/zero; sleep 600; } | tail
fi
while [ ! -e $HERE/go ]; do sleep 0.1; done
"#;

/// A campaign that submits one job per label.
pub struct Jobs {
    pub place: LabelCampaign,
    /// Contains the scratch directory, and the files that control the script.
    pub home: TempDir,
    _node: MutexGuard<'static, ()>,
}

impl Jobs {
    pub fn new() -> Self {
        Self::with("", "--comment=label")
    }

    /// Adds keys to `[label]`, and an option of `sbatch`.
    pub fn with(more: &str, option: &str) -> Self {
        let keys = format!("{more}\nbatch_system = \"slurm\"\nbatch_options = [{option:?}]");
        Self::calling(r#"["sh", "label.sh"]"#, &keys)
    }

    /// Uses this command, with keys in `[label]`.
    pub fn calling(command: &str, keys: &str) -> Self {
        let _node = hold();
        let home = tempfile::tempdir().unwrap();
        let scratch = home.path().canonicalize().unwrap().join("scratch");
        fs::create_dir(&scratch).unwrap();
        let command =
            format!(r#"{{ command = {{ command = {command}, files = ["label.sh"], version = "1" }} }}"#);
        let keys = format!(
            "[label]\n{keys}\nconcurrency = 0\nscratch = {:?}\nmethod = {command} # ",
            scratch.display().to_string()
        );
        let small = Small { walkers: 1, steps: 120, ..Small::default() };
        let place = LabelCampaign::new(&small, &[("[label]\nmethod", &keys)]);
        let script = SCRIPT.replace("$HERE", &home.path().display().to_string());
        fs::write(place.path().join("label.sh"), script + WRITE_FIXED_LABEL).unwrap();
        Self { place, home, _node }
    }

    /// Lets every calculation end.
    pub fn go(&self) {
        fs::write(self.home.path().join("go"), "").unwrap();
    }

    /// Directories of the calculations that have started, once per start.
    pub fn begun(&self) -> Vec<String> {
        let text = fs::read_to_string(self.home.path().join("begun")).unwrap_or_default();
        text.lines().map(str::to_owned).collect()
    }

    /// Id, state and name of each job that Slurm knows, oldest first.
    pub fn jobs(&self) -> Vec<[String; 3]> {
        self.squeue("%i|%T|%j")
    }

    /// Three fields of each job, given in the format of `squeue --format`.
    pub fn squeue(&self, format: &str) -> Vec<[String; 3]> {
        let format = format!("--format={format}|%Z|%T%N");
        let text = slurm(&["squeue", "--noheader", "--states=all", "--sort=i", &format]);
        let scratch = self.home.path().canonicalize().unwrap();
        let job = |line: &str| {
            let [a, b, c, directory, end] = line.split('|').collect::<Vec<_>>()[..] else { panic!("{line}") };
            // A failed job without a node was refused at submission.
            let ours = Path::new(directory).starts_with(&scratch) && end != "FAILED";
            ours.then(|| [a, b, c].map(str::to_owned))
        };
        text.lines().filter_map(job).collect()
    }

    /// Waits for the end of the campaign, and checks that each structure has one label. Returns the number of labels.
    pub fn finish(&self, mut run: Running, mut label: Running) -> usize {
        wait_until("the campaign has ended", || {
            if label.0.try_wait().unwrap().is_some() {
                label = self.place.label(&["--concurrency", "2"]);
            }
            run.0.try_wait().unwrap().is_some()
        });
        assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", self.place.said());
        label.0.wait().unwrap();
        outcome_at(self.place.argument(), self.place.path());
        wait_until("all processes have exited", || processes_in(self.place.path()).is_empty());
        on_store(self.place.location(), check_single_labels)
    }

    /// The attempts at every job, as `queue show` lists them.
    pub fn attempts(&self) -> Vec<Value> {
        let list = succeed(self.place.path(), ["queue", ".", "list", "--json"]);
        let jobs: Vec<Value> = serde_json::from_str(&list).unwrap();
        let show = |job: &Value| {
            let id = job["candidate"].as_str().unwrap();
            let text = succeed(self.place.path(), ["queue", ".", "show", id, "--json"]);
            let details: Value = serde_json::from_str(&text).unwrap();
            details["attempts_made"].as_array().unwrap().clone()
        };
        jobs.iter().flat_map(show).collect()
    }

    /// Kills all labellers, so that they cannot clean up.
    pub fn kill(&self, label: &mut Running) {
        processes_running(self.place.path(), "labeller").into_iter().for_each(|pid| signal(pid, "KILL"));
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

/// The only failed attempt, which must have this class.
pub fn only(jobs: &Jobs, class: &str) -> Value {
    let attempts = jobs.attempts();
    let failed: Vec<_> = attempts.into_iter().filter(|attempt| !attempt["class"].is_null()).collect();
    let [only] = &failed[..] else { panic!("{class}: {failed:#?}\n{}", jobs.place.said()) };
    assert_eq!(only["class"], class, "{only:#}");
    only.clone()
}

/// Checks the number of jobs and of calculations, and that no job name and no calculation occurs twice.
pub fn once_each(jobs: &Jobs, expected: usize) {
    let mut names: Vec<_> = jobs.jobs().into_iter().map(|[_, _, name]| name).collect();
    let mut begun = jobs.begun();
    assert_eq!((names.len(), begun.len()), (expected, expected), "{names:?}\n{}", jobs.place.said());
    names.sort();
    names.dedup();
    begun.sort();
    begun.dedup();
    assert_eq!((names.len(), begun.len()), (expected, expected), "{names:?}");
}
