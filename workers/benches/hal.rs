//! Biased steps per second against gracemaker's walker, `grace_uq hal`: the same model (al_eam_1l), 108 atoms, 600
//! K, 2 fs, τ = 0.15, no updates of the mixture. Both run at the same time and use the machine alternately. At constant volume with
//! Langevin friction 0.01/fs, at 1 bar with Nosé–Hoover chains, in a fully flexible cell whose bias (`npt_stress`) has the same scale.
//!
//! `CALMWALK_PEER_DATA=… CALMWALK_GRACEMAKER_PYTHON=…/bin/python cargo bench -p workers --bench hal [-- ENSEMBLE…
//! CORES…]`. Ensembles are those of `grace_uq`, by default `nvt_ramp` and `npt_stress`, on one and two cores by
//! default. Our walk has the same ensemble.

mod common;

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::Arc;
use std::time::Instant;

use atoms::Structure;
use atoms::extxyz::{Frame, write_frame};
use calm::Artifact;
use common::{Ensemble, TimedWalk, crystal, quartiles};
use potentials::grace::GraceModel;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

/// Number of measurements of each.
const ROUNDS: usize = 9;

/// Steps per measurement of our walk.
const STEPS: u64 = 250;

/// Steps between lines of gracemaker's walker, and so per measurement of it.
const PEER_STEPS: u64 = 20;

fn main() {
    let python = std::env::var_os("CALMWALK_GRACEMAKER_PYTHON").expect("a Python with tensorpotential");
    let data = std::env::var_os("CALMWALK_PEER_DATA").expect("the folder with models/al_eam_1l");
    let (python, folder) = (PathBuf::from(python), Path::new(&data).join("models/al_eam_1l"));
    let wanted = std::env::args().skip(1).filter(|text| !text.starts_with('-'));
    let (mut cores, mut ensembles) = (Vec::new(), Vec::new());
    for text in wanted {
        match text.parse::<usize>() {
            Ok(number) => cores.push(number),
            Err(_) => ensembles.push(text),
        }
    }
    if ensembles.is_empty() {
        ensembles = vec!["nvt_ramp".into(), "npt_stress".into()];
    }
    if cores.is_empty() {
        cores = vec![1, 2];
    }
    let model = Arc::new(GraceModel::load(&folder.join("kokkos.npz")).expect("a model"));
    let mixture = Arc::new(Artifact::load_export(folder.join("kokkos.npz")).expect("a CALM mixture").mixture);
    let seed_structure = crystal(model.elements(), 4.05);
    for ensemble in ensembles {
        let ours = match ensemble.as_str() {
            "npt" | "npt_stress" => Ensemble::ConstantPressure { cell_bias: ensemble == "npt_stress" },
            _ => Ensemble::ConstantVolume,
        };
        let walk = TimedWalk::new(&model, &mixture, seed_structure.clone(), ours);
        for &cores in &cores {
            let mut peer = Peer::start(&python, &folder, &seed_structure, &ensemble, cores);
            let mut walks = vec![walk.clone(); cores];
            let (mut ours, mut theirs, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
            for round in 0..=ROUNDS {
                let (their, our) = (peer.rate(), rate(&mut walks));
                // The first round is a warm-up.
                if round > 0 {
                    ours.push(our);
                    theirs.push(their);
                    ratios.push(our / their);
                }
            }
            println!("{ensemble}, {} atoms, {cores} of the machine's cores", walk.structure.len());
            for (what, values) in
                [("steps/s of ours", ours), ("steps/s of grace_uq hal", theirs), ("ours / its", ratios)]
            {
                let [low, median, high] = quartiles(values);
                println!("  {what}: {median:.1} ({low:.1} to {high:.1})");
            }
        }
    }
}

/// Steps per second of all walks in parallel, one thread each.
fn rate(walks: &mut [TimedWalk]) -> f64 {
    let (count, start) = (walks.len() as f64, Instant::now());
    std::thread::scope(|scope| {
        for walk in walks {
            scope.spawn(|| walk.seconds(STEPS));
        }
    });
    count * STEPS as f64 / start.elapsed().as_secs_f64()
}

/// gracemaker's walker, stopped while it is not measured.
struct Peer {
    process: Child,
    lines: BufReader<ChildStdout>,
    _directory: TempDir,
}

impl Peer {
    /// On one core with one thread, or on all cores with any number of threads.
    fn start(python: &Path, folder: &Path, seed_structure: &Structure, ensemble: &str, cores: usize) -> Self {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let mut text = Vec::new();
        write_frame(&mut text, &Frame::from(seed_structure.clone())).expect("a crystal");
        let structure = directory.path().join("seed.extxyz");
        std::fs::write(&structure, text).expect("a file");
        let program = python.with_file_name("grace_uq");
        let mut command = if cores == 1 { Command::new("taskset") } else { Command::new(&program) };
        if cores == 1 {
            command.args(["--cpu-list", "0"]).arg(program);
            command.envs(
                ["TF_NUM_INTRAOP_THREADS", "TF_NUM_INTEROP_THREADS", "OMP_NUM_THREADS"].map(|key| (key, "1")),
            );
        }
        command.env("TF_CPP_MIN_LOG_LEVEL", "3").env("PYTHONUNBUFFERED", "1").arg("hal");
        command.arg("--model-yaml").arg(folder.join("gracemaker/model.yaml"));
        command.arg("--checkpoint").arg(folder.join("gracemaker/checkpoint"));
        command.arg("--artifact-path").arg(folder.join("gmm_artifacts.npz"));
        command.arg("--structure").arg(structure);
        command.args(["--ensemble", ensemble, "-T", "600", "--n-steps", "1000000", "--friction", "0.01"]);
        command.args(["--nvt-ramp", "1.0", "1.0", "--tau", "0.15", "--update", "none"]);
        command.args(["--bulk-modulus", "0.474"]);
        command.args(["--trigger-gamma", "1e9", "--reject-gamma", "1e9"]);
        command.args(["--progress-every", &PEER_STEPS.to_string()]);
        command.arg("--output-dir").arg(directory.path().join("walker"));
        let mut process = command
            .current_dir(directory.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("grace_uq and taskset start");
        let lines = BufReader::new(process.stdout.take().expect("piped"));
        let mut peer = Self { process, lines, _directory: directory };
        peer.wait_for_a_line();
        peer.signal(Signal::STOP);
        peer
    }

    /// Steps per second between two of its lines.
    fn rate(&mut self) -> f64 {
        self.signal(Signal::CONT);
        self.wait_for_a_line();
        let start = Instant::now();
        self.wait_for_a_line();
        let seconds = start.elapsed().as_secs_f64();
        self.signal(Signal::STOP);
        PEER_STEPS as f64 / seconds
    }

    fn wait_for_a_line(&mut self) {
        let mut line = String::new();
        while !line.starts_with("step ") {
            line.clear();
            assert_ne!(self.lines.read_line(&mut line).expect("text"), 0, "grace_uq hal has ended");
        }
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.process), signal).expect("a child of this process");
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
