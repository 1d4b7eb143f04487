//! A labeller finds the jobs that earlier labellers have submitted.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::jobs::{Jobs, once_each};
use crate::common::processes::wait_until;
use crate::common::program;
use crate::common::slurm::ci;

#[test]
fn a_labeller_that_is_killed_is_followed_by_one_that_finds_its_job() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let mut label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    let name = jobs.jobs()[0][2].clone();
    jobs.kill(&mut label);
    // At least one slot per structure, because no job ends before it is released.
    let label = jobs.place.label(&["--concurrency", "20"]);
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

/// The `sbatch` of the first labeller hangs, and submits the job after another labeller has submitted it.
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
    let mut label = jobs.place.spawn(slowly, &["label", "--store", ".", "--wait-timeout", "2m"]);
    wait_until("a job is being submitted", || jobs.home.path().join("asked").exists());
    jobs.kill(&mut label);
    assert!(jobs.jobs().is_empty() && jobs.begun().is_empty());
    let label = jobs.place.label(&["--concurrency", "2"]);
    wait_until("another labeller has submitted the job", || !jobs.begun().is_empty());
    let first = PathBuf::from(&jobs.begun()[0]);
    jobs.go();
    let labels = jobs.finish(run, label);
    wait_until("the first labeller has submitted the job", || jobs.home.path().join("late").exists());
    wait_until("all jobs have ended", || {
        jobs.jobs().iter().all(|[_, state, _]| state == "COMPLETED" || state == "FAILED")
    });
    assert_eq!(jobs.begun().len(), labels);
    assert_eq!(jobs.begun().iter().filter(|path| Path::new(path) == first).count(), 1);
}

#[test]
fn while_slurm_does_not_answer_nothing_is_concluded() {
    let jobs = Jobs::new();
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("a job is running", || jobs.begun().len() == 1);
    // Wait until Slurm has saved that the job runs.
    let state = PathBuf::from(std::env::var_os("SLURM_CONF").unwrap()).with_file_name("state/job_state");
    let written = |path: &Path| fs::metadata(path).and_then(|file| file.modified()).ok();
    let begun = written(&jobs.home.path().join("begun"));
    wait_until("Slurm has saved the job", || written(&state) > begun);
    ci("kill");
    jobs.go();
    wait_until("its label is read without Slurm", || jobs.place.jobs("labelled") == 1);
    ci("revive");
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels);
    assert!(jobs.attempts().iter().all(|attempt| attempt["outcome"] == "labelled"));
}
