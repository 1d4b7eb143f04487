//! Campaigns on a real Slurm, one of them stored on a PostgreSQL server:
//! `SLURM_CONF=$(.ci/slurm start) CALMWALK_POSTGRES=$(.ci/postgres start) cargo test --test external slurm::`.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::MutexGuard;
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;

use crate::common;
use crate::common::campaign::{Outcome, Small, outcome_at};
use crate::common::hosts::uninterrupted_outcome;
use crate::common::processes::{assert_no_leftovers, processes_running, wait_until};
use crate::common::slurm::{FullQueue, ci, hold, slurm};
use crate::common::{Running, calmwalk, program, stderr, succeed};

/// A campaign that is launched on Slurm.
struct OnSlurm {
    home: TempDir,
    /// Location of the campaign, as an argument of commands in its directory.
    location: String,
    options: Vec<String>,
    _node: MutexGuard<'static, ()>,
}

/// What Slurm knows of a job.
#[derive(Clone, Debug)]
struct Job {
    id: String,
    state: String,
}

/// A campaign that takes some seconds.
fn long() -> Small {
    Small {
        walkers: 1,
        walks_per_round: 3,
        steps: 600,
        seed_structures: &["fcc-100", "vacancy", "fcc-097"],
        ..Small::default()
    }
}

/// The node of the jobs' partition.
fn this_node() -> String {
    slurm(&["sinfo", "--noheader", "--partition=all", "--format=%N"]).trim().to_owned()
}

impl OnSlurm {
    fn new(small: &Small, agents: u32) -> Self {
        let _node = hold();
        let home = tempfile::tempdir().unwrap();
        small.write(home.path());
        let options = vec![format!("--agents={agents}"), "--".into(), format!("--nodelist={}", this_node())];
        let campaign = Self { home, location: ".".into(), options, _node };
        campaign.changed("[run]\n", "[run]\nagent_heartbeat_timeout = \"2s\"\n");
        campaign
    }

    /// A campaign stored on a server, whose labels are made by labeller jobs.
    fn on_a_server(small: &Small, agents: u32, labellers: u32) -> Self {
        let server = std::env::var("CALMWALK_POSTGRES");
        let server = server.expect("CALMWALK_POSTGRES=$(.ci/postgres start) is needed");
        let mut campaign = Self::new(small, agents);
        campaign.location =
            format!("{server}?schema=slurm_{}_{}", std::process::id(), store::unix_milliseconds());
        campaign.changed("[run]\n", &format!("[run]\nstore = \"{}\"\n", campaign.location));
        campaign.changed("[label]\n", "[label]\nconcurrency = 0\n");
        campaign.options.insert(1, format!("--labellers={labellers}"));
        campaign
    }

    /// A campaign that cannot end before [`Self::labelled`], however fast the machine: it has no labellers, and a small limit
    /// on the label queue.
    fn unlabelled(small: &Small, agents: u32) -> Self {
        let campaign = Self::new(small, agents);
        campaign.changed("[label]\n", "[label]\nconcurrency = 0\nqueue_limit = 4\n");
        campaign
    }

    /// Makes all labels, once walkers wait for them.
    fn labelled(&self) {
        // The campaign may not exist yet.
        let waiting = || {
            let status = calmwalk(self.directory(), ["status", ".", "--json"]).stdout;
            serde_json::from_slice::<Value>(&status).unwrap_or_default()["labels"]["queued"].as_u64()
        };
        wait_until("walkers wait", || waiting() >= Some(4));
        let mut labels = program(self.directory());
        labels.args(["label", "--store", "."]).stdout(Stdio::null()).stderr(Stdio::null());
        let mut labels = Running(labels.spawn().unwrap());
        assert_eq!(labels.0.wait().unwrap().code(), Some(0), "{}", self.logs());
    }

    /// Replaces text in its configuration.
    fn changed(&self, from: &str, to: &str) {
        let path = self.directory().join("campaign.toml");
        let text = fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "no {from}");
        fs::write(&path, text.replacen(from, to, 1)).unwrap();
    }

    fn directory(&self) -> &Path {
        self.home.path()
    }

    fn launch(&self) -> Command {
        let mut command = program(self.directory());
        command.args(["launch", "campaign.toml", "--on", "slurm", "--directory", "."]);
        command
    }

    /// Launches the campaign. Returns the standard output.
    fn launched(&self) -> String {
        said(self.launch().args(&self.options).output().unwrap())
    }

    fn stop(&self) -> String {
        said(self.launch().arg("--stop").output().unwrap())
    }

    /// Every job of this campaign that Slurm knows, by role.
    fn jobs(&self) -> BTreeMap<String, Vec<Job>> {
        let here = self.directory().canonicalize().unwrap();
        let text = slurm(&["squeue", "--noheader", "--states=all", "--format=%i|%T|%j|%Z"]);
        let mut jobs: BTreeMap<String, Vec<Job>> = BTreeMap::new();
        for line in text.lines() {
            let fields: Vec<_> = line.split('|').collect();
            if Path::new(fields[3]) == here {
                let role = fields[2].splitn(3, '-').nth(2).unwrap().to_owned();
                let job = Job { id: fields[0].to_owned(), state: fields[1].to_owned() };
                jobs.entry(role).or_default().push(job);
            }
        }
        jobs
    }

    /// The only job with this role.
    fn job(&self, role: &str) -> Job {
        let jobs = self.jobs();
        let [job] = &jobs[role][..] else { panic!("{role}: {jobs:?}") };
        job.clone()
    }

    fn logs(&self) -> String {
        let logs = fs::read_dir(self.directory().join("slurm")).unwrap().map(|entry| entry.unwrap().path());
        let logs = logs.filter(|path| path.extension().is_some_and(|ending| ending == "log"));
        logs.map(|path| format!("==> {}\n{}", path.display(), fs::read_to_string(&path).unwrap())).collect()
    }

    fn log(&self, role: &str) -> String {
        fs::read_to_string(self.directory().join(format!("slurm/{role}.log"))).unwrap_or_default()
    }

    /// Waits until the walkers and agents run.
    fn at_work(&self, agents: usize) {
        let walkers = || processes_running(self.directory(), "walker").len();
        let joined = || processes_running(self.directory(), "agent").len();
        wait_until("all processes are running", || walkers() > agents && joined() == agents);
    }

    /// Waits until every job has ended, and checks that the orchestrator's has succeeded.
    fn finished(&self) {
        let begun = Instant::now();
        let over = |state: &str| ["COMPLETED", "CANCELLED", "FAILED", "TIMEOUT"].contains(&state);
        while !self.jobs().values().flatten().all(|job| over(&job.state)) {
            assert!(begun.elapsed() < Duration::from_secs(240), "{:?}\n{}", self.jobs(), self.logs());
            std::thread::sleep(Duration::from_millis(200));
        }
        let last = self.jobs()["orchestrator"].last().unwrap().clone();
        assert_eq!(last.state, "COMPLETED", "{}", self.logs());
        assert_eq!(fs::read_to_string(self.directory().join("endpoint")).unwrap(), "over\n");
        assert_no_leftovers(self.directory());
    }

    /// Checks that no job has failed. An agent that waited to continue when the campaign ended is cancelled.
    fn no_job_failed(&self) {
        let good = |job: &Job| ["COMPLETED", "CANCELLED"].contains(&job.state.as_str());
        assert!(self.jobs().values().flatten().all(good), "{:?}\n{}", self.jobs(), self.logs());
    }

    fn comes_to(&self, expected: &Outcome) {
        self.finished();
        assert!(outcome_at(&self.location, self.directory()) == *expected, "{}", self.logs());
    }

    fn status(&self) -> Value {
        serde_json::from_str(&succeed(self.directory(), ["status", &self.location, "--json"])).unwrap()
    }
}

impl Drop for OnSlurm {
    fn drop(&mut self) {
        // A failed test may have left slurmctld dead, and the next one needs it.
        if std::thread::panicking() {
            ci("revive");
        }
        for job in self.jobs().values().flatten() {
            slurm(&["scancel", "--quiet", &job.id]);
        }
    }
}

fn said(output: Output) -> String {
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    String::from_utf8(output.stdout).unwrap()
}

fn restarts(id: &str) -> u32 {
    let text = slurm(&["scontrol", "--oneliner", "show", "job", id]);
    text.split_whitespace().find_map(|word| word.strip_prefix("Restarts=")?.parse().ok()).unwrap()
}

/// Whether Slurm is full of its own jobs or of others': `launch` waits for a slot, and submits each job once.
#[test]
fn a_launch_waits_while_slurm_accepts_no_jobs() {
    let campaign = OnSlurm::unlabelled(&Small::default(), 1);
    let full = FullQueue::new();
    let (said, errors) = (campaign.directory().join("said"), campaign.directory().join("errors"));
    let [out, err] = [&said, &errors].map(|path| fs::File::create(path).unwrap());
    let mut launch =
        Running(campaign.launch().args(&campaign.options).stdout(out).stderr(err).spawn().unwrap());
    full.wait_for_refusals(3);
    let text = || fs::read_to_string(&errors).unwrap();
    let refused = "orchestrator: Slurm accepts no further jobs for now (Slurm temporarily unable to accept job); waiting";
    assert_eq!(text().matches(refused).count(), 1, "{}", text());
    assert!(launch.0.try_wait().unwrap().is_none() && campaign.jobs().is_empty());
    drop(full);
    assert_eq!(launch.0.wait().unwrap().code(), Some(0), "{}", text());
    assert_eq!(fs::read_to_string(&said).unwrap().matches("submitted").count(), 2);
    for role in ["orchestrator", "agent-0"] {
        campaign.job(role);
    }
    campaign.stop();
}

#[test]
fn repeated_launches_do_not_change_the_outcome() {
    let small = long();
    let campaign = OnSlurm::unlabelled(&small, 2);
    assert_eq!(campaign.launched().matches("submitted").count(), 3);
    assert_eq!(campaign.launched().matches(" kept").count(), 3);
    campaign.at_work(2);
    let twice = [(); 2].map(|()| {
        let mut launch = campaign.launch();
        Running(launch.args(&campaign.options).stdout(Stdio::null()).spawn().unwrap())
    });
    for mut launch in twice {
        assert_eq!(launch.0.wait().unwrap().code(), Some(0));
    }
    let status = campaign.status();
    let jobs: Vec<_> = status["jobs"].as_array().unwrap().iter().map(|job| job["state"].clone()).collect();
    assert_eq!(jobs, ["RUNNING"; 3], "{status}");
    assert_eq!(status["jobs"][1]["walkers"], 1);
    campaign.labelled();
    campaign.comes_to(&uninterrupted_outcome(&small));
    for role in ["orchestrator", "agent-0", "agent-1"] {
        let job = campaign.job(role);
        assert_eq!((job.state.as_str(), restarts(&job.id)), ("COMPLETED", 0), "{}", campaign.logs());
    }
    // Launch the finished campaign again: all jobs exit.
    assert_eq!(campaign.launched().matches("submitted").count(), 3);
    campaign.finished();
}

#[test]
fn concurrent_launches_submit_each_job_once() {
    let campaign = OnSlurm::unlabelled(&long(), 3);
    let launches = [(); 4].map(|()| {
        let mut launch = campaign.launch();
        Running(launch.args(&campaign.options).stdout(Stdio::null()).spawn().unwrap())
    });
    for mut launch in launches {
        assert_eq!(launch.0.wait().unwrap().code(), Some(0));
    }
    let jobs = campaign.jobs();
    let roles: Vec<_> = jobs.keys().map(String::as_str).collect();
    assert_eq!(roles, ["agent-0", "agent-1", "agent-2", "orchestrator"]);
    assert!(jobs.values().all(|jobs| jobs.len() == 1), "{jobs:?}");
    // Without a lock, Slurm still holds back the second job of the same name.
    let name = slurm(&["squeue", "--noheader", "--format=%j", "--jobs", &jobs["agent-0"][0].id]);
    let script = campaign.directory().join("slurm/agent.sbatch");
    let second = slurm(&[
        "sbatch",
        "--parsable",
        &format!("--job-name={}", name.trim()),
        "--dependency=singleton",
        &format!("--chdir={}", campaign.directory().display()),
        "--output=/dev/null",
        script.to_str().unwrap(),
    ]);
    campaign.at_work(3);
    let states: Vec<_> = campaign.jobs()["agent-0"].iter().map(|job| job.state.clone()).collect();
    assert!(states.contains(&"PENDING".to_owned()) && states.contains(&"RUNNING".to_owned()), "{states:?}");
    // The next launch cancels it, and an agent that is no longer requested.
    let fewer = [&["--agents=2".to_owned()], &campaign.options[1..]].concat();
    let text = said(campaign.launch().args(fewer).output().unwrap());
    assert!(text.contains(&format!("job {} (PENDING) cancelled", second.trim())), "{text}");
    assert_eq!(text.matches(") cancelled").count(), 2, "{text}");
    campaign.labelled();
    campaign.finished();
}

#[test]
fn a_signalled_campaign_stops_and_continues_when_it_is_requeued() {
    let small = long();
    let campaign = OnSlurm::unlabelled(&small, 2);
    campaign.launched();
    campaign.at_work(2);
    let agent = campaign.job("agent-0").id;
    slurm(&["scancel", "--batch", "--signal=TERM", &agent]);
    wait_until("the agent is requeued", || restarts(&agent) == 1);
    let orchestrator = campaign.job("orchestrator").id;
    slurm(&["scancel", "--batch", "--signal=TERM", &orchestrator]);
    wait_until("the orchestrator is requeued", || restarts(&orchestrator) == 1);
    campaign.labelled();
    campaign.comes_to(&uninterrupted_outcome(&small));
    assert!(campaign.log("orchestrator").contains("exit code 130"), "{}", campaign.logs());
    campaign.no_job_failed();
}

/// One minute is Slurm's shortest time limit.
#[test]
fn a_job_is_signalled_before_its_time_limit_and_requeued() {
    let small = long();
    let mut campaign = OnSlurm::unlabelled(&small, 1);
    let site = campaign.directory().join("site");
    fs::create_dir(&site).unwrap();
    for name in ["orchestrator.sbatch", "agent.sbatch", "labeller.sbatch", "job.sh"] {
        let text = fs::read_to_string(common::config(&format!("slurm/{name}"))).unwrap();
        fs::write(site.join(name), text.replace("TERM@120", "TERM@59")).unwrap();
    }
    campaign.options.splice(1..1, ["--time=1m".into(), format!("--template={}", site.display())]);
    campaign.launched();
    let orchestrator = campaign.job("orchestrator").id;
    wait_until("the job is signalled and requeued", || restarts(&orchestrator) == 1);
    campaign.labelled();
    campaign.comes_to(&uninterrupted_outcome(&small));
    campaign.no_job_failed();
}

/// `SLURM_CONF=$(.ci/slurm start) CALMWALK_POSTGRES=$(.ci/postgres start) cargo test --test external slurm:: server`
#[test]
fn on_a_server_jobs_make_the_labels() {
    let small = long();
    let campaign = OnSlurm::on_a_server(&small, 1, 2);
    assert_eq!(campaign.launched().matches("submitted").count(), 4);
    campaign.at_work(1);
    wait_until("labels are made", || campaign.status()["labels"]["labelled"].as_u64() > Some(0));
    let labellers = || campaign.jobs().into_iter().filter(|(role, _)| role.starts_with("labeller-"));
    assert_eq!(labellers().count(), 2);
    // The same campaign is found under another form of its URL.
    let another_way =
        campaign.location.replacen("postgres://", "postgresql://", 1) + "&application_name=look";
    let text = succeed(campaign.directory(), ["status", &another_way]);
    assert!(text.contains("labeller 1") && text.contains("running"), "{text}");
    campaign.comes_to(&uninterrupted_outcome(&small));
    campaign.no_job_failed();
    let made: Vec<_> = labellers().map(|(role, _)| campaign.log(&role)).collect();
    assert!(made.iter().all(|log| log.contains("exit code 0")), "{made:?}");
}

#[test]
fn a_cancelled_agent_is_launched_again() {
    let small = long();
    let campaign = OnSlurm::unlabelled(&small, 2);
    campaign.launched();
    campaign.at_work(2);
    let agent = campaign.job("agent-1").id;
    slurm(&["scancel", &agent]);
    wait_until("the job is cancelled", || campaign.job("agent-1").state == "CANCELLED");
    assert_eq!(restarts(&agent), 0, "{}", campaign.log("agent-1"));
    let again = campaign.launched();
    assert_eq!((again.matches("submitted").count(), again.matches(" kept").count()), (1, 2), "{again}");
    assert!(again.contains("agent 1: job"), "{again}");
    campaign.labelled();
    campaign.comes_to(&uninterrupted_outcome(&small));
}

#[test]
fn a_campaign_survives_the_loss_of_slurmctld() {
    let small = long();
    let campaign = OnSlurm::unlabelled(&small, 2);
    campaign.launched();
    campaign.at_work(2);
    // Slurm may take this long to save the state of its jobs.
    std::thread::sleep(Duration::from_secs(6));
    ci("kill");
    let asked = Instant::now();
    let text = succeed(campaign.directory(), ["status", "."]);
    assert!(text.contains("no answer from the batch system"), "{text}");
    assert!(asked.elapsed() < Duration::from_secs(20));
    assert!(campaign.status()["jobs_unknown"].is_string());
    assert_eq!(processes_running(campaign.directory(), "agent").len(), 2, "the agents continue");
    ci("revive");
    campaign.labelled();
    campaign.comes_to(&uninterrupted_outcome(&small));
}

#[test]
fn a_campaign_is_stopped_in_order_and_launched_again() {
    let small = long();
    let campaign = OnSlurm::unlabelled(&small, 2);
    campaign.launched();
    campaign.at_work(2);
    let text = campaign.stop();
    assert!(text.contains("3 jobs cancelled"), "{text}");
    wait_until("every job is cancelled", || {
        campaign.jobs().values().flatten().all(|job| job.state == "CANCELLED")
    });
    assert_no_leftovers(campaign.directory());
    assert!(
        campaign.log("orchestrator").contains("stopped; run the same command again"),
        "{}",
        campaign.logs()
    );
    let status = campaign.status();
    assert_eq!(status["finished"], false);
    // The signal may have killed a walker that was just starting, which is recorded.
    let processes = status["processes"].as_array().unwrap();
    assert!(processes.iter().all(|process| process["state"] != "running"), "{status}");
    assert_eq!(campaign.launched().matches("submitted").count(), 3);
    campaign.labelled();
    campaign.comes_to(&uninterrupted_outcome(&small));
}

#[test]
fn with_certificates_agents_reach_the_orchestrator_by_the_name_of_its_node() {
    let small = long();
    let mut campaign = OnSlurm::unlabelled(&small, 2);
    let (certificates, node) = (campaign.directory().join("certificates"), this_node());
    let made = Command::new("sh")
        .arg(common::config("certificates.sh"))
        .arg(&certificates)
        .args([&format!("orchestrator={node},elsewhere.example"), "agent"])
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", stderr(&made));
    // No --nodelist is needed.
    campaign.options = vec!["--agents=2".into(), format!("--tls={}", certificates.display())];
    campaign.launched();
    campaign.at_work(2);
    let endpoint = fs::read_to_string(campaign.directory().join("endpoint")).unwrap();
    assert!(endpoint.starts_with(&format!("tcp/{node}:")), "{endpoint}");
    campaign.labelled();
    campaign.comes_to(&uninterrupted_outcome(&small));
}

#[test]
fn a_campaign_that_cannot_continue_is_not_requeued() {
    let campaign = OnSlurm::new(&long(), 1);
    // The file exists at launch, and is missing when the job starts.
    let seeds = campaign.directory().join("seeds.extxyz");
    let mut launch = campaign.launch();
    launch.args(&campaign.options[..1]).args(["--", "--begin=now+4"]).arg(&campaign.options[2]);
    said(launch.output().unwrap());
    fs::remove_file(seeds).unwrap();
    wait_until("the jobs have ended", || {
        let jobs = campaign.jobs();
        jobs["orchestrator"][0].state == "FAILED" && jobs["agent-0"][0].state == "CANCELLED"
    });
    let log = campaign.log("orchestrator");
    assert!(log.contains("exit code 2") && log.contains("seeds.extxyz"), "{log}");
    assert_eq!(restarts(&campaign.job("orchestrator").id), 0);
    assert_no_leftovers(campaign.directory());
}

#[test]
fn a_dry_run_shows_everything_and_does_nothing() {
    let campaign = OnSlurm::new(&long(), 2);
    let text = said(campaign.launch().arg("--dry-run").args(&campaign.options).output().unwrap());
    for expected in ["#SBATCH --signal=B:TERM@120", "agent.sbatch", "--join @", "--dependency=singleton"] {
        assert!(text.contains(expected), "{expected}: {text}");
    }
    assert_eq!(text.matches("\nsbatch ").count(), 3, "{text}");
    assert!(campaign.jobs().is_empty());
    let written = |path: &PathBuf| path.exists();
    assert!(
        !written(&campaign.directory().join("slurm")) && !written(&campaign.directory().join("endpoint"))
    );
    // Without certificates, agents must run on the orchestrator's node.
    let refused = campaign.launch().arg("--agents=2").output().unwrap();
    assert_eq!(refused.status.code(), Some(2));
    assert!(stderr(&refused).contains("--nodelist"), "{}", stderr(&refused));
    assert_eq!(
        calmwalk(campaign.directory(), ["launch", "campaign.toml", "--on", "pbs"]).status.code(),
        Some(2)
    );
}
