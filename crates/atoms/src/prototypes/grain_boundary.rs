//! The symmetric Σ5 (310)[001] tilt boundary.

use super::Prototype;
use crate::cell::{Cell, Vec3, norm};
use crate::{Species, Structure};

/// A periodic bicrystal with two equivalent boundaries, normal to its first lattice vector.
#[derive(Clone, Debug, PartialEq)]
pub struct GrainBoundary {
    /// The atoms.
    pub structure: Structure,
    /// x of both boundaries, Å.
    pub planes: [f64; 2],
}

/// Least thickness of a grain, Å.
const THICKNESS: f64 = 16.0;
/// Mirror images closer than this, in nearest-neighbour distances, become one atom between them.
const MERGED: f64 = 0.7;

/// The symmetric Σ5 (310)[001] tilt boundary of an fcc or bcc crystal: two crystals that are mirror images in a (310) plane through
/// atoms, at least 16 Å thick. Pairs of mirror images that overlap become one atom on the plane. `distance` of nearest neighbours
/// in Å. `None` for other crystals.
pub fn grain_boundary(prototype: Prototype, species: Species, distance: f64) -> Option<GrainBoundary> {
    // Shortest lattice vectors along [310] and [−130], in units of a.
    let factor = match prototype {
        Prototype::Fcc => 0.5,
        Prototype::Bcc => 1.0,
        _ => return None,
    };
    let a = prototype.lattice_constant(distance);
    let (root, period) = (10.0_f64.sqrt(), factor * 10.0_f64.sqrt() * a);
    let thickness = period * (THICKNESS / period).ceil();
    let cell = Cell::orthorhombic(2.0 * thickness, period, 2.0 * a);
    let crystal = prototype.structure(species, distance);
    let reach = ((thickness + period) / a).ceil() as i32 + 1;
    let mut positions = Vec::new();
    for (i, j, k) in images(reach) {
        for site in &crystal.positions {
            let [x, y, z] =
                [site[0] + a * f64::from(i), site[1] + a * f64::from(j), site[2] + a * f64::from(k)];
            let turned = [(3.0 * x + y) / root, (3.0 * y - x) / root, z];
            push_with_image(&mut positions, turned, &cell, thickness, MERGED * distance);
        }
    }
    let structure =
        Structure { species: vec![species; positions.len()], positions, cell, periodic: [true; 3] };
    Some(GrainBoundary { structure, planes: [0.0, thickness] })
}

/// Cells that may hold atoms of the first grain.
fn images(reach: i32) -> impl Iterator<Item = (i32, i32, i32)> {
    (-reach..=reach).flat_map(move |i| (-reach..=reach).flat_map(move |j| (0..2).map(move |k| (i, j, k))))
}

/// Adds an atom of the first grain, 0 ≤ x ≤ `thickness`, and its mirror image, or one atom if they overlap.
fn push_with_image(positions: &mut Vec<Vec3>, [x, y, z]: Vec3, cell: &Cell, thickness: f64, least: f64) {
    let tolerance = 1e-6;
    let length = cell.0[1][1];
    let is_inside = (-tolerance..=thickness + tolerance).contains(&x)
        && (-tolerance..length - tolerance).contains(&y)
        && (-tolerance..cell.0[2][2] - tolerance).contains(&z);
    if !is_inside {
        return;
    }
    match () {
        () if 2.0 * x < least => positions.push([0.0, y, z]),
        () if 2.0 * (thickness - x) < least => positions.push([thickness, y, z]),
        () => positions.extend([[x, y, z], [2.0 * thickness - x, y, z]]),
    }
}

impl GrainBoundary {
    /// Distance of each atom to the nearer boundary, `[n]`, Å.
    pub fn distances(&self) -> Vec<f64> {
        let length = norm(self.structure.cell.0[0]);
        let nearest = |x: f64, plane: f64| {
            let d = (x - plane).rem_euclid(length);
            d.min(length - d)
        };
        let of = |r: &Vec3| nearest(r[0], self.planes[0]).min(nearest(r[0], self.planes[1]));
        self.structure.positions.iter().map(of).collect()
    }
}
