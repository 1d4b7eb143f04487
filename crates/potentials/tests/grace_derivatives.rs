//! GRACE derivatives against finite differences; results depend on the structure only.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use atoms::{Cell, Evaluation, Matrix3, NeighbourList, Potential, PotentialError, Species, Structure, Vec3};
use potentials::grace::{
    Architecture, Grace, GraceModel, Instructions, Precision, PullBack, RadialPath, Threads,
};

use crate::common;
use crate::common::golden::committed;
use crate::common::{assert_close, check_forces, check_virial, position_gradient, strain_gradient};

fn model(name: &str, path: RadialPath) -> Arc<GraceModel> {
    let file = match name {
        "two_layers" | "three_layers" => {
            Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/data/{name}.npz"))
        }
        _ => committed(name).join("kokkos.npz"),
    };
    Arc::new(GraceModel::load_in(&file, Precision::Double, path).unwrap())
}

/// Reproducible numbers in [−½, ½).
fn noise(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
    }
}

/// Four atoms in a skewed cell much smaller than the cutoff, periodic along the given directions.
fn small(symbol: &str, spacing: f64, periodic: [bool; 3]) -> Structure {
    let a = spacing;
    let mut noise = noise(7);
    let sites = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];
    Structure {
        species: vec![symbol.parse::<Species>().unwrap(); 4],
        positions: sites.map(|site| site.map(|x| a * x + 0.4 * noise())).to_vec(),
        cell: Cell([[a, 0.1, 0.0], [-0.2, 1.05 * a, 0.1], [0.3, 0.0, 0.97 * a]]),
        periodic,
    }
}

/// Two elements, and second neighbours beyond the cutoff.
fn alloy(periodic: [bool; 3]) -> Structure {
    let mut structure = small("W", 3.7, periodic);
    structure.species[1] = "Mo".parse().unwrap();
    structure.species[2] = "Mo".parse().unwrap();
    structure
}

fn structures() -> Vec<(&'static str, Structure)> {
    vec![
        ("al_eam_1l", small("Al", 4.1, [true; 3])),
        ("al_eam_1l", small("Al", 4.1, [true, true, false])),
        ("si_sw_1l", small("Si", 4.3, [true, false, false])),
        ("si_sw_1l", small("Si", 4.3, [false; 3])),
        ("two_layers", alloy([true; 3])),
        ("two_layers", alloy([true, false, true])),
        ("three_layers", alloy([true; 3])),
        ("three_layers", alloy([false; 3])),
    ]
}

#[test]
fn forces_and_virial_are_differences_of_the_energy() {
    for (name, structure) in structures() {
        for path in [RadialPath::Exact, RadialPath::Table] {
            let mut grace = Grace::new(model(name, path));
            check_forces(&mut grace, &structure, 1e-3, 1e-8);
            check_virial(&mut grace, &structure, 1e-4, 1e-8);
        }
    }
}

fn features(grace: &mut Grace, structure: &Structure) -> Vec<f64> {
    let mut neighbours = NeighbourList::new(grace.cutoff(), 0.0);
    neighbours.update(structure).unwrap();
    grace.forward(structure, &neighbours).unwrap();
    grace.features().to_vec()
}

#[test]
fn the_pull_back_is_the_gradient_of_any_linear_function_of_the_features() {
    for (name, structure) in structures() {
        let mut grace = Grace::new(model(name, RadialPath::Table));
        let n = features(&mut grace, &structure).len();
        let mut noise = noise(11);
        let cotangent: Vec<f64> = (0..n).map(|_| noise()).collect();
        let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
        grace.backward(Some(&cotangent), &mut energy, &mut pull_back);

        let mut linear = |structure: &Structure| {
            let z = features(&mut grace, structure);
            z.iter().zip(&cotangent).map(|(z, c)| z * c).sum::<f64>()
        };
        let gradient = position_gradient(&structure, 4e-4, &mut linear);
        assert_close("gradient", pull_back.gradient.as_flattened(), gradient.as_flattened(), 1e-8);
        let virial = strain_gradient(&structure, 1e-4, &mut linear);
        assert_close("virial", pull_back.virial.as_flattened(), virial.as_flattened(), 1e-8);

        // The derivatives of the energy have the same bits with and without a second cotangent.
        assert_eq!(energy, common::evaluate(&mut grace, &structure));
    }
}

#[test]
fn an_atom_without_neighbours_has_a_finite_feature_and_no_gradient() {
    let mut grace = Grace::new(model("al_eam_1l", RadialPath::Table));
    let alone = Structure {
        species: vec!["Al".parse().unwrap(); 3],
        positions: vec![[0.0; 3], [2.8, 0.0, 0.0], [30.0, 0.0, 0.0]],
        cell: Cell::orthorhombic(1.0, 1.0, 1.0),
        periodic: [false; 3],
    };
    let z = features(&mut grace, &alone);
    let d = grace.model().feature_dimension();
    assert!(z.iter().all(|x| x.is_finite()));
    assert!(z[2 * d..3 * d - 2].iter().all(|x| *x == 0.0));
    assert!((z[3 * d - 1] - 1.001e-12_f64.ln()).abs() < 1e-12);
    let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
    grace.backward(Some(&vec![1.0; 3 * d]), &mut energy, &mut pull_back);
    assert_eq!((energy.forces[2], pull_back.gradient[2]), ([0.0; 3], [0.0; 3]));
    assert!(pull_back.gradient[0][0].is_finite() && pull_back.gradient[0][0] != 0.0);
}

#[test]
fn equal_structures_give_equal_bits() {
    let golden = common::golden::golden(&committed("al_eam_1l"));
    check_bits(model("al_eam_1l", RadialPath::Table), &golden[2].structure, &golden[3].structure);
    for name in ["two_layers", "three_layers"] {
        check_bits(model(name, RadialPath::Table), &alloy([true; 3]), &small("Mo", 6.0, [false; 3]));
    }
}

/// Copies of a cell along each axis.
fn copies(structure: &Structure, n: usize) -> Structure {
    let mut large =
        Structure { cell: Cell(structure.cell.0.map(|row| row.map(|x| n as f64 * x))), ..structure.clone() };
    (large.positions, large.species) = (Vec::new(), Vec::new());
    for k in 0..n * n * n {
        let shift = [k / (n * n), k / n % n, k % n].map(|k| k as f64);
        for (r, species) in structure.positions.iter().zip(&structure.species) {
            let along = |a: usize| (0..3).map(|c| shift[c] * structure.cell.0[c][a]).sum::<f64>();
            large.positions.push(std::array::from_fn(|a| r[a] + along(a)));
            large.species.push(*species);
        }
    }
    large
}

/// Features, energies and forces, and the pull-back of z itself.
fn everything(grace: &mut Grace, structure: &Structure) -> (Vec<f64>, Evaluation, PullBack) {
    let z = features(grace, structure);
    let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
    grace.backward(Some(&z), &mut energy, &mut pull_back);
    (z, energy, pull_back)
}

/// The same in a single call.
fn at_once(grace: &mut Grace, structure: &Structure) -> (Vec<f64>, Evaluation, PullBack) {
    let mut neighbours = NeighbourList::new(grace.cutoff(), 0.0);
    neighbours.update(structure).unwrap();
    let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
    let graded: Vec<AtomicU32> = structure.positions.iter().map(|_| AtomicU32::new(0)).collect();
    let grade = |atoms: &[u32], z: &[f64], cotangent: &mut [f64]| {
        for atom in atoms {
            graded[*atom as usize].fetch_add(1, Ordering::Relaxed);
        }
        cotangent.copy_from_slice(z);
    };
    grace.evaluate_graded(structure, &neighbours, &grade, &mut energy, Some(&mut pull_back)).unwrap();
    assert!(graded.iter().all(|times| times.load(Ordering::Relaxed) == 1));
    let (z, mut alone) = (grace.features().to_vec(), Evaluation::default());
    let unasked = |_: &[u32], _: &[f64], cotangent: &mut [f64]| assert!(cotangent.is_empty());
    grace.evaluate_graded(structure, &neighbours, &unasked, &mut alone, None).unwrap();
    assert_eq!((grace.features(), &alone), (&z[..], &energy));
    (z, energy, pull_back)
}

#[test]
fn copies_of_a_cell_have_its_forces_with_the_same_bits_on_any_number_of_threads() {
    let cells = [
        ("al_eam_1l", small("Al", 4.1, [true; 3])),
        ("two_layers", alloy([true; 3])),
        ("three_layers", alloy([true; 3])),
    ];
    for (name, cell) in cells {
        let model = model(name, RadialPath::Table);
        let (large, one) = (copies(&cell, 3), everything(&mut Grace::new(model.clone()), &cell));
        let many = everything(&mut Grace::new(model.clone()), &large);
        assert_eq!(at_once(&mut Grace::new(model.clone()), &large), many, "{name}");
        let repeated = |of_one: &[Vec3]| of_one.iter().copied().cycle().take(large.len()).collect::<Vec<_>>();
        let times = |tensor: &Matrix3| tensor.map(|row| row.map(|x| 27.0 * x));
        let check = |what: &str, found: &[Vec3], one: &[Vec3]| {
            assert_close(&format!("{name}, {what}"), found.as_flattened(), one.as_flattened(), 1e-11);
        };
        check("forces", &many.1.forces, &repeated(&one.1.forces));
        check("gradient", &many.2.gradient, &repeated(&one.2.gradient));
        check("virial", &many.1.virial, &times(&one.1.virial));
        check("pulled back virial", &many.2.virial, &times(&one.2.virial));
        for n in [2, 3, 5] {
            let mut grace = Grace::with(model.clone(), Instructions::best(), Threads::new(n).unwrap());
            assert_eq!(everything(&mut grace, &large), many, "{name}, {n} threads");
            assert_eq!(common::evaluate(&mut grace, &large), many.1, "{name}, {n} threads");
            assert_eq!(at_once(&mut grace, &large), many, "{name}, {n} threads");
            assert_eq!(everything(&mut grace, &cell), one, "{name}, {n} threads");
        }
    }
}

fn check_bits(model: Arc<GraceModel>, structure: &Structure, other: &Structure) {
    let run = |grace: &mut Grace, skin: f64| {
        let mut neighbours = NeighbourList::new(grace.cutoff(), skin);
        neighbours.update(structure).unwrap();
        grace.forward(structure, &neighbours).unwrap();
        let z = grace.features().to_vec();
        let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
        grace.backward(Some(&z), &mut energy, &mut pull_back);
        (z, energy, pull_back)
    };
    let mut used = Grace::new(model.clone());
    let first = run(&mut used, 0.0);
    features(&mut used, other); // another number of atoms in between
    for skin in [0.0, 0.3, 1.1] {
        assert_eq!(run(&mut used, skin), first);
        assert_eq!(run(&mut Grace::new(model.clone()), skin), first);
    }
    for instructions in Instructions::all() {
        let mut grace = Grace::with(model.clone(), instructions, Threads::default());
        assert_eq!(run(&mut grace, 0.0), first, "{instructions:?}");
        assert_eq!(common::evaluate(&mut grace, structure), first.1, "{instructions:?}");
    }
}

#[test]
fn what_cannot_be_evaluated_is_refused() {
    let mut grace = Grace::new(model("al_eam_1l", RadialPath::Table));
    let copper = small("Cu", 4.1, [true; 3]);
    let mut neighbours = NeighbourList::new(grace.cutoff(), 0.0);
    neighbours.update(&copper).unwrap();
    let error = grace.forward(&copper, &neighbours).unwrap_err();
    assert_eq!(error.to_string(), "atom 0 is Cu, which the potential does not support (it supports Al)");
    let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
    grace.backward(None, &mut energy, &mut pull_back);
    assert!(energy.forces.is_empty());

    let aluminium = small("Al", 4.1, [true; 3]);
    let mut short = NeighbourList::new(6.0, 1.0);
    short.update(&aluminium).unwrap();
    assert!(matches!(grace.forward(&aluminium, &short), Err(PotentialError::Cutoff { .. })));
}

#[test]
fn a_model_describes_itself() {
    let model = model("si_sw_1l", RadialPath::Table);
    let description = model.description();
    assert_eq!(description.architecture, Architecture::OneLayer);
    assert_eq!((description.lmax, description.channels, description.radial_basis_size), (3, 8, 8));
    assert_eq!((description.basis_dimension, description.feature_dimension), (328, 130));
    assert_eq!(description.basis_functions, ["A", "AA", "AAA", "AAAA"]);
    assert_eq!(description.weights, 14_681);
    assert_eq!((model.cutoff(), model.pair_cutoff(0, 0)), (5.0, 5.0));
}

#[test]
fn deeper_models_describe_themselves() {
    for (name, architecture, basis, features) in
        [("two_layers", Architecture::TwoLayer, 128, 9), ("three_layers", Architecture::ThreeLayer, 24, 10)]
    {
        let model = model(name, RadialPath::Exact);
        let description = model.description();
        assert_eq!(description.architecture, architecture);
        assert_eq!((description.basis_dimension, description.feature_dimension), (basis, features));
        assert_eq!((model.cutoff(), model.pair_cutoff(0, 1)), (4.5, 4.5));
    }
}

/// Atom 2 affects atom 0 only through atom 1, and atom 3 only through both, which takes three layers.
#[test]
fn messages_carry_as_far_as_there_are_layers() {
    let chain = |end: f64| Structure {
        species: ["Mo", "W", "W", "Mo"].map(|symbol| symbol.parse().unwrap()).to_vec(),
        positions: vec![[0.0; 3], [3.1, 0.4, 0.0], [6.2, 0.0, 0.3], [end, 0.2, 0.9]],
        cell: Cell::orthorhombic(1.0, 1.0, 1.0),
        periodic: [false; 3],
    };
    for (name, heard) in [("two_layers", [false, true]), ("three_layers", [true, true])] {
        let mut grace = Grace::new(model(name, RadialPath::Exact));
        let [near, far] = [9.1, 9.3].map(|end| common::evaluate(&mut grace, &chain(end)).atomic_energies);
        for (atom, heard) in heard.into_iter().enumerate() {
            assert_eq!(near[atom] != far[atom], heard, "{name}: atom {atom}");
        }
    }
}

/// Atomic energies do not depend on orientation, reflection or the order of atoms.
#[test]
fn deeper_models_do_not_change_under_rotation_and_permutation() {
    let structure = alloy([false; 3]);
    let turned = |x: &[f64; 3]| {
        let (c, s) = (0.6, 0.8);
        let y = [c * x[0] - s * x[1], s * x[0] + c * x[1], x[2]];
        [-y[0], -(s * y[1] + c * y[2]), -(c * y[1] - s * y[2])]
    };
    let order = [2, 0, 3, 1];
    let moved = Structure {
        species: order.map(|i| structure.species[i]).to_vec(),
        positions: order.map(|i| turned(&structure.positions[i])).to_vec(),
        ..structure.clone()
    };
    for name in ["two_layers", "three_layers"] {
        let mut grace = Grace::new(model(name, RadialPath::Exact));
        let here = common::evaluate(&mut grace, &structure);
        let there = common::evaluate(&mut grace, &moved);
        let energies = order.map(|i| here.atomic_energies[i]);
        assert_close("energy", &there.atomic_energies, &energies, 1e-11);
        let forces = order.map(|i| turned(&here.forces[i]));
        assert_close("force", there.forces.as_flattened(), forces.as_flattened(), 1e-9);
    }
}
