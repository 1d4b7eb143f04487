//! gracemaker's calculator on the same crystals.

use std::process::Command;

use potentials::grace::Precision;
use serde_json::{Value, json};

use crate::case::{Call, Case, Model};

/// Seconds of its calls for one crystal.
pub struct Seconds {
    plain: Vec<f64>,
    graded: Vec<f64>,
}

impl Seconds {
    pub fn of(&self, call: Call) -> &[f64] {
        match call {
            Call::Plain => &self.plain,
            Call::Gamma => &[],
            Call::Graded => &self.graded,
        }
    }
}

/// Of every crystal, in single precision beside our mixed; none without gracemaker or its data.
pub fn seconds(model: &Model, precision: Precision, cases: &[Case]) -> Option<Vec<Seconds>> {
    let python = std::env::var_os("CALMWALK_GRACEMAKER_PYTHON")?;
    let folder = model.peer_folder()?;
    let file = tempfile::NamedTempFile::new().expect("a temporary file");
    std::fs::write(file.path(), request(model, precision, &folder, cases).to_string())
        .expect("the request is written");
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/grace/gracemaker.py");
    let output = Command::new(python).arg(script).arg(file.path()).output().expect("python starts");
    assert!(output.status.success(), "gracemaker: {}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).expect("text");
    let answer: Value =
        serde_json::from_str(text.lines().last().unwrap_or_default()).expect("its last line is JSON");
    let times = |of: &Value, key: &str| {
        of[key].as_array().expect("a list").iter().filter_map(Value::as_f64).collect::<Vec<_>>()
    };
    let answers = answer.as_array().expect("a list");
    Some(
        answers.iter().map(|of| Seconds { plain: times(of, "plain"), graded: times(of, "graded") }).collect(),
    )
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
    let mut request = json!({"structures": structures, "repetitions": 9, "precision": precision});
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
