//! GRACE in mixed precision against double precision: energies, forces, features, γ and the conservation of energy.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::{Cell, Evaluation, NeighbourList, Potential, Structure, Vec3};
use potentials::grace::{Grace, GraceModel, Instructions, Precision, PullBack, RadialPath, Threads};

use crate::common;
use crate::common::golden::{Mixture, committed, golden, peer};

fn model(file: &Path, precision: Precision) -> Arc<GraceModel> {
    let model = GraceModel::load_in(file, precision, RadialPath::default()).unwrap();
    assert_eq!(model.precision(), precision);
    Arc::new(model)
}

/// A multi-layer test model.
fn deep(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/data/{name}.npz"))
}

/// Reproducible numbers in [−½, ½).
fn noise(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
    }
}

/// A hot fcc crystal of 32 atoms with alternating elements.
fn crystal(model: &GraceModel, edge: f64, seed: u64) -> Structure {
    const SITES: [Vec3; 4] = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];
    let (mut noise, mut positions) = (noise(seed), Vec::new());
    for cell in 0..8 {
        let corner = [cell / 4, cell / 2 % 2, cell % 2];
        for site in SITES {
            positions.push(std::array::from_fn(|a| edge * (corner[a] as f64 + site[a]) + 0.4 * noise()));
        }
    }
    let known = model.elements();
    Structure {
        species: (0..positions.len()).map(|k| known[k % known.len()]).collect(),
        positions,
        cell: Cell::orthorhombic(2.0 * edge, 2.0 * edge, 2.0 * edge),
        periodic: [true; 3],
    }
}

/// The compared quantities.
#[derive(Debug, PartialEq)]
struct Results {
    energy: Evaluation,
    features: Vec<f64>,
    pull_back: PullBack,
}

/// With a cotangent that is the same for every precision.
fn evaluate(grace: &mut Grace, structure: &Structure) -> Results {
    let mut neighbours = NeighbourList::new(grace.cutoff(), 0.0);
    neighbours.update(structure).unwrap();
    grace.forward(structure, &neighbours).unwrap();
    let (features, mut noise) = (grace.features().to_vec(), noise(5));
    let cotangent: Vec<f64> = features.iter().map(|_| noise()).collect();
    let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
    grace.backward(Some(&cotangent), &mut energy, &mut pull_back);
    Results { energy, features, pull_back }
}

/// √(Σ (found − expected)² / Σ expected²)
fn error(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let square = |(f, e): (&f64, &f64)| (f - e) * (f - e);
    let squares: f64 = found.iter().zip(expected).map(square).sum();
    (squares / expected.iter().map(|e| e * e).sum::<f64>()).sqrt()
}

/// Compares root mean squares relative to double precision and the energies of atoms, eV: each below `most`,
/// features below 10⁻⁵.
fn compare(file: &Path, edge: f64, most: f64) {
    let [mut double, mut mixed] =
        [Precision::Double, Precision::Mixed].map(|precision| Grace::new(model(file, precision)));
    for seed in 1..=4 {
        let structure = crystal(double.model(), edge, seed);
        let (expected, found) = (evaluate(&mut double, &structure), evaluate(&mut mixed, &structure));
        let energies = found.energy.atomic_energies.iter().zip(&expected.energy.atomic_energies);
        let energy = energies.map(|(f, e)| (f - e).abs()).fold(0.0, f64::max);
        let of = |found: &[Vec3], expected: &[Vec3]| error(found.as_flattened(), expected.as_flattened());
        let forces = of(&found.energy.forces, &expected.energy.forces);
        let virial = of(&found.energy.virial, &expected.energy.virial);
        let features = error(&found.features, &expected.features);
        let gradient = of(&found.pull_back.gradient, &expected.pull_back.gradient);
        eprintln!(
            "{}: energies {energy:.1e} eV, forces {forces:.1e}, virial {virial:.1e}, z {features:.1e}, pull-back {gradient:.1e}",
            file.display()
        );
        // Identical numbers would mean that double precision was used.
        assert!(forces > 1e-9 && features > 1e-9);
        assert!(energy < most && forces < most && virial < most && features < 1e-5 && gradient < most);
    }
}

#[test]
fn one_layer() {
    compare(&committed("al_eam_1l").join("kokkos.npz"), 4.05, 1e-5);
    compare(&committed("si_sw_1l").join("kokkos.npz"), 4.6, 1e-5);
}

#[test]
fn two_layers() {
    compare(&deep("two_layers"), 3.9, 1e-5);
}

#[test]
fn three_layers() {
    // Random weights, which amplify rounding from layer to layer.
    compare(&deep("three_layers"), 3.9, 1e-3);
}

/// Compares grades of the structures that the original framework has graded.
fn compare_grades(folder: &Path) {
    let mixture = Mixture::read(folder);
    let mut grace = Grace::new(model(&folder.join("kokkos.npz"), Precision::Mixed));
    let (mut worst_forces, mut worst_gamma) = (0.0_f64, 0.0_f64);
    for reference in golden(folder) {
        let results = evaluate(&mut grace, &reference.structure);
        let elements = grace.model().element_indices(&reference.structure.species).unwrap();
        let rows = elements.iter().zip(results.features.chunks(mixture.dimension));
        let gamma: Vec<f64> = rows.map(|(element, z)| mixture.grade(*element, z).1).collect();
        worst_gamma = worst_gamma.max(error(&gamma, &reference.gamma));
        let largest = reference.forces.iter().fold(0.0, |m: f64, f| m.max(f.abs()));
        let squares = results.energy.forces.as_flattened().iter().zip(&reference.forces);
        let squares: f64 = squares.map(|(f, e)| (f - e) * (f - e)).sum();
        worst_forces = worst_forces.max((squares / reference.forces.len() as f64).sqrt() / largest.max(1e-2));
    }
    eprintln!("{}: forces {worst_forces:.1e}, γ {worst_gamma:.1e}", folder.display());
    assert!(worst_forces < 5e-5 && worst_gamma < 5e-5, "forces {worst_forces:e}, γ {worst_gamma:e}");
}

#[test]
fn grades_are_those_of_double_precision() {
    compare_grades(&committed("al_eam_1l"));
    compare_grades(&committed("si_sw_1l"));
}

#[test]
fn grades_of_larger_models_are_those_of_double_precision() {
    for name in ["grace1l_tiny_bondcut", "grace1l_paper", "grace2l_tiny", "grace2l_small", "grace3l_tiny"] {
        if let Some(folder) = peer(name) {
            compare_grades(&folder);
        }
    }
}

#[test]
fn instructions_and_threads_change_no_bits() {
    for file in [committed("al_eam_1l").join("kokkos.npz"), deep("two_layers"), deep("three_layers")] {
        let model = model(&file, Precision::Mixed);
        let structure = crystal(&model, 4.0, 3);
        let first = evaluate(&mut Grace::new(Arc::clone(&model)), &structure);
        for instructions in Instructions::all() {
            for threads in [1, 3] {
                let threads = Threads::new(threads).unwrap();
                let mut grace = Grace::with(Arc::clone(&model), instructions, threads);
                assert_eq!(evaluate(&mut grace, &structure), first, "{instructions:?}");
                let plain = common::evaluate(&mut grace, &structure);
                assert_eq!(plain, first.energy, "{instructions:?}");
            }
        }
    }
}

/// Two atoms that separate: nothing jumps, and near the cutoff values are as small as in double precision.
#[test]
fn nothing_jumps_at_the_cutoff() {
    let file = committed("al_eam_1l").join("kokkos.npz");
    let [mut double, mut mixed] =
        [Precision::Double, Precision::Mixed].map(|precision| Grace::new(model(&file, precision)));
    let cutoff = double.cutoff();
    let pair = |r: f64| Structure {
        species: vec!["Al".parse().unwrap(); 2],
        positions: vec![[0.1, 0.2, 0.3], [0.1 + 0.6 * r, 0.2, 0.3 + 0.8 * r]],
        cell: Cell::orthorhombic(1.0, 1.0, 1.0),
        periodic: [false; 3],
    };
    let apart = common::evaluate(&mut mixed, &pair(cutoff + 0.1));
    assert_eq!(apart.forces, [[0.0; 3]; 2]);
    for inside in [1e-1, 1e-2, 1e-4, 1e-7, 1e-12] {
        let structure = pair(cutoff - inside);
        let (expected, found) =
            (common::evaluate(&mut double, &structure), common::evaluate(&mut mixed, &structure));
        let forces = found.forces.as_flattened().iter().zip(expected.forces.as_flattened());
        let worst = forces.map(|(f, e)| (f - e).abs()).fold(0.0, f64::max);
        let energy = (found.energy() - expected.energy()).abs();
        assert!(worst < 1e-8 && energy < 1e-6, "{inside:e} Å inside: {worst:e} eV/Å, {energy:e} eV");
    }
}

/// Velocity Verlet of a hot crystal: the total energies of all steps, eV per atom.
fn total_energies(precision: Precision, steps: usize) -> Vec<f64> {
    /// u Å²/fs² in eV.
    const MASS_UNIT: f64 = 103.642_696_5;
    let file = committed("al_eam_1l").join("kokkos.npz");
    let mut grace = Grace::new(model(&file, precision));
    let mut structure = crystal(grace.model(), 4.05, 9);
    let (mass, time_step, n) = (26.981_538 * MASS_UNIT, 2.0, structure.len());
    let mut noise = noise(17);
    // About 1000 K.
    let mut velocities: Vec<Vec3> = (0..n).map(|_| std::array::from_fn(|_| 0.02 * noise())).collect();
    let mut neighbours = NeighbourList::new(grace.cutoff(), 0.5);
    let mut evaluation = Evaluation::default();
    let mut evaluate = |structure: &Structure, evaluation: &mut Evaluation| {
        neighbours.update(structure).unwrap();
        grace.evaluate(structure, &neighbours, evaluation).unwrap();
    };
    evaluate(&structure, &mut evaluation);
    let mut totals = Vec::new();
    for _ in 0..steps {
        let kick = |velocities: &mut [Vec3], forces: &[Vec3]| {
            for (v, f) in velocities.as_flattened_mut().iter_mut().zip(forces.as_flattened()) {
                *v += 0.5 * time_step * f / mass;
            }
        };
        kick(&mut velocities, &evaluation.forces);
        let positions = structure.positions.as_flattened_mut().iter_mut();
        positions.zip(velocities.as_flattened()).for_each(|(x, v)| *x += time_step * v);
        evaluate(&structure, &mut evaluation);
        kick(&mut velocities, &evaluation.forces);
        let kinetic = 0.5 * mass * velocities.as_flattened().iter().map(|v| v * v).sum::<f64>();
        totals.push((evaluation.energy() + kinetic) / n as f64);
    }
    totals
}

/// Difference of the means of the last and the first quarter.
fn drift(totals: &[f64]) -> f64 {
    let quarter = totals.len() / 4;
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    mean(&totals[3 * quarter..]) - mean(&totals[..quarter])
}

#[test]
fn the_energy_is_conserved_as_in_double_precision() {
    let [double, mixed] =
        [Precision::Double, Precision::Mixed].map(|precision| total_energies(precision, 4000));
    let spread = |totals: &[f64]| {
        let mean = totals.iter().sum::<f64>() / totals.len() as f64;
        (totals.iter().map(|t| (t - mean) * (t - mean)).sum::<f64>() / totals.len() as f64).sqrt()
    };
    eprintln!(
        "drift over 6 ps: double {:.1e}, mixed {:.1e} eV an atom; spread {:.1e} and {:.1e}",
        drift(&double),
        drift(&mixed),
        spread(&double),
        spread(&mixed)
    );
    // The integrator's own error is much larger.
    assert!((drift(&mixed) - drift(&double)).abs() < 0.1 * spread(&double));
    assert!((spread(&mixed) / spread(&double) - 1.0).abs() < 0.2);
}
