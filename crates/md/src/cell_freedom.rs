//! Which motions of the cell a barostat allows.

use atoms::cell::{self, dot};
use atoms::{Matrix3, Structure};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::strain_rate::{IDENTITY, StrainModes, combined, product, trace, transposed};

/// Which motions of the cell a barostat allows. Directions that are not periodic never move.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum CellFreedom {
    /// All lengths and angles. The strain rate is symmetric, so the cell does not rotate.
    #[default]
    Flexible,
    /// The volume, at constant shape.
    Isotropic,
    /// The lengths of the lattice vectors, at constant angles.
    FixedAngles,
}

/// The motions that a cell has in one structure.
pub(crate) struct CellSpace {
    freedom: CellFreedom,
    /// Lattice vectors, with unit vectors along directions that are not periodic.
    lattice: Matrix3,
    reciprocal: Matrix3,
    periodic: [bool; 3],
}

impl CellSpace {
    pub fn new(freedom: CellFreedom, structure: &Structure) -> Self {
        let lattice = structure.cell.completed(structure.periodic);
        Self { freedom, lattice: lattice.0, reciprocal: lattice.reciprocal(), periodic: structure.periodic }
    }

    /// d, the number of periodic directions.
    pub fn dimensions(&self) -> usize {
        self.periodic.iter().filter(|periodic| **periodic).count()
    }

    /// Number of independent strain rates.
    pub fn degrees_of_freedom(&self) -> usize {
        let d = self.dimensions();
        match self.freedom {
            CellFreedom::Flexible => d * (d + 1) / 2,
            CellFreedom::Isotropic => d.min(1),
            CellFreedom::FixedAngles => d,
        }
    }

    /// The part of a symmetric tensor that moves the cell: the orthogonal projection on the symmetric strain rates along
    /// periodic directions, on multiples of the identity there, or, at fixed angles, Σ_k (b_k T a_kᵀ) b_kᵀ a_k over the
    /// periodic lattice vectors a_k and their reciprocal vectors b_k.
    pub fn project(&self, tensor: &Matrix3) -> Matrix3 {
        let plane = self.projector();
        match self.freedom {
            CellFreedom::Flexible => {
                let inside = product(&plane, &product(tensor, &plane));
                combined(&inside, &transposed(&inside), |a, b| 0.5 * (a + b))
            }
            CellFreedom::Isotropic => {
                let mean = trace(&product(&plane, tensor)) / self.dimensions().max(1) as f64;
                plane.map(|row| row.map(|x| mean * x))
            }
            CellFreedom::FixedAngles => {
                let along = |k: usize| dot(cell::row_times(self.reciprocal[k], tensor), self.lattice[k]);
                self.along_vectors(std::array::from_fn(along))
            }
        }
    }

    /// Tr ν² for a strain rate of this space: Σ_ij ν_ij², or Σ_k λ_k² at fixed angles.
    pub fn square(&self, rate: &Matrix3) -> f64 {
        match self.freedom {
            CellFreedom::Flexible | CellFreedom::Isotropic => rate.iter().map(|row| dot(*row, *row)).sum(),
            CellFreedom::FixedAngles => {
                let rates = StrainModes::along(&self.lattice, &self.reciprocal, rate).rates;
                dot(rates, rates)
            }
        }
    }

    /// The strain rate of this space whose components are the given standard normal numbers, where a component is
    /// measured by [`CellSpace::square`].
    pub fn normal(&self, [[xx, yy, zz], [yz, xz, xy]]: [[f64; 3]; 2]) -> Matrix3 {
        match self.freedom {
            CellFreedom::Flexible | CellFreedom::Isotropic => {
                let half = std::f64::consts::FRAC_1_SQRT_2;
                let [yz, xz, xy] = [yz, xz, xy].map(|x| half * x);
                self.project(&[[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            }
            CellFreedom::FixedAngles => self.along_vectors([xx, yy, zz]),
        }
    }

    /// The modes of a strain rate of this space.
    pub fn modes(&self, rate: &Matrix3) -> StrainModes {
        match self.freedom {
            CellFreedom::Flexible | CellFreedom::Isotropic => StrainModes::of_symmetric(rate),
            CellFreedom::FixedAngles => StrainModes::along(&self.lattice, &self.reciprocal, rate),
        }
    }

    /// The isotropic part of a strain rate: Tr ν / d along periodic directions.
    pub fn isotropic(&self, rate: &Matrix3) -> Matrix3 {
        let mean = trace(rate) / self.dimensions().max(1) as f64;
        self.projector().map(|row| row.map(|x| mean * x))
    }

    /// The projector on the periodic directions.
    fn projector(&self) -> Matrix3 {
        let mut projector = IDENTITY;
        for normal in (0..3).filter(|k| !self.periodic[*k]).map(|k| self.lattice[k]) {
            for (i, row) in projector.iter_mut().enumerate() {
                row.iter_mut().zip(normal).for_each(|(x, n)| *x -= normal[i] * n);
            }
        }
        projector
    }

    /// Σ_k λ_k b_kᵀ a_k over the periodic lattice vectors.
    fn along_vectors(&self, rates: [f64; 3]) -> Matrix3 {
        let rates: [f64; 3] = std::array::from_fn(|k| if self.periodic[k] { rates[k] } else { 0.0 });
        let entry =
            |i: usize, j: usize| (0..3).map(|k| rates[k] * self.reciprocal[k][i] * self.lattice[k][j]).sum();
        std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)))
    }
}
