//! A build of a mixture as a chain of jobs on a real Slurm:
//! `SLURM_CONF=$(.ci/slurm start) cargo test --test external slurm_build::`.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use crate::common::processes::wait_until;
use crate::common::slurm::{hold, slurm};
use crate::common::{config, stderr, succeed};

/// Submits a build in three parts. `more` are arguments of the build.
fn submit(here: &Path, more: &[&str]) -> Output {
    let model = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let mut command = Command::new(config("slurm/calm-build.sh"));
    command.args(["3", "--partition=all", "--ntasks=1", "--", "--model", &model]).args(more);
    command.env("CALMWALK", env!("CARGO_BIN_EXE_calmwalk")).current_dir(here).output().unwrap()
}

/// The logs of the jobs.
fn logs(here: &Path) -> String {
    let files = fs::read_dir(here).unwrap().flatten().map(|file| file.path());
    let logs = files.filter(|path| path.extension().is_some_and(|extension| extension == "log"));
    logs.map(|path| fs::read_to_string(path).unwrap()).collect()
}

#[test]
fn a_chain_of_jobs_gives_the_bytes_of_one_process_and_continues() {
    let _node = hold();
    let directory = tempfile::Builder::new().prefix("calm build").tempdir().unwrap();
    let here = directory.path();
    fs::copy(config("data/al_eam_1l/seed_frames.extxyz"), here.join("the data.extxyz")).unwrap();
    let model = config("data/al_eam_1l/kokkos.npz").display().to_string();
    let settings = ["the data.extxyz", "--shard-size", "9", "--threads", "1"];
    let whole = ["calm", "build", "--model", &model, "--output", "whole.npz"];
    succeed(here, whole.iter().chain(&settings));

    let arguments = [&settings[..], &["--output", "out.npz", "--embed", "model.npz"]].concat();
    let idle = || slurm(&["squeue", "--noheader", "--partition=all"]).is_empty();
    // Run and merge pass 1 without Slurm first.
    for part in ["1/2", "2/2"] {
        let part = ["--pass", "1", "--part", part];
        let build = ["calm", "build", "--model", &model, "--output", "out.npz"];
        succeed(here, build.iter().chain(&settings).chain(&part));
    }
    succeed(here, ["calm", "merge", "--model", &model, "--output", "out.npz"]);
    let submitted = submit(here, &arguments);
    assert!(submitted.status.success(), "{}", stderr(&submitted));
    let printed = String::from_utf8(submitted.stdout).unwrap();
    assert!(printed.starts_with("pass 2: 3 parts in job ") && printed.lines().count() == 2, "{printed}");
    wait_until("the jobs have ended", idle);
    assert!(here.join("out.npz").exists(), "{}", logs(here));
    assert!(fs::read(here.join("out.npz")).unwrap() == fs::read(here.join("whole.npz")).unwrap());
    assert!(here.join("model.npz").exists() && !here.join("out.npz.build").exists());

    // Other features, of which `calm merge` must be told; the other spelling of options.
    let linear = ["--feature-variant=linear"];
    let whole = ["calm", "build", "--model", &model, "--output", "linear.npz"];
    succeed(here, whole.iter().chain(&settings).chain(&linear));
    let arguments = [&settings[..], &linear, &["--output=again.npz"]].concat();
    let submitted = submit(here, &arguments);
    assert!(String::from_utf8(submitted.stdout).unwrap().starts_with("pass 1: 3 parts in job "));
    wait_until("the jobs have ended", idle);
    assert!(here.join("again.npz").exists(), "{}", logs(here));
    assert!(fs::read(here.join("again.npz")).unwrap() == fs::read(here.join("linear.npz")).unwrap());

    let refused = submit(here, &["data.extxyz"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(stderr(&refused).contains("calm-build.sh PARTS [SBATCH OPTIONS] --"), "{}", stderr(&refused));
}
