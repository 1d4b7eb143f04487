//! Campaigns on batch systems other than Slurm, with stand-ins for the commands of PBS and LSF. `tests/external` has campaigns on a real
//! Slurm.

use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::Value;
use tempfile::TempDir;

use crate::common::campaign::{Outcome, Small, outcome_at};
use crate::common::hosts::uninterrupted_outcome;
use crate::common::label_campaign::{LabelCampaign, WRITE_FIXED_LABEL, check_single_labels, on_store};
use crate::common::processes::{assert_no_leftovers, processes_in, processes_running, signal, wait_until};
use crate::common::stand_in::StandIn;
use crate::common::{Running, calmwalk, program, stderr, succeed};

/// A campaign that is launched on a stand-in.
struct Launched {
    home: TempDir,
    system: StandIn,
}

impl Launched {
    /// A campaign that cannot end before [`Self::label`], however fast the machine: it has no labellers, and a small limit on the
    /// label queue.
    fn new(small: &Small, system: StandIn) -> Self {
        let home = tempfile::tempdir().unwrap();
        let path = small.write(home.path());
        let text = fs::read_to_string(&path).unwrap();
        let text = text.replacen("[label]\n", "[label]\nconcurrency = 0\nqueue_limit = 4\n", 1);
        fs::write(path, format!("{text}\n{}", system.table())).unwrap();
        Self { home, system }
    }

    fn directory(&self) -> &Path {
        self.home.path()
    }

    fn command(&self) -> Command {
        let mut command = program(self.directory());
        self.system.known_to(&mut command);
        command
    }

    fn launch(&self, options: &[&str]) -> Output {
        let mut command = self.command();
        command.args(["launch", "campaign.toml", "--on", "custom", "--directory", "."]).args(options);
        command.output().unwrap()
    }

    fn launched(&self, options: &[&str]) -> String {
        let output = self.launch(options);
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        String::from_utf8(output.stdout).unwrap()
    }

    fn status(&self) -> Value {
        let output = self.command().args(["status", ".", "--json"]).output().unwrap();
        serde_json::from_slice(&output.stdout).unwrap_or_default()
    }

    fn logs(&self) -> String {
        let entries = fs::read_dir(self.directory().join("jobs")).unwrap().map(|entry| entry.unwrap().path());
        let logs = entries.filter(|path| path.extension().is_some_and(|end| end == "log" || end == "out"));
        logs.map(|path| format!("==> {}\n{}", path.display(), fs::read_to_string(&path).unwrap())).collect()
    }

    /// Waits until the orchestrator, its walker and an agent with its walker run.
    fn at_work(&self) {
        wait_until("all processes are running", || {
            ["run", "agent"].iter().all(|name| processes_running(self.directory(), name).len() == 1)
                && processes_running(self.directory(), "walker").len() == 2
        });
    }

    /// Makes all labels, once walkers wait for them.
    fn label(&self) {
        wait_until("walkers wait", || self.status()["labels"]["queued"].as_u64() >= Some(4));
        let mut labels = program(self.directory());
        labels.args(["label", "--store", "."]).stdout(Stdio::null()).stderr(Stdio::null());
        let mut labels = Running(labels.spawn().unwrap());
        assert_eq!(labels.0.wait().unwrap().code(), Some(0), "{}", self.logs());
    }

    fn comes_to(&self, expected: &Outcome) {
        wait_until("the jobs have ended", || {
            self.system.in_state("PEND").is_empty() && self.system.in_state("RUN").is_empty()
        });
        let text = self.logs();
        assert_eq!(fs::read_to_string(self.directory().join("endpoint")).unwrap(), "over\n", "{text}");
        assert_no_leftovers(self.directory());
        assert!(outcome_at(".", self.directory()) == *expected, "{text}");
    }
}

#[test]
fn a_campaign_on_pbs_ends_as_one_without() {
    let small = Small { walkers: 1, ..Small::default() };
    let campaign = Launched::new(&small, StandIn::new("pbs"));
    let resources = ["--agents=1", "--gpus=2", "--memory=3", "--time=2:00:00"];
    let shown = campaign.launched(&[&resources[..], &["--dry-run"]].concat());
    for expected in [
        "#PBS -l select=1:ncpus=1:ngpus=2:mem=2862mb",
        "#PBS -l walltime=02:00:00",
        "limit=7080",
        "env CALMWALK_GPUS=2 ",
        "\nqsub ",
        "--resubmit",
    ] {
        assert!(shown.contains(expected), "{expected}: {shown}");
    }
    assert!(campaign.system.jobs().is_empty() && !campaign.directory().join("jobs").exists());
    campaign.system.hold(true);
    let said = campaign.launched(&resources);
    assert_eq!(said, "orchestrator: job 1000.pbs01 submitted\nagent 0: job 1001.pbs01 submitted\n");
    assert_eq!(campaign.system.about(1001, "after"), "1000");
    assert_eq!(campaign.launched(&resources).matches("(PENDING) kept").count(), 2);
    // Walkers of another number are other jobs.
    let said = campaign.launched(&[&resources[..], &["--walkers=2"]].concat());
    assert!(
        said.contains("job 1001.pbs01 (PENDING) cancelled") && said.contains("1002.pbs01 submitted"),
        "{said}"
    );
    campaign.launched(&resources);
    campaign.system.hold(false);
    campaign.at_work();
    let jobs = campaign.status()["jobs"].clone();
    let shown = |job: usize| [&jobs[job]["kind"], &jobs[job]["id"], &jobs[job]["state"]].map(Value::clone);
    assert_eq!(shown(0), ["orchestrator", "1000.pbs01", "RUNNING"], "{jobs}");
    assert_eq!(shown(1), ["agent", "1003.pbs01", "RUNNING"], "{jobs}");
    assert_eq!(jobs[1]["walkers"], 1);
    campaign.label();
    campaign.comes_to(&uninterrupted_outcome(&small));
    assert_eq!(campaign.system.in_state("DONE"), [1000, 1003], "{}", campaign.logs());
}

#[test]
fn jobs_on_lsf_submit_themselves_again_until_they_are_stopped() {
    let small = Small { walkers: 1, ..Small::default() };
    let campaign = Launched::new(&small, StandIn::new("lsf"));
    campaign.launched(&["--agents=1"]);
    campaign.at_work();
    // As at its time limit: the job's own script asks it to stop.
    signal(processes_running(campaign.directory(), "run")[0], "TERM");
    wait_until("both jobs are submitted again", || campaign.system.jobs().len() == 4);
    campaign.at_work();
    let recorded = campaign.system.recorded(campaign.directory());
    let roles: Vec<_> = recorded.iter().map(|(role, _)| role.as_str()).collect();
    assert!(
        roles.len() == 2 && roles.contains(&"orchestrator") && roles.contains(&"agent-0"),
        "{recorded:?}"
    );
    assert_eq!(campaign.launched(&["--agents=1"]).matches("(RUNNING) kept").count(), 2);
    // The jobs checkpoint, and stay away.
    assert_eq!(campaign.launched(&["--stop"]), "2 jobs cancelled\n");
    wait_until("every job has ended", || campaign.system.in_state("EXIT").len() == 4);
    assert_no_leftovers(campaign.directory());
    assert_eq!(campaign.system.jobs().len(), 4, "{}", campaign.logs());
    assert_eq!(campaign.status()["finished"], false);
    assert_eq!(campaign.launched(&["--agents=1"]).matches("submitted").count(), 2);
    // A job that its user cancels is launched again, by the user.
    campaign.at_work();
    campaign.system.cancel(1005);
    wait_until("the agent has ended", || processes_running(campaign.directory(), "agent").is_empty());
    wait_until("its job has ended", || campaign.system.about(1005, "state") == "EXIT");
    let said = campaign.launched(&["--agents=1"]);
    assert_eq!(said, "orchestrator: job 1004 (RUNNING) kept\nagent 0: job 1006 submitted\n");
    campaign.label();
    campaign.comes_to(&uninterrupted_outcome(&small));
}

/// Appends its directory to `begun`, and ends once `go` exists.
const SCRIPT: &str = r#"
pwd >> $HERE/begun
while [ ! -e $HERE/go ]; do sleep 0.1; done
"#;

#[test]
fn labels_are_jobs_on_a_batch_system_of_ones_own() {
    for name in ["pbs", "lsf"] {
        let (system, home) = (StandIn::new(name), tempfile::tempdir().unwrap());
        let scratch = home.path().canonicalize().unwrap().join("scratch");
        fs::create_dir(&scratch).unwrap();
        let keys = format!(
            "[label]\nconcurrency = 0\nbatch_system = \"custom\"\npass_environment = [\"STAND_IN_QUEUE\"]\nscratch = {:?}\n\
             method = {{ command = {{ command = [\"sh\", \"label.sh\"], files = [\"label.sh\"], version = \"1\" }} }} # ",
            scratch.display().to_string()
        );
        let small = Small { walkers: 1, steps: 120, ..Small::default() };
        let tables = format!("{}\n[run]\n", system.table());
        let place = LabelCampaign::new(&small, &[("[label]\nmethod", &keys), ("[run]\n", &tables)]);
        let script = SCRIPT.replace("$HERE", &home.path().display().to_string());
        fs::write(place.path().join("label.sh"), script + WRITE_FIXED_LABEL).unwrap();
        let begun = || fs::read_to_string(home.path().join("begun")).unwrap_or_default().lines().count();
        let start = |arguments: &[&str]| {
            let mut command = program(place.path());
            system.known_to(&mut command);
            place.spawn(command, arguments)
        };
        let label = |further: &[&str]| start(&[&["label", "--store", place.argument()], further].concat());
        let mut run = start(&["run", "campaign.toml", "--directory", "."]);
        let mut first = label(&["--wait-timeout", "2m"]);
        wait_until("a job is running", || begun() == 1);
        // The labeller is killed; the next one finds the job.
        processes_running(place.path(), "labeller").into_iter().for_each(|pid| signal(pid, "KILL"));
        first.0.kill().unwrap();
        first.0.wait().unwrap();
        let mut second = label(&["--concurrency", "20"]);
        let waits = || {
            let list: Value =
                serde_json::from_str(&succeed(place.path(), ["queue", ".", "list", "--json"])).unwrap();
            list.as_array().unwrap().iter().filter(|job| job["state"] == "leased").count()
        };
        wait_until("the structures are leased", || waits() > 1 && begun() > 1);
        fs::write(home.path().join("go"), "").unwrap();
        wait_until("the campaign has ended", || {
            if second.0.try_wait().unwrap().is_some() {
                second = label(&["--concurrency", "2"]);
            }
            run.0.try_wait().unwrap().is_some()
        });
        assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", place.said());
        second.0.wait().unwrap();
        wait_until("all processes have exited", || processes_in(place.path()).is_empty());
        let labels = on_store(place.location(), check_single_labels);
        // Each job once, although the first labeller was killed.
        assert_eq!((begun(), system.jobs().len()), (labels, labels), "{}", place.said());
        assert_eq!(fs::read_dir(&scratch).unwrap().count(), 0, "directories of calculations");
    }
}

#[test]
fn wrong_launches_name_key_and_remedy() {
    let small = Small::default();
    let campaign = Launched::new(&small, StandIn::new("pbs"));
    let refused = |options: &[&str]| {
        let output = campaign.launch(options);
        assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
        stderr(&output)
    };
    let said = refused(&["--agents=0", "--partition=long"]);
    assert!(
        said.contains("--partition is for --on slurm") && said.contains("launch.custom.script"),
        "{said}"
    );
    let said = refused(&["--agents=0", "--time=2"]);
    assert!(said.contains("expected a time with its unit, such as 24h"), "{said}");
    let said = refused(&["--resubmit"]);
    assert!(said.contains("CALMWALK_JOB"), "{said}");
    let path = campaign.directory().join("campaign.toml");
    let text = fs::read_to_string(&path).unwrap();
    for (from, to, expected) in [
        (
            "{command}\n",
            "{comand}\n",
            "launch.custom.script is a script without it; expected a script with {command}",
        ),
        ("cd {directory}", "cd {folder}", "in place of {folder}"),
        ("poll = ", "pol = ", "unknown key `pol`"),
        ("qdel {id}", "qdel", "launch.custom.cancel is \"qdel\"; expected a text with {id}"),
        (
            "[label]\n",
            "[label]\nbatch_system = \"custom\"\nbatch_options = [\"-q long\"]\n",
            "label.batch_options is \"-q long\"",
        ),
    ] {
        assert!(text.contains(from), "{from}");
        fs::write(&path, text.replacen(from, to, 1)).unwrap();
        let said = stderr(&calmwalk(campaign.directory(), ["validate", "campaign.toml"]));
        assert!(said.contains(expected), "{expected}: {said}");
    }
    // The command is not on this host.
    fs::write(&path, text.replacen("\"qsub ", "\"qsub-elsewhere ", 1)).unwrap();
    let output = campaign.launch(&["--agents=0"]);
    assert_eq!(output.status.code(), Some(1));
    let said = stderr(&output);
    assert!(
        said.contains("(launch.custom.submit) failed with exit status: 127") && said.contains("not found"),
        "{said}"
    );
    // Without the table.
    let (before, _) = text.split_once("[launch.custom]").unwrap();
    fs::write(&path, before).unwrap();
    let said = refused(&["--agents=0"]);
    assert!(said.contains("has no table [launch.custom]") && said.contains("configs/pbs.toml"), "{said}");
}
