//! Energy, features and their derivatives for one structure.

use std::sync::Arc;

use atoms::{Evaluation, Matrix3, NeighbourList, Potential, PotentialError, Species, Structure, Vec3};

use super::batches::{Batches, Placed};
use super::instructions::{Instructions, Pass};
use super::layer::{Layer, Message};
use super::layer_work::LayerWork;
use super::model::GraceModel;
use super::projection::{Projection, ProjectionWork};
use super::readout::{Block, ReadoutWork};

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
    instructions: Instructions,
    elements: Vec<usize>,
    batches: Batches,
    layers: Vec<LayerWork>,
    /// Those of a batch, in its order.
    batch_energies: Vec<f64>,
    atomic_energies: Vec<f64>,
    features: Vec<f64>,
    readout: ReadoutWork,
    projection: ProjectionWork,
}

impl Grace {
    /// An evaluator of `model`; nothing is computed yet.
    pub fn new(model: Arc<GraceModel>) -> Self {
        Self::with_instructions(model, Instructions::best())
    }

    /// As [`Grace::new`], with these vector instructions; results do not depend on them.
    pub fn with_instructions(model: Arc<GraceModel>, instructions: Instructions) -> Self {
        Self {
            instructions,
            elements: Vec::new(),
            batches: Batches::default(),
            layers: model.layers.iter().map(LayerWork::new).collect(),
            batch_energies: Vec::new(),
            atomic_energies: Vec::new(),
            features: Vec::new(),
            readout: ReadoutWork::default(),
            projection: ProjectionWork::default(),
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
        let layers = self.layers.len();
        self.hold_all(layers);
        self.forward_layers(layers);
        (0..self.batches.batches.len()).for_each(|batch| self.energies(batch));
        self.project(None);
        Ok(())
    }

    /// Elements and bonds of a structure; results of an earlier one are dropped.
    fn take(&mut self, structure: &Structure, neighbours: &NeighbourList) -> Result<(), PotentialError> {
        self.elements.clear();
        self.atomic_energies.clear();
        self.features.clear();
        self.batches.update(&[], 0);
        let needed = self.model.cutoff();
        if neighbours.cutoff() < needed {
            return Err(PotentialError::Cutoff { list: neighbours.cutoff(), needed });
        }
        self.model.write_element_indices(&structure.species, &mut self.elements)?;
        self.batches.update(&self.elements, self.model.tape_bytes());
        self.atomic_energies.resize(self.elements.len(), 0.0);
        for (work, layer) in self.layers.iter_mut().zip(&self.model.layers) {
            work.bonds.update(layer, structure, neighbours, &self.elements, &self.batches.order);
            work.begin_messages(layer, &self.elements);
        }
        Ok(())
    }

    /// Makes the first `layers` keep their tapes of all atoms.
    fn hold_all(&mut self, layers: usize) {
        let model = &*self.model;
        for ((work, layer), block) in
            self.layers.iter_mut().zip(&model.layers).zip(&model.readout.blocks).take(layers)
        {
            work.hold(layer, block, 0..self.elements.len());
        }
    }

    /// Energy of each atom at the last [`Grace::forward`], [n], eV.
    pub fn atomic_energies(&self) -> &[f64] {
        &self.atomic_energies
    }

    /// Number of bonds of each layer at the last structure.
    pub(super) fn bonds(&self) -> impl Iterator<Item = usize> {
        self.layers.iter().map(|work| work.bonds.bonds.len())
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
        if let Some(cotangent) = feature_cotangent {
            assert_eq!(cotangent.len(), self.features.len(), "a cotangent for every feature");
        }
        energy.reset(self.elements.len());
        pull_back.reset(self.elements.len());
        let layers = self.layers.len();
        if feature_cotangent.is_some() && self.model.projection.is_some() {
            self.project(feature_cotangent);
            self.backward_layers::<2>(layers, energy, pull_back);
        } else {
            self.backward_layers::<1>(layers, energy, pull_back);
        }
        self.complete(energy);
        pull_back.virial = symmetric(&pull_back.virial);
    }

    /// Features from the bases, or the cotangents of the bases from those of the features.
    fn project(&mut self, cotangent: Option<&[f64]>) {
        let Some(projection) = &self.model.projection else { return };
        self.instructions.run(Features {
            projection,
            work: &mut self.projection,
            layers: &mut self.layers,
            order: &self.batches.order,
            features: &mut self.features,
            cotangent,
            instructions: self.instructions,
        });
    }

    /// Energies and forces alone: a batch goes forwards and backwards through the last layer while its tape is in the
    /// cache, and no other tape of that layer is kept.
    fn plain(&mut self, energy: &mut Evaluation, pull_back: &mut PullBack) {
        let (model, last) = (Arc::clone(&self.model), self.layers.len() - 1);
        self.hold_all(last);
        self.forward_layers(last);
        self.layers[last].begin_backward::<1>(&model.layers[last], self.elements.len());
        for batch in 0..self.batches.batches.len() {
            let places = self.batches.batches[batch].0.clone();
            self.layers[last].hold(&model.layers[last], &model.readout.blocks[last], places);
            self.forward_batch(last, batch);
            self.energies(batch);
            self.backward_batch::<1>(last, batch, energy, pull_back);
        }
        self.backward_layers::<1>(last, energy, pull_back);
    }

    /// What the passes leave to be done.
    fn complete(&self, energy: &mut Evaluation) {
        energy.atomic_energies.copy_from_slice(&self.atomic_energies);
        energy.virial = symmetric(&energy.virial).map(|row| row.map(|x| -x));
    }

    /// A batch of layer `k`, and what it tells the next one.
    fn forward_batch(&mut self, k: usize, batch: usize) {
        let layers = &self.model.layers;
        let placed = self.batches.placed(batch, self.instructions);
        self.instructions.run(Forward { work: &mut self.layers[k], layer: &layers[k], placed });
        let (before, after) = self.layers.split_at_mut(k + 1);
        if let Some(next) = after.first_mut() {
            next.take_messages(&layers[k + 1], &placed, &before[k], &layers[k]);
        }
    }

    /// The energies of a batch that has passed all layers.
    fn energies(&mut self, batch: usize) {
        let placed = self.batches.placed(batch, self.instructions);
        self.batch_energies.clear();
        self.batch_energies.resize(placed.batch.atoms, 0.0);
        let (layers, work) = (&mut self.layers[..], &mut self.readout);
        let energies = &mut self.batch_energies[..];
        self.instructions.run(Energies { model: &self.model, layers, placed, work, energies });
        for ((_, atom), energy) in placed.atoms().zip(&self.batch_energies) {
            self.atomic_energies[atom] = *energy;
        }
    }

    fn backward_batch<const N: usize>(
        &mut self,
        k: usize,
        batch: usize,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        let model = &*self.model;
        let placed = self.batches.placed(batch, self.instructions);
        let (work, after) = self.layers.split_at_mut(k + 1);
        let returned = after.first().map(|after| (&model.layers[k + 1].message, after));
        let (layer, block) = (&model.layers[k], &model.readout.blocks[k]);
        let work = &mut work[k];
        let pass = Backward::<N> { work, layer, block, placed, returned, energy, pull_back };
        self.instructions.run(pass);
    }

    /// The first `layers` backwards, all atoms of one before the next, which needs the cotangents of its messages from
    /// all neighbours; `N` is 2 with a cotangent of the features.
    fn backward_layers<const N: usize>(
        &mut self,
        layers: usize,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        for k in (0..layers).rev() {
            self.layers[k].begin_backward::<N>(&self.model.layers[k], self.elements.len());
            for batch in 0..self.batches.batches.len() {
                self.backward_batch::<N>(k, batch, energy, pull_back);
            }
        }
    }

    fn forward_layers(&mut self, layers: usize) {
        for k in 0..layers {
            for batch in 0..self.batches.batches.len() {
                self.forward_batch(k, batch);
            }
        }
    }
}

/// A batch forwards through one layer.
struct Forward<'a> {
    work: &'a mut LayerWork,
    layer: &'a Layer,
    placed: Placed<'a>,
}

impl Pass for Forward<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        self.work.forward(self.layer, &self.placed);
    }
}

/// A batch from its bases to energies.
struct Energies<'a> {
    model: &'a GraceModel,
    layers: &'a mut [LayerWork],
    placed: Placed<'a>,
    work: &'a mut ReadoutWork,
    energies: &'a mut [f64],
}

impl Pass for Energies<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { model, layers, placed, work, energies } = self;
        model.readout.begin(placed.batch.atoms, work);
        for (k, layer) in model.layers.iter().enumerate() {
            let basis = (layers[k].basis(layer, &placed), layer.basis.lanes());
            model.readout.add_densities(k, &placed.batch, basis, work);
        }
        model.readout.evaluate(&placed.batch, energies, work);
        for (k, block) in model.readout.blocks.iter().enumerate() {
            model.readout.density_cotangent(k, layers[k].densities(block, &placed), work);
        }
    }
}

/// A batch backwards through one layer, with `N` cotangents.
struct Backward<'a, const N: usize> {
    work: &'a mut LayerWork,
    layer: &'a Layer,
    block: &'a Block,
    placed: Placed<'a>,
    returned: Option<(&'a Message, &'a LayerWork)>,
    energy: &'a mut Evaluation,
    pull_back: &'a mut PullBack,
}

impl<const N: usize> Pass for Backward<'_, N> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { work, layer, block, placed, returned, energy, pull_back } = self;
        work.backward::<N>(layer, block, &placed, returned, energy, pull_back);
    }
}

/// From the bases of all atoms to their features, or, with a cotangent of these, back.
struct Features<'a> {
    projection: &'a Projection,
    work: &'a mut ProjectionWork,
    layers: &'a mut [LayerWork],
    order: &'a [u32],
    features: &'a mut Vec<f64>,
    cotangent: Option<&'a [f64]>,
    instructions: Instructions,
}

impl Pass for Features<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { projection, work, layers, order, features, cotangent, instructions } = self;
        if let Some(cotangent) = cotangent {
            let layers = layers.iter_mut().map(|work| (&work.bases[..], &mut work.basis_cotangents));
            projection.backward(order, layers, cotangent, work, instructions);
        } else {
            projection.forward(
                order,
                layers.iter().map(|work| &work.bases[..]),
                features,
                work,
                instructions,
            );
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
        out.reset(self.elements.len());
        self.plain(out, &mut PullBack::default());
        self.complete(out);
        Ok(())
    }
}
