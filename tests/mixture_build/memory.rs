//! The memory of a build.

use super::*;

/// Peak of the resident memory of a process until it ends successfully, kB; without what it takes in its last moments.
fn peak_memory(mut running: Running) -> u64 {
    let status = format!("/proc/{}/status", running.0.id());
    let mut peak = 0;
    wait_until("the build ends", || {
        let found = fs::read_to_string(&status).unwrap_or_default();
        let line = found.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let number = line.and_then(|line| line.split_whitespace().next()?.parse().ok());
        peak = number.unwrap_or(0).max(peak);
        running.0.try_wait().unwrap().is_some_and(|end| {
            assert!(end.success(), "{end}");
            true
        })
    });
    peak
}

/// One thread holds one shard, so six times the data need no more memory. Their features alone would be 34 MB, those of a shard
/// are 0.3 MB.
#[test]
fn more_data_need_no_more_memory() {
    const FACTOR: usize = 6;
    const ALLOWED: u64 = 4 * 1024;
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let once = frames();
    let many: Vec<Frame> = (0..FACTOR).flat_map(|_| once.iter().cloned()).collect();
    let features = many.len() * 108 * 130 * size_of::<f64>() / 1024;
    assert!(features as u64 > 8 * ALLOWED, "{features}");
    let peaks = [("few", &once), ("many", &many)].map(|(name, frames)| {
        let data = format!("{name}.extxyz");
        write_frames(&here.join(&data), frames);
        let arguments =
            arguments(&format!("{name}.npz"), &[&data], &["--threads", "1", "--candidates", "1,4"]);
        let mut command = program(here);
        command.args(arguments).stdout(Stdio::null()).stderr(Stdio::null());
        peak_memory(Running(command.spawn().unwrap()))
    });
    assert!(peaks[0] > ALLOWED && peaks[1] < peaks[0] + ALLOWED, "{peaks:?} kB");
}
