//! Energy, features and their derivatives for one structure.

use std::sync::Arc;

use atoms::{Evaluation, Matrix3, NeighbourList, Potential, PotentialError, Species, Structure, Vec3};

use super::layer_work::{BasisCotangents, LayerWork};
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
    layers: Vec<LayerWork>,
    /// B, [n, lanes of the basis]
    bases: Vec<Lanes>,
    /// ∂E/∂(W B) of each layer, [n, lanes of the densities]
    density_cotangents: Vec<Lanes>,
    atomic_energies: Vec<f64>,
    features: Vec<f64>,
    readout: ReadoutWork,
    projection: ProjectionWork,
    /// Cotangent of B from the features, [n, lanes of the basis]
    basis_cotangents: Vec<Lanes>,
}

impl Grace {
    /// An evaluator of `model`; nothing is computed yet.
    pub fn new(model: Arc<GraceModel>) -> Self {
        Self {
            instructions: pulp::Arch::new(),
            elements: Vec::new(),
            layers: model.layers.iter().map(LayerWork::new).collect(),
            bases: Vec::new(),
            density_cotangents: Vec::new(),
            atomic_energies: Vec::new(),
            features: Vec::new(),
            readout: ReadoutWork::default(),
            projection: ProjectionWork::default(),
            basis_cotangents: Vec::new(),
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
        for (work, layer) in self.layers.iter_mut().zip(&self.model.layers) {
            work.bonds.update(layer, structure, neighbours, &self.elements);
        }
        Ok(())
    }

    /// Layer after layer, all atoms of one before the next, which needs the messages of neighbours.
    #[inline(always)]
    fn forward_layers(&mut self) {
        let model = &*self.model;
        let basis_lanes = model.basis_lanes();
        self.bases.resize(self.elements.len() * basis_lanes, ZERO);
        for (k, layer) in model.layers.iter().enumerate() {
            let (before, work) = self.layers.split_at_mut(k);
            if let (Some(before), Some(layer_before)) = (before.last(), k.checked_sub(1)) {
                work[0].take_messages(layer, &self.elements, before, &model.layers[layer_before]);
            }
            let place = (model.basis_start(k), basis_lanes);
            work[0].forward(layer, &self.elements, &mut self.bases, place);
        }
    }

    #[inline(always)]
    fn forward_energies(&mut self) {
        let model = &*self.model;
        let density_lanes = model.readout.density_lanes();
        self.density_cotangents.resize(self.elements.len() * density_lanes, ZERO);
        let bases = self.bases.chunks_exact(model.basis_lanes());
        let cotangents = self.density_cotangents.chunks_exact_mut(density_lanes);
        for ((element, basis), cotangent) in self.elements.iter().zip(bases).zip(cotangents) {
            let (readout, work) = (&model.readout, &mut self.readout);
            self.atomic_energies.push(readout.evaluate(*element, basis, &model.basis_ends, cotangent, work));
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

    /// The layers backwards, all atoms of one before the next, which needs the cotangents of its messages from all
    /// neighbours; `N` is 2 with a cotangent of the features.
    #[inline(always)]
    fn backward_layers<const N: usize>(&mut self, energy: &mut Evaluation, pull_back: &mut PullBack) {
        let model = &*self.model;
        for k in (0..model.layers.len()).rev() {
            let (work, after) = self.layers.split_at_mut(k + 1);
            let cotangents = BasisCotangents {
                model,
                layer: k,
                densities: &self.density_cotangents,
                from_features: &self.basis_cotangents,
            };
            let returned = after.first().map(|after| (&model.layers[k + 1].message, after));
            work[k].backward::<N>(&self.elements, &cotangents, returned, energy, pull_back);
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
        self.grace.forward_layers();
        self.grace.forward_energies();
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
                self.grace.backward_layers::<2>(self.energy, self.pull_back);
            }
            _ => self.grace.backward_layers::<1>(self.energy, self.pull_back),
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
