//! The bias on models with message passing: the gradient of the grade, and a walk that works as with any model.

use std::path::Path;
use std::sync::Arc;

use atoms::{Cell, Evaluation, Matrix3, NeighbourList, Potential, Structure, Vec3, cell};
use calm::{Component, Mixture};
use potentials::grace::{Grace, GraceModel};
use workers::bias::BiasedPotential;

fn model(name: &str) -> Arc<GraceModel> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../crates/potentials/tests/data").join(name);
    Arc::new(GraceModel::load(&file).unwrap())
}

fn alloy() -> Structure {
    Structure {
        species: ["Mo", "W", "W", "Mo"].map(|symbol| symbol.parse().unwrap()).to_vec(),
        positions: vec![[0.1, 0.0, -0.1], [0.2, 1.8, 1.7], [1.9, -0.1, 2.0], [1.8, 2.0, 0.1]],
        cell: Cell([[3.8, 0.1, 0.0], [-0.2, 3.9, 0.1], [0.3, 0.0, 3.7]]),
        periodic: [true; 3],
    }
}

/// One component for each element, about the features of `structure` with its atoms shifted.
fn mixture(model: &Arc<GraceModel>, structure: &Structure) -> Arc<Mixture> {
    let mut moved = structure.clone();
    moved.positions.iter_mut().enumerate().for_each(|(k, r)| r[k % 3] += 0.3);
    let mut grace = Grace::new(Arc::clone(model));
    let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
    neighbours.update(&moved).unwrap();
    grace.forward(&moved, &neighbours).unwrap();
    let d = model.feature_dimension();
    let component = |centre: &[f64], scale: f64| {
        let inverse = (0..d * d).map(|k| f64::from(u8::from(k / d == k % d)) * scale * (1 + k % d) as f64);
        Arc::new(Component::new(centre.to_vec(), inverse.collect(), 1.5, None).unwrap())
    };
    let features = grace.features();
    let elements = vec![vec![component(&features[..d], 2.0)], vec![component(&features[d..2 * d], 0.7)]];
    Arc::new(Mixture::new(0, elements).unwrap())
}

/// Σγ, the biased forces, and the virial.
fn evaluate(potential: &mut BiasedPotential, structure: &Structure) -> (f64, Evaluation) {
    let mut neighbours = NeighbourList::new(potential.cutoff(), 0.0);
    neighbours.update(structure).unwrap();
    let mut out = Evaluation::default();
    potential.evaluate(structure, &neighbours, &mut out).unwrap();
    (potential.grades(structure, &neighbours).unwrap().gamma.iter().sum(), out)
}

/// f′(0) from f(±h) and f(±2h).
fn derivative(h: f64, mut f: impl FnMut(f64) -> f64) -> f64 {
    (8.0 * (f(h) - f(-h)) - (f(2.0 * h) - f(-2.0 * h))) / (12.0 * h)
}

fn check(name: &str) {
    let (model, structure) = (model(name), alloy());
    let mixture = mixture(&model, &structure);
    let mut potential =
        BiasedPotential::new(Box::new(Grace::new(Arc::clone(&model))), mixture, None, 1, &structure.species)
            .unwrap();
    potential.tau = 0.3;
    evaluate(&mut potential, &structure); // the bias is silent at first
    let (_, biased) = evaluate(&mut potential, &structure);
    let physical = potential.physical().clone();
    let strain_derivative = *potential.strain_derivative();
    assert_eq!(biased.virial, physical.virial, "the cell has a bias of its own");

    let mut sum_of_grades = |structure: &Structure| evaluate(&mut potential, structure).0;
    let mut gradient: Vec<Vec3> = Vec::new();
    for atom in 0..structure.len() {
        gradient.push(std::array::from_fn(|axis| {
            derivative(1e-3, |shift| {
                let mut moved = structure.clone();
                moved.positions[atom][axis] += shift;
                sum_of_grades(&moved)
            })
        }));
    }
    let norm = |vectors: &[Vec3]| vectors.iter().map(|v| cell::norm(*v)).sum::<f64>();
    let scale = 0.3 * norm(&physical.forces) / norm(&gradient);
    let largest = biased.forces.iter().flatten().fold(0.0, |m: f64, f| m.max(f.abs()));
    for (atom, gradient) in gradient.iter().enumerate() {
        let expected = cell::add(physical.forces[atom], cell::scale(*gradient, scale));
        let error = cell::norm(cell::sub(biased.forces[atom], expected));
        assert!(error <= 1e-7 * largest, "{name}: atom {atom}: {error:e} of {largest}");
    }

    let largest = strain_derivative.iter().flatten().fold(0.0, |m: f64, w| m.max(w.abs()));
    for (k, l) in (0..9).map(|number| (number / 3, number % 3)) {
        let strain = derivative(1e-4, |strain| {
            let mut moved = structure.clone();
            moved.positions.iter_mut().chain(&mut moved.cell.0).for_each(|x| x[l] += strain * x[k]);
            sum_of_grades(&moved)
        });
        let found = strain_derivative[k][l];
        assert!((found - strain).abs() <= 1e-7 * largest, "{name}: {k} {l}: {found} is not {strain}");
    }
}

/// A rotation about an oblique axis, of row vectors.
const TURN: Matrix3 = [
    [2.0 / 3.0, -1.0 / 3.0, 2.0 / 3.0],
    [2.0 / 3.0, 2.0 / 3.0, -1.0 / 3.0],
    [-1.0 / 3.0, 2.0 / 3.0, 2.0 / 3.0],
];

fn product(a: &Matrix3, b: &Matrix3) -> Matrix3 {
    a.map(|row| cell::row_times(row, b))
}

fn transposed(a: &Matrix3) -> Matrix3 {
    std::array::from_fn(|k| std::array::from_fn(|l| a[l][k]))
}

fn distance(found: &[Vec3], expected: &[Vec3]) -> f64 {
    let size = expected.iter().map(|v| cell::norm(*v)).fold(0.0, f64::max);
    found.iter().zip(expected).map(|(a, b)| cell::norm(cell::sub(*a, *b))).fold(0.0, f64::max) / size
}

/// The biased forces, σ_bias for τ_s B = 1 and the energy after two evaluations, at the structure and with its atoms moved.
fn biased(
    model: &Arc<GraceModel>,
    mixture: &Arc<Mixture>,
    structure: &Structure,
    moved: &Structure,
) -> (Evaluation, Matrix3) {
    let grace = Box::new(Grace::new(Arc::clone(model)));
    let mut potential =
        BiasedPotential::new(grace, Arc::clone(mixture), None, 1, &structure.species).unwrap();
    potential.tau = 0.3;
    evaluate(&mut potential, structure);
    let (_, evaluation) = evaluate(&mut potential, moved);
    assert!(potential.bias_scale() > 0.0);
    (evaluation, potential.cell_stress(1.0))
}

/// The bias on atoms and cell turns with the structure and follows its atoms wherever they stand in the list.
#[test]
fn the_bias_is_that_of_a_turned_and_a_reordered_structure() {
    for name in ["two_layers.npz", "three_layers.npz"] {
        let (model, structure) = (model(name), alloy());
        let mixture = mixture(&model, &structure);
        let mut moved = structure.clone();
        moved.positions.iter_mut().enumerate().for_each(|(k, r)| r[(k + 1) % 3] += 0.1);
        let (expected, stress) = biased(&model, &mixture, &structure, &moved);
        assert!((stress.as_flattened().iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12, "{stress:?}");

        let turn = |structure: &Structure| Structure {
            positions: structure.positions.iter().map(|r| cell::row_times(*r, &TURN)).collect(),
            cell: Cell(product(&structure.cell.0, &TURN)),
            ..structure.clone()
        };
        let (found, turned_stress) = biased(&model, &mixture, &turn(&structure), &turn(&moved));
        let forces: Vec<Vec3> = expected.forces.iter().map(|f| cell::row_times(*f, &TURN)).collect();
        assert!(distance(&found.forces, &forces) < 1e-10, "{name}");
        let turned = product(&transposed(&TURN), &product(&stress, &TURN));
        assert!(distance(&turned_stress, &turned) < 1e-10, "{name}: {turned_stress:?} is not {turned:?}");

        let order = [2, 0, 3, 1];
        let reorder = |structure: &Structure| Structure {
            species: order.map(|k: usize| structure.species[k]).to_vec(),
            positions: order.map(|k| structure.positions[k]).to_vec(),
            ..structure.clone()
        };
        let (found, same_stress) = biased(&model, &mixture, &reorder(&structure), &reorder(&moved));
        assert!(distance(&found.forces, &order.map(|k| expected.forces[k])) < 1e-10, "{name}");
        assert!(distance(&same_stress, &stress) < 1e-10, "{name}: {same_stress:?} is not {stress:?}");
    }
}

#[test]
fn the_bias_on_two_layers_is_the_gradient_of_the_grade() {
    check("two_layers.npz");
}

#[test]
fn the_bias_on_three_layers_is_the_gradient_of_the_grade() {
    check("three_layers.npz");
}
