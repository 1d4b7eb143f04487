//! Energy, features and their derivatives for one structure.

use std::sync::Arc;

use atoms::{Evaluation, Matrix3, NeighbourList, Potential, PotentialError, Species, Structure, Vec3};

use super::bonds::{BondWork, Bonds};
use super::matrix::{Lanes, ZERO};
use super::model::GraceModel;
use super::projection::ProjectionWork;
use super::readout::ReadoutWork;

/// The derivatives of a function H of the features: its cotangent ∂H/∂z pulled back to the atoms.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PullBack {
    /// +∂H/∂r, [n].
    pub gradient: Vec<Vec3>,
    /// +∂H/∂ε, symmetric.
    pub virial: Matrix3,
}

impl PullBack {
    /// Sets the gradient to `n` atoms and zero.
    pub fn reset(&mut self, n: usize) {
        self.gradient.clear();
        self.gradient.resize(n, [0.0; 3]);
        self.virial = [[0.0; 3]; 3];
    }
}

/// A GRACE model with the work arrays of one thread; after the first step it allocates no more.
///
/// [`Grace::forward`] gives energies and features, then [`Grace::backward`] the derivatives at the same
/// structure.
#[derive(Clone, Debug)]
pub struct Grace {
    model: Arc<GraceModel>,
    instructions: pulp::Arch,
    elements: Vec<usize>,
    bonds: Bonds,
    /// [n, tape]
    tapes: Vec<Lanes>,
    /// B, [n, lanes of the basis]
    bases: Vec<Lanes>,
    /// ∂E/∂y, [n, lanes of the densities]
    density_cotangents: Vec<Lanes>,
    atomic_energies: Vec<f64>,
    features: Vec<f64>,
    readout: ReadoutWork,
    projection: ProjectionWork,
    /// Cotangent of B from the features, [n, lanes of the basis]
    basis_cotangents: Vec<Lanes>,
    /// Cotangent of one atom's B from the energy.
    energy_basis_cotangent: Vec<Lanes>,
    /// Cotangent tapes of one atom, for the energy and for the features.
    cotangent_tapes: [Vec<Lanes>; 2],
    bond_work: BondWork,
}

impl Grace {
    /// An evaluator of `model`; nothing is computed yet.
    pub fn new(model: Arc<GraceModel>) -> Self {
        Self {
            instructions: pulp::Arch::new(),
            elements: Vec::new(),
            bonds: Bonds::default(),
            tapes: Vec::new(),
            bases: Vec::new(),
            density_cotangents: Vec::new(),
            atomic_energies: Vec::new(),
            features: Vec::new(),
            readout: ReadoutWork::default(),
            projection: ProjectionWork::default(),
            basis_cotangents: Vec::new(),
            energy_basis_cotangent: Vec::new(),
            cotangent_tapes: std::array::from_fn(|_| vec![ZERO; model.tape_lanes]),
            bond_work: BondWork::new(&model),
            model,
        }
    }

    /// The weights.
    pub fn model(&self) -> &Arc<GraceModel> {
        &self.model
    }

    /// Computes atomic energies and features z of `structure`.
    ///
    /// `neighbours` must be up to date for it.
    ///
    /// # Errors
    /// An element the model does not know, or a neighbour list shorter than [`GraceModel::cutoff`].
    pub fn forward(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
    ) -> Result<(), PotentialError> {
        self.take(structure, neighbours)?;
        self.instructions.dispatch(Forward { grace: self, features: true });
        Ok(())
    }

    /// Elements and bonds of a structure; results of an earlier one are dropped.
    fn take(&mut self, structure: &Structure, neighbours: &NeighbourList) -> Result<(), PotentialError> {
        self.elements.clear();
        self.atomic_energies.clear();
        self.features.clear();
        let needed = self.model.cutoff();
        if neighbours.cutoff() < needed {
            return Err(PotentialError::Cutoff { list: neighbours.cutoff(), needed });
        }
        self.model.write_element_indices(&structure.species, &mut self.elements)?;
        self.bonds.update(&self.model, structure, neighbours, &self.elements);
        Ok(())
    }

    #[inline(always)]
    fn forward_atoms(&mut self) {
        let (model, n) = (&*self.model, self.elements.len());
        let (tape_lanes, basis_lanes) = (model.tape_lanes, model.basis.lanes());
        let density_lanes = model.readout.density_lanes();
        self.tapes.resize(n * tape_lanes, ZERO);
        self.bases.resize(n * basis_lanes, ZERO);
        self.density_cotangents.resize(n * density_lanes, ZERO);
        for (i, element) in self.elements.iter().enumerate() {
            let tape = &mut self.tapes[i * tape_lanes..(i + 1) * tape_lanes];
            tape.fill(ZERO);
            let density = &mut tape[..model.density.end()];
            self.bonds.accumulate(i, model, *element, density, &mut self.bond_work);
            for operation in &model.operations {
                operation.forward(tape);
            }
            let basis = &mut self.bases[i * basis_lanes..(i + 1) * basis_lanes];
            model.basis.forward(tape, basis);
            let cotangent = &mut self.density_cotangents[i * density_lanes..(i + 1) * density_lanes];
            let energy = model.readout.evaluate(*element, basis, cotangent, &mut self.readout);
            self.atomic_energies.push(energy);
        }
    }

    #[inline(always)]
    fn forward_features(&mut self) {
        if let Some(projection) = &self.model.projection {
            let n = self.elements.len();
            projection.forward(n, &self.bases, &mut self.features, &mut self.projection);
        }
    }

    /// Energy of each atom at the last [`Grace::forward`], [n], eV.
    pub fn atomic_energies(&self) -> &[f64] {
        &self.atomic_energies
    }

    /// Features z at the last [`Grace::forward`], [n, D] row-major; empty for a model without them.
    pub fn features(&self) -> &[f64] {
        &self.features
    }

    /// The derivatives at the structure of the last [`Grace::forward`], in one reverse sweep: of the
    /// energy into `energy`, and, where a cotangent ∂H/∂z [n, D] is given, of H into `pull_back`
    /// (zero otherwise).
    ///
    /// # Panics
    /// If the cotangent is not as long as [`Grace::features`].
    pub fn backward(
        &mut self,
        feature_cotangent: Option<&[f64]>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        pull_back.reset(self.elements.len());
        if let Some(cotangent) = feature_cotangent {
            assert_eq!(cotangent.len(), self.features.len(), "a cotangent for every feature");
        }
        self.sweep(feature_cotangent, energy, pull_back);
    }

    fn sweep(
        &mut self,
        feature_cotangent: Option<&[f64]>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        energy.reset(self.elements.len());
        energy.atomic_energies.copy_from_slice(&self.atomic_energies);
        self.instructions.dispatch(Backward { grace: self, feature_cotangent, energy, pull_back });
        energy.virial = symmetric(&energy.virial).map(|row| row.map(|x| -x));
        pull_back.virial = symmetric(&pull_back.virial);
    }

    #[inline(always)]
    fn backward_features(&mut self, cotangent: &[f64]) {
        if let Some(projection) = &self.model.projection {
            let (n, out) = (self.elements.len(), &mut self.basis_cotangents);
            projection.backward(n, &self.bases, cotangent, out, &mut self.projection);
        }
    }

    /// Atom by atom back along the tape, then along the bonds; `N` is 2 with a cotangent of the features.
    #[inline(always)]
    fn backward_atoms<const N: usize>(&mut self, energy: &mut Evaluation, pull_back: &mut PullBack) {
        let model = &*self.model;
        let (tape_lanes, basis_lanes) = (model.tape_lanes, model.basis.lanes());
        let density_lanes = model.readout.density_lanes();
        self.energy_basis_cotangent.resize(basis_lanes, ZERO);
        for (i, element) in self.elements.iter().enumerate() {
            let tape = &self.tapes[i * tape_lanes..(i + 1) * tape_lanes];
            let densities = &self.density_cotangents[i * density_lanes..(i + 1) * density_lanes];
            self.energy_basis_cotangent.fill(ZERO);
            model.readout.basis_cotangent(*element, densities, &mut self.energy_basis_cotangent);
            for (k, cotangent) in self.cotangent_tapes.iter_mut().enumerate().take(N) {
                let basis = match k {
                    0 => &self.energy_basis_cotangent[..],
                    _ => &self.basis_cotangents[i * basis_lanes..(i + 1) * basis_lanes],
                };
                cotangent.fill(ZERO);
                model.basis.backward(basis, cotangent);
                for operation in model.operations.iter().rev() {
                    operation.backward(tape, cotangent);
                }
            }
            let densities: [&[Lanes]; N] =
                std::array::from_fn(|k| &self.cotangent_tapes[k][..model.density.end()]);
            let work = &mut self.bond_work;
            self.bonds.reverse(i, model, densities, work, |bond, gradients| {
                let j = bond.neighbour as usize;
                add_bond(&mut energy.forces, &mut energy.virial, j, i, bond.d, gradients[0]);
                if N == 2 {
                    add_bond(&mut pull_back.gradient, &mut pull_back.virial, i, j, bond.d, gradients[N - 1]);
                }
            });
        }
    }
}

/// The forward pass, compiled for the widest vectors of the processor.
struct Forward<'a> {
    grace: &'a mut Grace,
    features: bool,
}

impl pulp::WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        self.grace.forward_atoms();
        if self.features {
            self.grace.forward_features();
        }
    }
}

/// The reverse sweep, compiled likewise.
struct Backward<'a> {
    grace: &'a mut Grace,
    feature_cotangent: Option<&'a [f64]>,
    energy: &'a mut Evaluation,
    pull_back: &'a mut PullBack,
}

impl pulp::WithSimd for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        match self.feature_cotangent {
            Some(cotangent) if self.grace.model.projection.is_some() => {
                self.grace.backward_features(cotangent);
                self.grace.backward_atoms::<2>(self.energy, self.pull_back);
            }
            _ => self.grace.backward_atoms::<1>(self.energy, self.pull_back),
        }
    }
}

/// With g = ∂/∂d: `gradient` loses g at `less` and gains it at `more`; `virial` gains g ⊗ d.
#[inline(always)]
fn add_bond(gradient: &mut [Vec3], virial: &mut Matrix3, less: usize, more: usize, d: Vec3, g: Vec3) {
    for a in 0..3 {
        gradient[less][a] -= g[a];
        gradient[more][a] += g[a];
        for b in 0..3 {
            virial[a][b] += g[a] * d[b];
        }
    }
}

/// The tensor is symmetric because energy and features do not change under rotation; this removes rounding.
fn symmetric(tensor: &Matrix3) -> Matrix3 {
    std::array::from_fn(|a| std::array::from_fn(|b| 0.5 * (tensor[a][b] + tensor[b][a])))
}

impl Potential for Grace {
    fn cutoff(&self) -> f64 {
        self.model.cutoff()
    }

    fn species(&self) -> &[Species] {
        self.model.elements()
    }

    fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.take(structure, neighbours)?;
        self.instructions.dispatch(Forward { grace: self, features: false });
        self.sweep(None, out, &mut PullBack::default());
        Ok(())
    }
}
