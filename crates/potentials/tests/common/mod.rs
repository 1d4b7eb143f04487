//! Finite-difference checks for every potential, reference data, and model files to corrupt.

pub mod golden;
pub mod model_file;

use atoms::{Cell, Evaluation, Matrix3, NeighbourList, Potential, Structure, Vec3};

/// Energies, forces and virial of `structure`, with a new neighbour list.
pub fn evaluate(potential: &mut dyn Potential, structure: &Structure) -> Evaluation {
    let mut neighbours = NeighbourList::new(potential.cutoff(), 0.0);
    neighbours.update(structure).unwrap();
    let mut evaluation = Evaluation::default();
    potential.evaluate(structure, &neighbours, &mut evaluation).unwrap();
    evaluation
}

/// f'(0) from f(±h) and f(±2h), error O(h⁴).
pub fn central_difference(h: f64, mut f: impl FnMut(f64) -> f64) -> f64 {
    (8.0 * (f(h) - f(-h)) - (f(2.0 * h) - f(-2.0 * h))) / (12.0 * h)
}

/// `structure` with coordinate `axis` of `atom` moved by `shift`, Å.
pub fn displaced(structure: &Structure, atom: usize, axis: usize, shift: f64) -> Structure {
    let mut moved = structure.clone();
    moved.positions[atom][axis] += shift;
    moved
}

/// `structure` under the strain ε with the one entry ε_ab = `strain`: x → x (1 + ε), cell included.
pub fn strained(structure: &Structure, a: usize, b: usize, strain: f64) -> Structure {
    let deform = |mut x: Vec3| {
        x[b] += strain * x[a];
        x
    };
    Structure {
        species: structure.species.clone(),
        positions: structure.positions.iter().map(|x| deform(*x)).collect(),
        cell: Cell(structure.cell.0.map(deform)),
        periodic: structure.periodic,
    }
}

/// The gradient of `f` with respect to positions, `[n]`.
pub fn position_gradient(structure: &Structure, h: f64, mut f: impl FnMut(&Structure) -> f64) -> Vec<Vec3> {
    (0..structure.len())
        .map(|atom| {
            std::array::from_fn(|axis| {
                central_difference(h, |shift| f(&displaced(structure, atom, axis, shift)))
            })
        })
        .collect()
}

/// ∂f/∂ε.
pub fn strain_gradient(structure: &Structure, h: f64, mut f: impl FnMut(&Structure) -> f64) -> Matrix3 {
    std::array::from_fn(|a| {
        std::array::from_fn(|b| central_difference(h, |strain| f(&strained(structure, a, b, strain))))
    })
}

/// Asserts |found − expected| ≤ tolerance · largest |expected| for every entry.
pub fn assert_close(what: &str, found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{what}: lengths");
    let scale = expected.iter().fold(0.0, |m: f64, x| m.max(x.abs()));
    for (k, (f, e)) in found.iter().zip(expected).enumerate() {
        let error = (f - e).abs();
        assert!(
            error <= tolerance * scale,
            "{what}[{k}]: {f} is not {e} (largest {scale}, error {error:.2e})"
        );
    }
}

/// Compares forces with central differences of the energy over ±h and ±2h, Å, for every atom;
/// `tolerance` is relative to the largest force component.
pub fn check_forces(potential: &mut dyn Potential, structure: &Structure, h: f64, tolerance: f64) {
    let forces = evaluate(potential, structure).forces;
    let numerical = position_gradient(structure, h, |moved| -evaluate(potential, moved).energy());
    assert_close("force", forces.as_flattened(), numerical.as_flattened(), tolerance);
}

/// Compares the virial with −∂E/∂ε by central differences over ±h and ±2h; `tolerance` is relative
/// to the largest entry.
pub fn check_virial(potential: &mut dyn Potential, structure: &Structure, h: f64, tolerance: f64) {
    let virial = evaluate(potential, structure).virial;
    let numerical = strain_gradient(structure, h, |strained| -evaluate(potential, strained).energy());
    assert_close("virial", virial.as_flattened(), numerical.as_flattened(), tolerance);
}
