//! A build that is killed repeatedly.

use std::time::SystemTime;

use super::*;

/// The current pass of a build, from its state; 0 before the first result.
fn pass(state: &Path) -> usize {
    let has = |name: &str| state.join(name).exists();
    match (has("pass-3"), has("partition"), has("pass-1")) {
        (true, ..) => 3,
        (_, true, _) => 2,
        (_, _, true) => 1,
        _ => 0,
    }
}

/// Size and modification time of the results of a pass.
fn results(state: &Path, pass: usize) -> Option<(u64, SystemTime)> {
    let found = fs::metadata(state.join(format!("pass-{pass}"))).ok()?;
    Some((found.len(), found.modified().ok()?))
}

#[test]
fn ten_kills_in_all_passes_change_no_byte() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &[frames(), frames()].concat());
    let (expected, _) = build(here, "expected.npz", &["data.extxyz"], &["--threads", "2"]);
    let arguments = arguments("killed.npz", &["data.extxyz"], &["--threads", "2"]);
    let state = here.join("killed.npz.build");
    let (mut kills, mut seen) = (0, [0; 4]);
    for target in [1, 1, 1, 1, 2, 2, 2, 3, 3, 3].into_iter().cycle().take(40) {
        if kills >= 10 && seen[1..].iter().all(|kills| *kills > 0) {
            break;
        }
        let mut command = program(here);
        let child = command.args(&arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let (mut running, before) = (Running(child), results(&state, target));
        // Kill it as soon as it starts the pass or saves a result of it.
        wait_until("the build is killed", || {
            let begun = target > 1 && before.is_none() && pass(&state) == target;
            let ended = running.0.try_wait().unwrap().is_some();
            begun || ended || results(&state, target) != before || pass(&state) > target
        });
        signal(running.0.id(), "KILL");
        match running.0.wait().unwrap().code() {
            None => {
                kills += 1;
                seen[pass(&state)] += 1;
            }
            // The build finished first: start again.
            Some(code) => {
                assert_eq!(code, 0);
                assert!(fs::read(here.join("killed.npz")).unwrap() == expected, "after {kills} kills");
            }
        }
    }
    assert!(kills >= 10 && seen[1..].iter().all(|kills| *kills > 0), "{kills} kills, {seen:?}");
    let (killed, _) = build(here, "killed.npz", &["data.extxyz"], &["--threads", "2"]);
    assert!(killed == expected, "after {kills} kills");
}
