//! A vacancy in a crystal.

use super::Prototype;
use crate::cell::{Vec3, add, norm, sub};
use crate::{Repetition, Species, Structure};

/// A periodic crystal without one atom.
#[derive(Clone, Debug, PartialEq)]
pub struct Vacancy {
    /// The remaining atoms.
    pub structure: Structure,
    /// Where the missing atom was, Å.
    pub centre: Vec3,
}

/// A vacancy in 108 sites of fcc, 128 of bcc, 216 of diamond, 150 of hcp and 125 of simple cubic (of fcc and bcc as in the paper,
/// 'Controlled structural and chemical extrapolation'). `distance` of nearest neighbours in Å.
pub fn vacancy(prototype: Prototype, species: Species, distance: f64) -> Vacancy {
    let times = match prototype {
        Prototype::Fcc | Prototype::Diamond => [3; 3],
        Prototype::Bcc => [4; 3],
        Prototype::SimpleCubic => [5; 3],
        Prototype::Hcp { .. } => [5, 5, 3],
    };
    let mut structure = prototype.structure(species, distance).repeated(Repetition(times));
    structure.species.pop();
    let centre = structure.positions.pop().expect("a crystal has atoms");
    Vacancy { structure, centre }
}

impl Vacancy {
    /// Distance of each atom to the nearest image of the vacancy, `[n]`, Å.
    pub fn distances(&self) -> Vec<f64> {
        let cell = &self.structure.cell;
        let images = || (0..27).map(|k| cell.translation([k / 3 / 3 - 1, k / 3 % 3 - 1, k % 3 - 1]));
        let nearest = |r: &Vec3| {
            let d = cell.fractional(sub(*r, self.centre));
            let d = cell.cartesian(d.map(|x| x - x.round()));
            images().map(|image| norm(add(d, image))).fold(f64::INFINITY, f64::min)
        };
        self.structure.positions.iter().map(nearest).collect()
    }
}
