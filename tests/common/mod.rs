//! Runs the program as users do.
#![allow(dead_code)] // Each test program uses a part.

pub mod browser;
pub mod campaign;
pub mod clock;
pub mod config_tester;
pub mod delay_proxy;
pub mod hosts;
pub mod http;
pub mod label_campaign;
pub mod mutate;
pub mod npz;
pub mod processes;
pub mod report;
pub mod slurm;
pub mod stand_in;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};

use atoms::extxyz::{Frame, write_frame};

/// Number of kills in one test: 12, or `CALMWALK_KILLS`.
pub fn kills() -> u64 {
    std::env::var("CALMWALK_KILLS").ok().and_then(|text| text.parse().ok()).unwrap_or(12)
}

/// A deterministic pseudorandom number (SplitMix64).
pub fn random(seed: u64) -> u64 {
    let mut z = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Path of a file in `configs/`.
pub fn config(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("configs").join(path)
}

/// Text of a file in `configs/`, with absolute paths of data files.
pub fn demo(name: &str) -> String {
    let text = std::fs::read_to_string(config(name)).expect("a configuration of the project");
    text.replace("\"data/", &format!("\"{}/", config("data").display()))
}

/// The program, to be run in `directory`.
pub fn program(directory: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_calmwalk"));
    command.current_dir(directory);
    command
}

/// The same, started by another command if there is one.
pub fn through(starter: &[String], directory: &Path) -> Command {
    let Some((first, rest)) = starter.split_first() else { return program(directory) };
    let mut command = Command::new(first);
    command.args(rest).arg(env!("CARGO_BIN_EXE_calmwalk")).current_dir(directory);
    command
}

/// Runs the program to its end.
pub fn calmwalk<A: AsRef<std::ffi::OsStr>>(
    directory: &Path,
    arguments: impl IntoIterator<Item = A>,
) -> Output {
    program(directory).args(arguments).output().expect("the program starts")
}

/// Runs the program, which must succeed. Returns its standard output.
pub fn succeed<A: AsRef<std::ffi::OsStr>>(
    directory: &Path,
    arguments: impl IntoIterator<Item = A>,
) -> String {
    let output = calmwalk(directory, arguments);
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
    String::from_utf8(output.stdout).expect("text")
}

/// Runs the program, which must fail with exit code 2. Returns its standard error.
pub fn refuse<A: AsRef<std::ffi::OsStr>>(directory: &Path, arguments: impl IntoIterator<Item = A>) -> String {
    let output = calmwalk(directory, arguments);
    assert_eq!(output.status.code(), Some(2), "{}", stderr(&output));
    stderr(&output)
}

/// A process that is killed on drop, also when a test fails.
pub struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Standard error of a process.
pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Writes frames as extended XYZ.
pub fn write_frames(path: &Path, frames: &[Frame]) {
    let mut text = Vec::new();
    for frame in frames {
        write_frame(&mut text, frame).expect("a frame that can be written");
    }
    std::fs::write(path, text).expect("a file that can be written");
}

/// Largest deviation of two lists relative to the largest number of the second.
pub fn deviation(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().fold(0.0, |largest: f64, x| largest.max(x.abs()));
    found.iter().zip(expected).fold(0.0, |worst: f64, (a, b)| worst.max((a - b).abs())) / largest
}
