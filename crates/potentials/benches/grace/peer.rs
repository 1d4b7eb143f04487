//! gracemaker's calculator on the same crystals.

use std::io::{BufRead, BufReader, Lines, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use potentials::grace::Precision;
use serde_json::{Value, json};
use tempfile::NamedTempFile;

use crate::case::{Call, Case, Model};

/// The core to which both programs are pinned during the comparison.
const CORE: &str = "0";

/// A gracemaker process with a model that waits for calls.
pub struct Peer {
    process: Child,
    input: ChildStdin,
    lines: Lines<BufReader<ChildStdout>>,
    grades: bool,
    _request: NamedTempFile,
}

impl Peer {
    /// Starts gracemaker, in single precision for our mixed precision; `None` without gracemaker or its data.
    pub fn start(model: &Model, precision: Precision, cases: &[Case]) -> Option<Self> {
        let python = std::env::var_os("CALMWALK_GRACEMAKER_PYTHON")?;
        let folder = model.peer_folder()?;
        let request = request(model, precision, &folder, cases);
        let file = NamedTempFile::new().expect("a temporary file");
        std::fs::write(file.path(), request.to_string()).expect("the request is written");
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/grace/gracemaker.py");
        let mut command = Command::new(python);
        command.arg(script).arg(file.path()).stdin(Stdio::piped()).stdout(Stdio::piped());
        // A process inherits the pinning of the thread that starts it.
        tie(CORE);
        let mut process = command.spawn().expect("python starts");
        let input = process.stdin.take().expect("its input");
        let lines = BufReader::new(process.stdout.take().expect("its output")).lines();
        Some(Self { process, input, lines, grades: request.get("artifact").is_some(), _request: file })
    }

    /// Time of one call for a crystal, s; `None` if there is no mixture for the model.
    pub fn seconds(&mut self, case: usize, call: Call) -> Option<f64> {
        let name = match call {
            Call::Plain => "plain",
            Call::Graded if self.grades => "graded",
            Call::Graded | Call::Gamma => return None,
        };
        writeln!(self.input, "{name} {case}").expect("gracemaker is there");
        let mut lines = self.lines.by_ref().map(|line| line.expect("text"));
        let answer = lines.find_map(|line| line.strip_prefix("seconds ")?.parse().ok());
        Some(answer.expect("gracemaker answers"))
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It may have exited already.
        let _ = self.process.kill();
        let _ = self.process.wait();
        tie("0-1023");
    }
}

/// Pins this thread to these cores.
fn tie(cores: &str) {
    let mut command = Command::new("taskset");
    command.args(["--cpu-list", "--pid", cores, &std::process::id().to_string()]);
    let status = command.stdout(Stdio::null()).status().expect("taskset of util-linux");
    assert!(status.success(), "taskset: {status}");
}

fn request(model: &Model, precision: Precision, folder: &std::path::Path, cases: &[Case]) -> Value {
    let structures: Vec<Value> = cases
        .iter()
        .map(|case| {
            let symbols: Vec<&str> = case.structure.species.iter().map(|species| species.symbol()).collect();
            json!({"symbols": symbols, "positions": case.structure.positions, "cell": case.structure.cell.0})
        })
        .collect();
    let precision = if precision == Precision::Double { "double" } else { "single" };
    let mut request = json!({"structures": structures, "precision": precision});
    let artifact = folder.join("gmm_artifacts.npz");
    if artifact.exists() {
        request["artifact"] = json!(artifact);
    }
    match model.preset {
        None => request["checkpoint"] = json!(folder.join("gracemaker")),
        Some((preset, arguments)) => {
            request["preset"] = json!(preset);
            request["arguments"] = serde_json::from_str(arguments).expect("JSON");
            request["cutoff"] = json!(cases[0].cutoff());
            request["elements"] = json!(cases[0].symbols());
        }
    }
    request
}
