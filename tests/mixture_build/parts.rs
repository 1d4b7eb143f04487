//! A build that several processes share.

use std::os::unix::fs::PermissionsExt;
use std::process::Command;

use super::*;

/// The arguments of a part of a pass.
fn part(output: &str, pass: usize, part: usize, of: usize) -> Vec<String> {
    part_with(output, pass, (part, of), "1")
}

fn part_with(output: &str, pass: usize, (part, of): (usize, usize), threads: &str) -> Vec<String> {
    let share = [pass.to_string(), format!("{part}/{of}")];
    arguments(output, &["data.extxyz"], &["--threads", threads, "--pass", &share[0], "--part", &share[1]])
}

/// Runs all parts of a pass at once.
fn run_parts(here: &Path, output: &str, pass: usize, of: usize, threads: &str) {
    let parts = 1..=of;
    let children: Vec<_> = parts
        .map(|number| {
            let mut command = program(here);
            let command = command.args(part_with(output, pass, (number, of), threads));
            command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
        })
        .collect();
    for (number, child) in children.into_iter().enumerate() {
        let output = child.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        let said = format!("part {}/{of} of pass {pass} is done", number + 1);
        assert!(String::from_utf8_lossy(&output.stdout).contains(&said), "{output:?}");
    }
}

fn merge(output: &str) -> Vec<String> {
    let model = config(MODEL).display().to_string();
    ["calm", "merge", "--model", &model, "--output", output].map(str::to_owned).to_vec()
}

#[test]
fn any_number_of_parts_gives_the_same_bytes() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    // 17 shards.
    write_frames(&here.join("data.extxyz"), &frames());
    let (whole, printed) = build(here, "whole.npz", &["data.extxyz"], &["--embed", "whole_model.npz"]);
    for (of, threads) in [(2, "1"), (2, "2"), (7, "1"), (7, "2"), (20, "1")] {
        let output = format!("of_{of}_{threads}.npz");
        for pass in 1..=3 {
            run_parts(here, &output, pass, of, threads);
            let mut merge = merge(&output);
            if pass == 3 {
                merge.extend(["--embed", "model.npz"].map(str::to_owned));
            }
            let said = succeed(here, merge);
            let expected = match pass {
                3 => printed.replace("whole.npz", &output),
                pass => format!("pass {pass} of 3 is merged; continue with --pass {}\n", pass + 1),
            };
            assert_eq!(said, expected);
        }
        assert!(fs::read(here.join(&output)).unwrap() == whole, "{of} parts");
        assert!(fs::read(here.join("model.npz")).unwrap() == fs::read(here.join("whole_model.npz")).unwrap());
        assert!(!here.join(format!("{output}.build")).exists());
    }
}

#[test]
fn parts_that_are_missing_killed_or_of_another_build_are_noticed() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames());
    let (whole, _) = build(here, "whole.npz", &["data.extxyz"], &[]);
    let message = refuse(here, merge("out.npz"));
    assert!(message.contains("out.npz.build: expected the directory of a build in parts"), "{message}");

    // A killed part continues later, and does not block the others.
    let mut command = program(here);
    let child = command.args(part("out.npz", 1, 1, 2)).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
    let mut running = Running(child.unwrap());
    let state = here.join("out.npz.build");
    wait_until("a shard is finished", || state.join("pass-1-1of2").exists());
    let held = PausedProcesses::new([running.0.id()]);
    let message = fail(here, &part("out.npz", 1, 1, 2));
    assert!(message.contains("another process is building out.npz"), "{message}");
    assert!(fail(here, &arguments("out.npz", &["data.extxyz"], &[])).contains("another process is building"));
    succeed(here, part("out.npz", 1, 2, 2));
    // This kills the part.
    drop(held);
    running.0.wait().unwrap();
    let message = fail(here, &merge("out.npz"));
    assert!(message.contains("pass 1 is not done: missing are the parts 1/2"), "{message}");
    let message = fail(here, &part("out.npz", 2, 1, 2));
    assert!(message.contains("pass 1 is not merged yet"), "{message}");
    succeed(here, part("out.npz", 1, 1, 2));
    succeed(here, merge("out.npz"));

    // The number of parts may change after each merge.
    let message = fail(here, &part("out.npz", 3, 1, 2));
    assert!(message.contains("pass 2 is not merged yet"), "{message}");
    succeed(here, part("out.npz", 2, 3, 3));
    let message = fail(here, &merge("out.npz"));
    assert!(message.contains("pass 2 is not done: missing are the parts 1/3, 2/3"), "{message}");
    let other = [part("out.npz", 2, 1, 3), vec!["--rng-seed".into(), "7".into()]].concat();
    let message = refuse(here, other);
    assert!(message.contains("its --rng-seed is 42, now it is 7"), "{message}");
    run_parts(here, "out.npz", 2, 3, "2");
    succeed(here, merge("out.npz"));
    // A single process finishes the build.
    let (rest, _) = build(here, "out.npz", &["data.extxyz"], &[]);
    assert!(rest == whole);

    for (wrong, reason) in
        [("3/2", "expected i/n with 1 ≤ i ≤ n"), ("0/2", "expected i/n"), ("2", "expected i/n")]
    {
        let message = refuse(here, arguments("x.npz", &["data.extxyz"], &["--pass", "1", "--part", wrong]));
        assert!(message.contains(reason), "{message}");
    }
    refuse(here, arguments("x.npz", &["data.extxyz"], &["--pass", "1"]));
    refuse(here, arguments("x.npz", &["data.extxyz"], &["--pass", "4", "--part", "1/2"]));
}

#[test]
fn a_part_continues_only_what_it_has_begun() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames()[..6]);
    let said = |number, of| {
        let output = calmwalk(here, part("out.npz", 1, number, of));
        assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
        stderr(&output)
    };
    // Its name begins with that of part 1 of 2.
    said(1, 20);
    let first = said(1, 2);
    assert!(!first.contains("continuing from"), "{first}");
    let again = said(1, 2);
    assert!(again.contains("continuing from out.npz.build"), "{again}");
}

/// What `configs/slurm/calm-build.sh` says that it submits, with two parts.
fn submitted(here: &Path) -> String {
    let (programs, sbatch) = (here.join("programs"), here.join("programs/sbatch"));
    fs::create_dir_all(&programs).unwrap();
    // Prints the id of a job, which never runs.
    fs::write(&sbatch, "#!/bin/sh\ncat > /dev/null\necho 7\n").unwrap();
    fs::set_permissions(&sbatch, fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
    let mut command = Command::new(config("slurm/calm-build.sh"));
    let model = config(MODEL).display().to_string();
    command.args(["2", "--", "--model", &model, "data.extxyz", "--output", "out.npz"]).current_dir(here);
    let output = command.env("PATH", path).env("CALMWALK", env!("CARGO_BIN_EXE_calmwalk")).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn a_chain_of_jobs_begins_with_the_first_pass_that_is_not_merged() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames()[..12]);
    let (whole, _) = build(here, "whole.npz", &["data.extxyz"], &[]);
    let state = here.join("out.npz.build");
    assert!(submitted(here).starts_with("pass 1: 2 parts in job 7, merged by job 7\npass 2: "));
    run_parts(here, "out.npz", 1, 2, "1");
    succeed(here, merge("out.npz"));
    // The sums of some shards, as a process leaves them that makes the whole build and is stopped.
    succeed(here, part("out.npz", 2, 1, 2));
    fs::copy(state.join("pass-2-1of2"), state.join("pass-2")).unwrap();
    assert!(submitted(here).starts_with("pass 2: 2 parts in job 7, merged by job 7\npass 3: "));
    run_parts(here, "out.npz", 2, 2, "1");
    assert!(succeed(here, merge("out.npz")).contains("pass 2 of 3 is merged"));
    assert!(submitted(here).starts_with("pass 3: 2 parts in job 7, merged by job 7\n"));
    // Killed between the sums and the end of the pass: the merge ends it.
    fs::remove_file(state.join("end-2")).unwrap();
    assert!(submitted(here).starts_with("pass 2: "));
    assert!(succeed(here, merge("out.npz")).contains("pass 2 of 3 is merged"));
    assert!(submitted(here).starts_with("pass 3: "));
    // A process that makes the whole build ends pass 2, too.
    fs::remove_file(state.join("end-2")).unwrap();
    fs::write(state.join("pass-3"), "damaged").unwrap();
    assert!(fail(here, &arguments("out.npz", &["data.extxyz"], &[])).contains("pass-3: the file is damaged"));
    assert!(submitted(here).starts_with("pass 3: "));
    run_parts(here, "out.npz", 3, 2, "1");
    succeed(here, merge("out.npz"));
    assert!(fs::read(here.join("out.npz")).unwrap() == whole);
}

#[test]
fn one_file_for_artifact_and_model_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames()[..6]);
    fs::create_dir(here.join("folder")).unwrap();
    let message = refuse(here, arguments("x.npz", &["data.extxyz"], &["--embed", "folder/../x.npz"]));
    assert!(message.contains("folder/../x.npz and x.npz: one file is named for two outputs"), "{message}");
    assert!(!here.join("x.npz.build").exists());
    run_parts(here, "x.npz", 1, 1, "1");
    let message = refuse(here, [merge("x.npz"), vec!["--embed".into(), "x.npz".into()]].concat());
    assert!(message.contains("one file is named for two outputs"), "{message}");
    let artifact = config("data/al_eam_1l/gmm_artifacts.npz").display().to_string();
    let model = config(MODEL).display().to_string();
    let recalibrate =
        ["calm", "recalibrate", &artifact, "--model", &model, "-o", "x.npz", "--embed", "x.npz"];
    assert!(refuse(here, recalibrate).contains("one file is named for two outputs"));
    assert!(!here.join("x.npz").exists());
}
