//! Crystal structures with one kind of atom.

use std::fmt;

use crate::cell::{Cell, Vec3, scale};
use crate::{Species, Structure};

/// A crystal structure of an element (Strukturbericht in brackets).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Prototype {
    /// Face-centred cubic (A1).
    Fcc,
    /// Body-centred cubic (A2).
    Bcc,
    /// Hexagonal close-packed (A3).
    Hcp {
        /// c/a; √(8/3) for touching spheres.
        c_over_a: f64,
    },
    /// Diamond (A4).
    Diamond,
    /// Simple cubic (A_h).
    SimpleCubic,
}

impl Prototype {
    /// Whether all axes are equivalent.
    pub fn is_cubic(self) -> bool {
        !matches!(self, Self::Hcp { .. })
    }

    /// Edge a of the conventional cell, Å, whose atoms are `distance` Å apart.
    pub fn lattice_constant(self, distance: f64) -> f64 {
        distance
            * match self {
                Self::Fcc => std::f64::consts::SQRT_2,
                Self::Bcc => 2.0 / 3.0_f64.sqrt(),
                Self::Diamond => 4.0 / 3.0_f64.sqrt(),
                Self::SimpleCubic => 1.0,
                // Neighbours are a apart within a layer and √(a²/3 + c²/4) between layers.
                Self::Hcp { c_over_a } => 1.0 / (1.0 / 3.0 + 0.25 * c_over_a * c_over_a).sqrt().min(1.0),
            }
    }

    /// The conventional cell with nearest neighbours `distance` Å apart.
    pub fn structure(self, species: Species, distance: f64) -> Structure {
        let a = self.lattice_constant(distance);
        let cell = Cell(self.axes().map(|axis| scale(axis, a)));
        let positions: Vec<_> = self.sites().into_iter().map(|site| cell.cartesian(site)).collect();
        Structure { species: vec![species; positions.len()], positions, cell, periodic: [true; 3] }
    }

    /// Lattice vectors of the conventional cell in units of a.
    fn axes(self) -> [Vec3; 3] {
        match self {
            Self::Hcp { c_over_a } => [[1.0, 0.0, 0.0], [-0.5, 0.75_f64.sqrt(), 0.0], [0.0, 0.0, c_over_a]],
            _ => [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        }
    }

    /// Fractional coordinates of the atoms of the conventional cell.
    fn sites(self) -> Vec<Vec3> {
        let face_centres = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];
        match self {
            Self::Fcc => face_centres.to_vec(),
            Self::Bcc => vec![[0.0; 3], [0.5; 3]],
            Self::SimpleCubic => vec![[0.0; 3]],
            Self::Diamond => face_centres.iter().flat_map(|site| [*site, site.map(|x| x + 0.25)]).collect(),
            Self::Hcp { .. } => vec![[0.0; 3], [1.0 / 3.0, 2.0 / 3.0, 0.5]],
        }
    }
}

impl fmt::Display for Prototype {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Fcc => "fcc",
            Self::Bcc => "bcc",
            Self::Hcp { .. } => "hcp",
            Self::Diamond => "diamond",
            Self::SimpleCubic => "sc",
        })
    }
}
