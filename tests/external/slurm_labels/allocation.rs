//! A labeller in a Slurm allocation: its calculations are job steps.

use std::fs;

use super::jobs::Jobs;
use crate::common::processes::{calculation_processes, processes_running, signal, wait_until};
use crate::common::program;
use crate::common::slurm::slurm;

/// Submits a job that runs `calmwalk label`, and lasts until the calculations are released.
fn submit(jobs: &Jobs) {
    let (here, home) = (jobs.place.path().canonicalize().unwrap(), jobs.home.path().display());
    let label = program(&here).get_program().display().to_string();
    let script = here.join("labeller.sh");
    let text = format!(
        "#!/bin/sh\n{label} label --store . --wait-timeout 2m 2>> said\nwhile [ -d {home} ] && [ ! -e {home}/go ]; do sleep 0.2; done\n"
    );
    fs::write(&script, text).unwrap();
    let (directory, output) = (format!("--chdir={}", here.display()), format!("--output={home}/job.log"));
    slurm(&["sbatch", "--ntasks=2", "--no-requeue", &directory, &output, &script.display().to_string()]);
}

/// The tasks of a step are not children of `srun`, so killing `srun` alone leaves them running.
#[test]
fn a_step_ends_with_its_runner_and_its_label_is_made_again() {
    let jobs = Jobs::calling(r#"["srun", "--ntasks=1", "--overlap", "sh", "label.sh"]"#, "");
    let scratch = jobs.home.path().canonicalize().unwrap().join("scratch");
    let run = jobs.place.run();
    submit(&jobs);
    wait_until("a step is running", || jobs.begun().len() == 1);
    // Kill every process that could clean up.
    for who in ["label", "labeller", "calculation-runner"] {
        processes_running(jobs.place.path(), who).into_iter().for_each(|pid| signal(pid, "KILL"));
    }
    wait_until("the step has ended", || calculation_processes(&scratch).is_empty());
    let label = jobs.place.label(&["--wait-timeout", "2m"]);
    wait_until("the calculation is started again", || jobs.begun().len() == 2);
    jobs.go();
    let labels = jobs.finish(run, label);
    assert_eq!(jobs.begun().len(), labels + 1, "{}", jobs.place.said());
}
