//! Slurm has reached its limit of jobs, and accepts no more.

use std::fs;

use super::jobs::{Jobs, once_each};
use crate::common::processes::wait_until;
use crate::common::slurm::FullQueue;

#[test]
fn labels_wait_while_slurm_accepts_no_jobs() {
    const REFUSED: &str = "Slurm accepts no further jobs for now (Slurm temporarily unable to accept job)";
    let jobs = Jobs::new();
    jobs.go();
    let full = FullQueue::new();
    let run = jobs.place.run();
    let label = jobs.place.label(&["--wait-timeout", "2m", "--log", "label.log"]);
    let log = || fs::read_to_string(jobs.place.path().join("label.log")).unwrap_or_default();
    wait_until("the labeller says why it waits", || log().contains(REFUSED));
    // A plain `sbatch` would still be waiting.
    full.wait_for_refusals(3);
    assert!(jobs.jobs().is_empty() && jobs.begun().is_empty());
    assert_eq!((jobs.place.jobs("leased"), jobs.place.jobs("failed")), (1, 0), "{}", jobs.place.said());
    assert_eq!(log().matches(REFUSED).count(), 1, "{}", log());
    drop(full);
    let labels = jobs.finish(run, label);
    once_each(&jobs, labels);
    assert!(jobs.attempts().iter().all(|attempt| attempt["class"].is_null()));
    assert!(log().contains("Slurm accepts jobs again"), "{}", log());
}
