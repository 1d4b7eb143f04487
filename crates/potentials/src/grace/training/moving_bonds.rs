//! The direction along which a loss moves a structure, bond by bond.

use atoms::{Matrix3, NeighbourList, Structure, Vec3};

use super::super::batches::Batches;
use super::super::bonds::{GraceBond, bonds_of};
use super::super::radial::RadialFunctions;
use super::super::vector::{Double, Vector};

/// The derivatives of a loss L with respect to what a model says about a structure.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LossGradient {
    /// ∂L/∂E, 1/eV
    pub energy: f64,
    /// ∂L/∂F, `[n]`, Å/eV
    pub forces: Vec<Vec3>,
    /// ∂L/∂W, 1/eV, with the virial W of [`Evaluation`](atoms::Evaluation).
    pub virial: Matrix3,
}

impl LossGradient {
    /// The change F̄_b − F̄_a + W̄ d of the bond d from atom a to atom b.
    fn change(&self, [a, b]: [usize; 2], d: &Vec3) -> Vec3 {
        let (here, there, w) = (&self.forces[a], &self.forces[b], &self.virial);
        std::array::from_fn(|i| {
            let strained: f64 = (0..3).map(|k| 0.5 * (w[i][k] + w[k][i]) * d[k]).sum();
            there[i] - here[i] + strained
        })
    }
}

/// The bonds of all atoms, by place, with the directions along which they change.
#[derive(Clone, Debug, Default)]
pub(super) struct MovingStructure {
    offsets: Vec<usize>,
    bonds: Vec<GraceBond>,
    directions: Vec<Vec3>,
}

/// Those of one atom.
#[derive(Clone, Copy)]
pub(super) struct MovingBonds<'a> {
    pub bonds: &'a [GraceBond],
    /// u, Å
    pub directions: &'a [Vec3],
}

impl MovingStructure {
    /// Collects the bonds within the cutoff of their pair.
    pub fn update(
        &mut self,
        radial: &RadialFunctions<Double>,
        structure: &Structure,
        neighbours: &NeighbourList,
        (elements, batches): (&[usize], &Batches),
        loss: &LossGradient,
    ) {
        let Self { offsets, bonds, directions } = self;
        offsets.clear();
        offsets.push(0);
        bonds.clear();
        directions.clear();
        for place in 0..elements.len() {
            let atom = batches.order[place] as usize;
            for bond in bonds_of(atom, radial, structure, neighbours, elements, batches) {
                let other = batches.order[bond.neighbour as usize] as usize;
                directions.push(loss.change([atom, other], &bond.d));
                bonds.push(bond);
            }
            offsets.push(bonds.len());
        }
    }

    /// The bonds of the atom at a place.
    #[inline(always)]
    pub fn of_place(&self, place: usize) -> MovingBonds<'_> {
        let own = self.offsets[place]..self.offsets[place + 1];
        MovingBonds { bonds: &self.bonds[own.clone()], directions: &self.directions[own] }
    }
}

impl<'a> MovingBonds<'a> {
    /// In blocks of as many as a vector has lanes.
    #[inline(always)]
    pub fn blocks(self) -> impl Iterator<Item = MovingBonds<'a>> {
        let blocks = self.bonds.chunks(Double::LANES).zip(self.directions.chunks(Double::LANES));
        blocks.map(|(bonds, directions)| Self { bonds, directions })
    }
}
