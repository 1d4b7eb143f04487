//! How Slurm ends jobs, and how the labeller handles each end.

use std::fs;

use super::jobs::{Jobs, once_each, only};
use crate::common::processes::wait_until;
use crate::common::slurm::{ci, slurm};

/// Sets the job's end to now. Slurm checks time limits every 30 s.
fn end_its_time(id: &str) {
    slurm(&["scontrol", "update", &format!("jobid={id}"), "EndTime=now"]);
}

/// Marks the node down. It returns to service because its daemon is alive.
fn lose_node(name: &str) {
    slurm(&["scontrol", "update", &format!("nodename={name}"), "state=down", "reason=test"]);
}

#[test]
fn a_job_that_is_cancelled_is_lost_and_tried_again() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    slurm(&["scancel", &jobs.jobs()[0][0]]);
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    jobs.go();
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels + 1);
    let lost = only(&jobs, "node_failure");
    assert!(lost["log"].as_str().unwrap().contains("is CANCELLED"), "{lost}");
    // A cancelled job is not a node failure.
    assert!(!lost["calculation"].as_str().unwrap().contains("\"node\""), "{lost}");
}

#[test]
fn a_job_whose_time_is_over_gets_twice_as_much() {
    let jobs = Jobs::with("time_limit = \"10m\"", "--comment=label");
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    end_its_time(&jobs.jobs()[0][0]);
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    // Slurm's limit is one minute longer than the runner's.
    let times: Vec<_> = jobs.squeue("%j|%l|%r").into_iter().skip(1).map(|[_, limit, _]| limit).collect();
    assert_eq!(times, ["21:00"]);
    jobs.go();
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels + 1);
    let ended = only(&jobs, "time_limit");
    assert!(ended["log"].as_str().unwrap().contains("is TIMEOUT"), "{ended}");
    assert!(ended["core_seconds"].as_f64() > Some(0.0), "{ended}");
    assert!(jobs.attempts().iter().any(|attempt| attempt["remedies"] == "more_time"), "{ended}");
}

/// Where Slurm only measures memory, it reports a job that it kills as `FAILED`, and the job's log gives the reason.
#[test]
fn a_job_that_slurm_kills_for_its_memory_was_out_of_memory() {
    let jobs = Jobs::with("", "--mem=100M");
    let eat = jobs.home.path().join("eat");
    fs::write(&eat, "").unwrap();
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    fs::remove_file(eat).unwrap();
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    jobs.go();
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels + 1);
    let ended = only(&jobs, "out_of_memory");
    assert!(ended["log"].as_str().unwrap().contains("the job's log says"), "{ended}");
}

#[test]
fn a_job_whose_node_is_lost_goes_to_another() {
    let jobs = Jobs::with("", "--partition=pair");
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    let lost = jobs.squeue("%i|%T|%N")[0][2].clone();
    lose_node(&lost);
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    assert_ne!(jobs.squeue("%i|%T|%N")[1][2], lost);
    jobs.go();
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels + 1);
    let attempt = only(&jobs, "node_failure");
    assert!(attempt["log"].as_str().unwrap().contains(&format!("is NODE_FAIL on {lost}")), "{attempt}");
}

/// `sbatch` refuses a job that excludes every node, but Slurm keeps a record of it.
#[test]
fn where_there_is_no_other_node_it_goes_to_the_same() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    lose_node(&jobs.squeue("%i|%T|%N")[0][2]);
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    jobs.go();
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels + 1);
    only(&jobs, "node_failure");
    assert!(!jobs.place.said().contains("label.scratch"), "{}", jobs.place.said());
}

/// Slurm forgets ended jobs after some minutes (`MinJobAge`); here at once.
#[test]
fn the_end_of_a_forgotten_job_is_read_from_its_log() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let mut label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    jobs.kill(&mut label);
    end_its_time(&jobs.jobs()[0][0]);
    wait_until("Slurm has ended the job at its time limit", || jobs.jobs()[0][1] == "TIMEOUT");
    ci("forget");
    assert!(jobs.jobs().is_empty());
    let label = jobs.place.label(&[]);
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    jobs.go();
    let labels = jobs.finish(run, label);
    assert_eq!(jobs.begun().len(), labels + 1, "{}", jobs.place.said());
    let ended = only(&jobs, "time_limit");
    let log = ended["log"].as_str().unwrap();
    assert!(log.contains("no longer knows its job") && log.contains("DUE TO TIME LIMIT"), "{ended}");
    assert!(ended["core_seconds"].as_f64() > Some(0.0), "{ended}");
}

/// A slurmctld that has lost its state ends the jobs that run on its nodes.
#[test]
fn a_running_job_that_slurm_loses_is_made_again_once() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    ci("forget");
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    jobs.go();
    let labels = jobs.finish(run, label);
    assert_eq!(jobs.begun().len(), labels + 1, "{}", jobs.place.said());
    only(&jobs, "node_failure");
}
