//! The bulk modulus of a potential.

use atoms::{Evaluation, NeighbourList, Potential, Structure};

use crate::error::DynamicsError;
use crate::volume_ramp::scale_volume;

/// Relative volumes at which the energy is evaluated, symmetric about 1 and equally spaced.
const RELATIVE_VOLUMES: [f64; 5] = [0.96, 0.98, 1.0, 1.02, 1.04];

/// V d²E/dV² at the volume of the structure, eV/Å³, from the quartic through the energies at five volumes, to which cell
/// and positions are scaled. Positions are not relaxed. The volume is that of the cell, also of a slab.
///
/// Negative where the structure is not stable at this volume.
///
/// # Errors
/// The structure has no volume, or the potential cannot evaluate it.
pub fn bulk_modulus(structure: &Structure, potential: &mut dyn Potential) -> Result<f64, DynamicsError> {
    if structure.periodic == [false; 3] {
        return Err(DynamicsError::Barostat("a cluster has no volume"));
    }
    if structure.cell.volume() == 0.0 {
        return Err(DynamicsError::Barostat(
            "the lattice vectors do not span space, so the cell has no volume",
        ));
    }
    let mut neighbours = NeighbourList::new(potential.cutoff(), 0.0);
    let mut evaluation = Evaluation::default();
    let mut energies = [0.0; 5];
    for (energy, ratio) in energies.iter_mut().zip(RELATIVE_VOLUMES) {
        let mut scaled = structure.clone();
        scale_volume(&mut scaled, ratio);
        neighbours.update(&scaled)?;
        potential.evaluate(&scaled, &neighbours, &mut evaluation)?;
        *energy = evaluation.energy();
    }
    let [a, b, c, d, e] = energies;
    let spacing = (RELATIVE_VOLUMES[1] - RELATIVE_VOLUMES[0]) * structure.cell.volume();
    let curvature = (16.0 * (b + d) - (a + e) - 30.0 * c) / (12.0 * spacing.powi(2));
    Ok(structure.cell.volume() * curvature)
}
