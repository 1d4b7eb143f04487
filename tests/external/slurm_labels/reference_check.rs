//! The labels of the reference check are made by jobs, too.

use std::fs;

use atoms::extxyz::{FrameLabels, LabelKeys};
use serde_json::Value;

use super::jobs::{Jobs, once_each};
use crate::common::processes::{signal, wait_until};
use crate::common::slurm::slurm;
use crate::common::{Running, write_frames};

/// Number of structures in the check.
const KNOWN: usize = 2;

/// A campaign with a reference check of the seed structures, whose known labels equal those that the jobs make.
fn checked() -> Jobs {
    let jobs = Jobs::with("reference_check = { structures = \"known.extxyz\" }", "--comment=check");
    let mut frames = atoms::read_extxyz(&jobs.place.path().join("seeds.extxyz")).unwrap();
    for frame in &mut frames {
        let forces = Some(vec![[0.25, 0.0, 0.0]; frame.structure.len()]);
        frame.set_labels(&FrameLabels { energy: Some(-1.5), forces, stress: None }, LabelKeys::Ase);
    }
    assert_eq!(frames.len(), KNOWN);
    write_frames(&jobs.place.path().join("known.extxyz"), &frames);
    jobs
}

fn ended_by(run: &mut Running, name: &str) -> Option<i32> {
    signal(run.0.id(), name);
    run.0.wait().unwrap().code()
}

fn state_of_orchestrator(jobs: &Jobs) -> Option<Value> {
    let processes = jobs.place.status()["processes"].clone();
    let found = processes.as_array().unwrap().iter().find(|process| process["kind"] == "orchestrator");
    found.map(|process| process["state"].clone())
}

/// The job outlives `run`, however it ends, and the next `run` waits for the job.
#[test]
fn a_run_that_is_killed_in_its_check_is_followed_by_one_that_finds_the_job() {
    let jobs = checked();
    let mut run = jobs.place.run();
    wait_until("a job of the check is running", || jobs.begun().len() == 1);
    let before = jobs.jobs();
    assert_eq!(ended_by(&mut run, "KILL"), None);
    assert_eq!(state_of_orchestrator(&jobs), Some("dead".into()));
    let checks = || jobs.place.said().matches("checking the reference").count();
    let mut run = jobs.place.run();
    wait_until("the next one checks", || checks() == 2);
    assert_eq!(ended_by(&mut run, "TERM"), Some(130), "{}", jobs.place.said());
    assert_eq!(state_of_orchestrator(&jobs), None);
    assert_eq!((jobs.jobs(), jobs.begun().len()), (before, 1), "{}", jobs.place.said());
    let run = jobs.place.run();
    wait_until("the third one checks", || checks() == 3);
    jobs.go();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels + KNOWN);
    assert_eq!(jobs.place.status()["reference_check"]["state"], "passed");
    let left = fs::read_dir(jobs.home.path().join("scratch")).unwrap().count();
    assert_eq!(left, 0, "directories of calculations");
}

#[test]
fn a_job_of_the_check_that_slurm_cancels_is_made_again() {
    let jobs = checked();
    let run = jobs.place.run();
    wait_until("a job of the check is running", || jobs.begun().len() == 1);
    slurm(&["scancel", &jobs.jobs()[0][0]]);
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    jobs.go();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels + KNOWN + 1);
    assert_eq!(jobs.place.status()["reference_check"]["state"], "passed");
}
