//! k-point meshes.

use std::f64::consts::TAU;

use atoms::Cell;
use atoms::cell::norm;

/// The Γ-centred mesh with at most `spacing`, Å⁻¹, between points along each reciprocal vector:
///
/// N_i = max(1, ⌈2π |b_i| / spacing⌉), with a_i · b_j = δ_ij
///
/// The length of the reciprocal vectors includes 2π, as in VASP's KSPACING. Non-periodic directions have one
/// point.
pub fn gamma_centred(cell: &Cell, periodic: [bool; 3], spacing: f64) -> [u32; 3] {
    let reciprocal = cell.completed(periodic).reciprocal();
    std::array::from_fn(|i| match periodic[i] {
        // A finer mesh is a mistake; the conversion saturates.
        true => ((TAU * norm(reciprocal[i]) / spacing - ROUNDING).ceil() as u32).max(1),
        false => 1,
    })
}

/// Tolerance for a length that is a multiple of the spacing up to rounding.
const ROUNDING: f64 = 1e-9;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_spacing_gives_its_mesh_for_aluminium() {
        // 2π / 4.05 / 0.125 = 12.4; without 2π it would be 2.
        let cell = Cell::orthorhombic(4.05, 4.05, 4.05);
        assert_eq!(gamma_centred(&cell, [true; 3], 0.125), [13; 3]);
        assert_eq!(gamma_centred(&cell, [true, true, false], 0.125), [13, 13, 1]);
    }

    #[test]
    fn each_direction_has_its_own_number() {
        let cell = Cell::orthorhombic(TAU, 2.0 * TAU, 40.0 * TAU);
        assert_eq!(gamma_centred(&cell, [true; 3], 0.25), [4, 2, 1]);
        // The reciprocal vectors of a sheared cell are longer than those of its edges.
        let sheared = Cell([[TAU, 0.0, 0.0], [TAU, TAU, 0.0], [0.0, 0.0, TAU]]);
        assert_eq!(gamma_centred(&sheared, [true; 3], 0.25), [6, 4, 4]);
    }
}
