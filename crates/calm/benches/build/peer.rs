//! scikit-learn, as gracemaker's builder uses it, on the same features.

use std::io::{BufRead, BufReader, Lines, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use tempfile::NamedTempFile;

/// The core to which both programs are pinned.
const CORE: &str = "0";

/// A Python process that holds the features and waits.
pub struct Peer {
    process: Child,
    input: ChildStdin,
    lines: Lines<BufReader<ChildStdout>>,
    _features: NamedTempFile,
}

impl Peer {
    /// Pins this process, and starts the Python that `CALMWALK_GRACEMAKER_PYTHON` names; `None` without it.
    pub fn start(features: &[f64], dimension: usize, batch: usize, candidates: &[usize]) -> Option<Self> {
        let python = std::env::var_os("CALMWALK_GRACEMAKER_PYTHON")?;
        let mut file = NamedTempFile::new().expect("a temporary file");
        let bytes: Vec<u8> = features.iter().flat_map(|value| value.to_ne_bytes()).collect();
        file.write_all(&bytes).expect("the features are written");
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/build/kmeans.py");
        let mut command = Command::new(python);
        command.arg(script).arg(file.path()).args([dimension, batch].map(|number| number.to_string()));
        command.args(candidates.iter().map(ToString::to_string)).stdin(Stdio::piped()).stdout(Stdio::piped());
        // A process inherits the pinning of the one that starts it.
        let pid = std::process::id().to_string();
        let mut pin = Command::new("taskset");
        pin.args(["--cpu-list", "--pid", CORE, &pid]).stdout(Stdio::null());
        assert!(pin.status().expect("taskset of util-linux").success());
        let mut process = command.spawn().expect("python starts");
        let input = process.stdin.take().expect("its input");
        let lines = BufReader::new(process.stdout.take().expect("its output")).lines();
        Some(Self { process, input, lines, _features: file })
    }

    /// Processor time of one pass, s.
    pub fn seconds(&mut self) -> f64 {
        writeln!(self.input, "go").expect("Python is there");
        let mut lines = self.lines.by_ref().map(|line| line.expect("text"));
        lines.find_map(|line| line.strip_prefix("seconds ")?.parse().ok()).expect("Python answers")
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It may have exited already.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
