//! LAMMPS in a separate process that runs on request.

use std::ffi::OsString;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde_json::json;

use crate::case::{Case, SKIN};

pub struct Lammps {
    process: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
    /// Potential energy, eV.
    pub start_energy: f64,
}

impl Lammps {
    /// Starts LAMMPS for a case and a pair style, before its first step.
    pub fn start(python: &OsString, case: &Case, style: &str) -> Self {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/lammps/lammps_peer.py");
        let mut process = Command::new(python)
            .arg(script)
            .env("OMP_NUM_THREADS", "1")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("python starts");
        let structure = &case.start.structure;
        let request = json!({
            "style": style,
            "file": case.file,
            "element": structure.species[0].symbol(),
            "mass": structure.species[0].mass(),
            "positions": structure.positions,
            "velocities": case.start.velocities,
            "edges": [structure.cell.0[0][0], structure.cell.0[1][1], structure.cell.0[2][2]],
            "skin": SKIN,
            "time_step": case.time_step,
        });
        let mut orders = process.stdin.take().expect("piped");
        let answers = BufReader::new(process.stdout.take().expect("piped"));
        writeln!(orders, "{request}").expect("LAMMPS listens");
        let mut peer = Self { process, orders, answers, start_energy: 0.0 };
        peer.start_energy = peer.answer();
        peer
    }

    /// Time of these steps, s.
    pub fn run(&mut self, steps: u64) -> f64 {
        writeln!(self.orders, "{steps}").expect("LAMMPS listens");
        self.answer()
    }

    fn answer(&mut self) -> f64 {
        let mut line = String::new();
        self.answers.read_line(&mut line).expect("text");
        line.trim().parse().unwrap_or_else(|_| panic!("LAMMPS answers {line:?} instead of a number"))
    }
}

impl Drop for Lammps {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
