//! `calmwalk select` against `grace_uq select` on the same pool. Needs a Python with tensorpotential, named by
//! `CALMWALK_GRACEMAKER_PYTHON`; `.ci/loaders` makes one.

use std::path::Path;
use std::process::Command;

use atoms::read_extxyz;
use serde::Deserialize;

use crate::common::{config, random, stderr, succeed, write_frames};

/// Grades that differ by less are equal for both programs.
const TOLERANCE: f64 = 1e-5;

/// Passes the grades and features of `calmwalk calm score` to `grace_uq select` as a predicted pool, once per list of
/// strategies, and prints its picks.
const SCRIPT: &str = r#"
import contextlib, io, json, sys
import numpy as np, pandas as pd
from ase.io import read
from tensorpotential.scripts.grace_uq import main
artifact, features, rows, first = sys.argv[1], np.load('z.npy'), [], 0
for number, atoms in enumerate(read('scored.extxyz', ':')):
    n, gamma = len(atoms), atoms.arrays['gamma']
    atoms.calc = None
    rows.append(dict(ase_atoms=atoms, energy=0.0, forces=np.zeros((n, 3)), info={'number': number}, energy_predicted=0.0,
                     forces_predicted=np.zeros((n, 3)), gamma=gamma, sigma=atoms.arrays['sigma'],
                     features=features[first:first + n]))
    first += n
pd.DataFrame(rows).to_pickle('predicted.pkl.gz')
found = []
for parts in sys.argv[2:]:
    sys.argv = ['grace_uq', 'select', '--artifact', artifact, '--predicted', 'predicted.pkl.gz', '--output', 'picked.pkl.gz',
                '--no-element-stratified', '--strategy', *parts.split()]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            main()
    except SystemExit as end:
        if end.code:
            raise
    picked = pd.read_pickle('picked.pkl.gz')
    gamma = picked['gamma_at_pick'].tolist() if 'gamma_at_pick' in picked else []
    found.append(dict(frames=[info['number'] for info in picked['info']], gamma=[None if np.isnan(g) else g for g in gamma]))
print(json.dumps(found))
"#;

/// Strategies without randomness: `fps` starts from greedy picks, three structures with all elements. Without picks of an
/// element, the reference starts from a random atom.
const STRATEGIES: [&str; 4] = [
    "calm-greedy",
    "calm-greedy:3 fps-extrap:9",
    "calm-greedy:2 fps-all:9",
    "calm-greedy:3 fps-extrap:4 calm-greedy:5",
];

#[derive(Deserialize)]
struct Picked {
    frames: Vec<u64>,
    gamma: Vec<Option<f64>>,
}

#[test]
fn aluminium_is_selected_as_by_gracemaker() {
    selects("al_eam_1l", "aluminium_seeds.extxyz");
}

#[test]
fn three_elements_are_selected_as_by_gracemaker() {
    selects("ni_al_h_eam_1l", "nickel_aluminium_hydrogen_seeds.extxyz");
}

fn selects(model: &str, seeds: &str) {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let path = |file: &str| config(&format!("data/{model}/{file}")).display().to_string();
    let (kokkos, artifact) = (path("kokkos.npz"), path("gmm_artifacts.npz"));
    pool(&config(&format!("data/{seeds}")), &here.join("pool.extxyz"));
    let score = [
        "calm",
        "score",
        "--model",
        &kokkos,
        "--artifact",
        &artifact,
        "pool.extxyz",
        "--output",
        "scored.extxyz",
    ];
    succeed(here, score.into_iter().chain(["--features", "z.npy"]));
    for (parts, expected) in STRATEGIES.iter().zip(reference(here, &artifact)) {
        let parts: Vec<String> = parts.split(' ').map(|part| part.replace("calm-greedy", "greedy")).collect();
        let own =
            ["select", "--model", &kokkos, "--artifact", &artifact, "pool.extxyz", "--output", "out.extxyz"];
        let more = ["--json", "--no-element-floors", "--strategy"];
        let printed = succeed(here, own.into_iter().chain(more).chain(parts.iter().map(String::as_str)));
        let found: serde_json::Value = serde_json::from_str(&printed).unwrap();
        let picks = found["picks"].as_array().unwrap();
        let frames: Vec<u64> = picks.iter().map(|pick| pick["source_frame"].as_u64().unwrap()).collect();
        assert!(frames.len() > 7, "{model} {parts:?}: {frames:?}");
        assert_eq!(frames, expected.frames, "{model} {parts:?}");
        for (pick, expected) in picks.iter().zip(expected.gamma) {
            let Some(expected) = expected else { continue };
            let gamma = pick["gamma_max"].as_f64().unwrap();
            assert!(
                (gamma - expected).abs() < TOLERANCE * expected,
                "{model} {parts:?}: {gamma}, not {expected}"
            );
        }
    }
}

/// Forty structures with different displacements and strains.
fn pool(seeds: &Path, path: &Path) {
    let seeds = read_extxyz(seeds).unwrap();
    let frame = |n: usize| {
        let mut frame = seeds[n % seeds.len()].clone();
        let unit = |k: usize| 2.0 * (random((100_000 * n + k) as u64) as f64 / u64::MAX as f64) - 1.0;
        let (scale, strain) = (0.04 * (1 + n % 5) as f64, 1.0 + 0.04 * unit(0));
        frame.structure.positions.iter_mut().flatten().for_each(|x| *x *= strain);
        frame.structure.cell.0.iter_mut().flatten().for_each(|x| *x *= strain);
        let coordinates = frame.structure.positions.iter_mut().flatten().zip(1..);
        coordinates.for_each(|(x, k)| *x += scale * unit(k));
        frame
    };
    write_frames(path, &(0..40).map(frame).collect::<Vec<_>>());
}

fn reference(here: &Path, artifact: &str) -> Vec<Picked> {
    let variable = "CALMWALK_GRACEMAKER_PYTHON";
    let python = std::env::var_os(variable).unwrap_or_else(|| panic!("{variable} names no Python"));
    let mut command = Command::new(python);
    let command = command.args(["-c", SCRIPT, artifact]).args(STRATEGIES).env("CUDA_VISIBLE_DEVICES", "");
    let output = command.current_dir(here).output().unwrap();
    assert!(output.status.success(), "{}", stderr(&output));
    let printed = String::from_utf8(output.stdout).unwrap();
    // TensorFlow may print other lines.
    let found = printed.lines().find(|line| line.starts_with("[{"));
    serde_json::from_str(found.unwrap_or_else(|| panic!("{printed}"))).unwrap()
}
