//! slurmd on the node is killed while a label is made there.

use std::fs;
use std::path::Path;

use super::jobs::{Jobs, only};
use crate::common::processes::{calculation_processes, signal, wait_until};
use crate::common::slurm::ci;

/// All processes of a Slurm job on the node: its `slurmstepd`, and the processes that work in `scratch`.
fn of_job(id: &str, scratch: &Path) -> Vec<u32> {
    let numbers = fs::read_dir("/proc").unwrap().flatten();
    let numbers = numbers.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    let belongs = |pid: &u32| {
        let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let place = fs::read_link(format!("/proc/{pid}/cwd")).unwrap_or_default();
        line.starts_with(format!("slurmstepd: [{id}.").as_bytes()) || place.starts_with(scratch)
    };
    numbers.filter(belongs).collect()
}

/// Checks that no calculation is running.
fn assert_no_leftovers(jobs: &Jobs, scratch: &Path) {
    wait_until("every calculation has exited", || calculation_processes(scratch).is_empty());
    let over = ["COMPLETED", "FAILED", "CANCELLED", "NODE_FAIL"];
    wait_until("every job has ended", || jobs.jobs().iter().all(|[_, state, _]| over.contains(&&**state)));
    assert!(jobs.jobs().iter().all(|[id, ..]| of_job(id, scratch).is_empty()));
}

/// A job step does not need slurmd to continue, and reports its end to slurmctld itself.
#[test]
fn a_label_outlives_the_daemon_of_its_node() {
    let jobs = Jobs::new();
    let scratch = jobs.home.path().canonicalize().unwrap().join("scratch");
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    ci("kill-node");
    ci("revive");
    assert_eq!((jobs.jobs()[0][1].as_str(), jobs.begun().len()), ("RUNNING", 1));
    ci("kill-node");
    jobs.go();
    wait_until("its label is read without the daemon", || jobs.place.jobs("labelled") == 1);
    ci("revive");
    let labels = jobs.finish(run, label);
    // Slurm may have lost jobs that were due to start while slurmd was down; these never started.
    let mut begun = jobs.begun();
    begun.sort();
    begun.dedup();
    assert!(labels > 2 && begun.len() == labels && jobs.begun().len() == labels, "{}", jobs.place.said());
    assert!(
        jobs.attempts()
            .iter()
            .all(|attempt| attempt["class"].is_null() || attempt["class"] == "node_failure")
    );
    assert_no_leftovers(&jobs, &scratch);
}

/// Like a power failure of the node: only slurmctld survives, and the node returns without state.
#[test]
fn a_label_whose_node_dies_is_made_again_once() {
    let jobs = Jobs::new();
    let scratch = jobs.home.path().canonicalize().unwrap().join("scratch");
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    let id = jobs.jobs()[0][0].clone();
    ci("kill-node");
    wait_until("all processes of the job have exited", || {
        let left = of_job(&id, &scratch);
        left.iter().for_each(|pid| signal(*pid, "KILL"));
        left.is_empty()
    });
    // slurmctld notices the missing job when the node registers, unless the job has just started; so repeat.
    wait_until("Slurm knows that it is lost", || {
        ci("kill-node");
        ci("revive");
        jobs.jobs()[0][1] != "RUNNING"
    });
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    jobs.go();
    let labels = jobs.finish(run, label);
    assert_eq!(jobs.begun().len(), labels + 1, "{}", jobs.place.said());
    only(&jobs, "node_failure");
    assert_no_leftovers(&jobs, &scratch);
}
