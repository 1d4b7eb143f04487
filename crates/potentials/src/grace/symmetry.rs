//! A check of models whose files do not state how their parts are connected.
//!
//! If a product uses another factor than the author of the model intended, components of different orders mix,
//! and energies are not rotationally invariant.

use std::sync::Arc;

use atoms::{Cell, NeighbourList, Structure, Vec3};
use npz::NpzFile;

use super::error::{GraceError, unsupported};
use super::model::GraceModel;
use super::potential::Grace;

/// The largest change relative to the largest energy without shifts: far above rounding, even for weights that
/// were once in single precision.
const TOLERANCE: f64 = 1e-3;

/// Atoms of a cluster, in units of the cutoff.
const SITES: [Vec3; 6] = [
    [0.0, 0.0, 0.0],
    [0.42, 0.05, 0.1],
    [-0.1, 0.45, 0.2],
    [0.15, -0.3, 0.4],
    [-0.35, -0.2, -0.25],
    [0.3, -0.45, -0.2],
];

/// Rejects a model if atomic energies change when a cluster is rotated or reflected.
pub(super) fn require_invariance(archive: &NpzFile, model: GraceModel) -> Result<GraceModel, GraceError> {
    let model = Arc::new(model);
    let mut grace = Grace::new(Arc::clone(&model));
    let here = energies(&mut grace, |x| x);
    let largest = here.iter().fold(f64::MIN_POSITIVE, |most, energy| most.max(energy.abs()));
    let turned =
        |[x, y, z]: Vec3| [0.36 * x - 0.8 * y - 0.48 * z, 0.48 * x + 0.6 * y - 0.64 * z, 0.8 * x + 0.6 * z];
    let mirrored = |x: Vec3| turned(x).map(|x| -x);
    for there in [energies(&mut grace, turned), energies(&mut grace, mirrored)] {
        let change = here.iter().zip(&there).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        if change.is_nan() || change > TOLERANCE * largest {
            let reason = format!(
                "energies change by {change:.1e} eV when a cluster is rotated: the parts of this \
                 model are not connected as in the supported models"
            );
            return Err(unsupported(archive, reason));
        }
    }
    drop(grace);
    Ok(Arc::unwrap_or_clone(model))
}

/// Atomic energies without the shifts of their elements, eV.
fn energies(grace: &mut Grace, place: impl Fn(Vec3) -> Vec3) -> Vec<f64> {
    let model = Arc::clone(grace.model());
    let elements = (0..SITES.len()).map(|atom| atom % model.elements().len());
    let structure = Structure {
        species: elements.clone().map(|element| model.elements()[element]).collect(),
        positions: SITES.map(|site| place(site).map(|x| model.cutoff() * x)).to_vec(),
        cell: Cell::orthorhombic(1.0, 1.0, 1.0),
        periodic: [false; 3],
    };
    let mut neighbours = NeighbourList::new(model.cutoff(), 0.0);
    neighbours.update(&structure).expect("a few atoms some Å apart");
    grace.forward(&structure, &neighbours).expect("a list as long as the cutoff, and elements of the model");
    let shifts = elements.map(|element| model.network.shifts()[element]);
    grace.atomic_energies().iter().zip(shifts).map(|(energy, shift)| energy - shift).collect()
}
