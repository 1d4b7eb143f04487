//! Energy, features and derivatives of a structure.

use std::sync::{Arc, Mutex};

use atoms::{Evaluation, Matrix3, NeighbourList, PotentialError, Structure, Vec3};

use super::batches::Batches;
use super::instructions::Instructions;
use super::layer_passes::LayerState;
use super::model::GraceModel;
use super::network::Network;
use super::projection::ProjectionWork;
use super::scratch::Scratch;
use super::threads::Threads;
use super::vector::Vector;

/// The derivatives of a function H of the features: its cotangent ∂H/∂z pulled back to the atoms.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PullBack {
    /// +∂H/∂r, `[n]`.
    pub gradient: Vec<Vec3>,
    /// +∂H/∂ε, symmetric.
    pub virial: Matrix3,
}

impl PullBack {
    /// Resizes the gradient to `n` atoms and sets it to zero.
    pub fn reset(&mut self, n: usize) {
        self.gradient.clear();
        self.gradient.resize(n, [0.0; 3]);
        self.virial = [[0.0; 3]; 3];
    }
}

/// Receives some atoms and their features z, `[atoms, D]`, and writes ∂H/∂z of each unless the output is empty.
/// Several threads call it concurrently.
pub type GradeFunction<'a> = dyn Fn(&[u32], &[f64], &mut [f64]) + Sync + 'a;

/// A network with its scratch arrays.
#[derive(Debug)]
pub(super) struct Evaluator<V: Vector> {
    model: Arc<GraceModel>,
    /// The network of the model.
    pub(super) network: Arc<Network<V>>,
    pub(super) instructions: Instructions,
    pub(super) threads: Threads,
    /// Element of each atom.
    elements: Vec<usize>,
    pub(super) batches: Batches,
    pub(super) layers: Vec<LayerState<V>>,
    /// One for each thread.
    pub(super) scratch: Vec<Mutex<Scratch<V>>>,
    // In the order of evaluation:
    /// E, `[n]`.
    pub(super) energies: Vec<f64>,
    /// ∂E/∂(W B), `[n, layers, lanes]`.
    pub(super) density_cotangents: Vec<V>,
    /// −∂E/∂r and −∂H/∂r, `[n]`.
    pub(super) forces: [Vec<Vec3>; 2],
    /// ∂E/∂ε and ∂H/∂ε of each chunk.
    pub(super) virials: Vec<[Matrix3; 2]>,
    pub(super) projection: ProjectionWork<V>,
    // In the order of the structure:
    atomic_energies: Vec<f64>,
    features: Vec<f64>,
    /// ∂H/∂z, in the order of evaluation.
    feature_cotangent: Vec<f64>,
    /// A scratch number per atom.
    numbers: Vec<u32>,
}

impl<V: Vector> Evaluator<V> {
    pub fn new(
        model: Arc<GraceModel>,
        network: Arc<Network<V>>,
        instructions: Instructions,
        threads: Threads,
    ) -> Self {
        let scratch = (0..threads.count()).map(|_| Mutex::new(Scratch::new(&*network))).collect();
        Self {
            instructions,
            threads,
            elements: Vec::new(),
            batches: Batches::default(),
            layers: network.layers.iter().map(|_| LayerState::default()).collect(),
            scratch,
            energies: Vec::new(),
            density_cotangents: Vec::new(),
            forces: Default::default(),
            virials: Vec::new(),
            projection: ProjectionWork::default(),
            atomic_energies: Vec::new(),
            features: Vec::new(),
            feature_cotangent: Vec::new(),
            numbers: Vec::new(),
            model,
            network,
        }
    }

    pub fn model(&self) -> &Arc<GraceModel> {
        &self.model
    }

    /// As [`super::Grace::forward`].
    pub fn forward(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
    ) -> Result<(), PotentialError> {
        self.threads.clone().run(|| {
            self.take(structure, neighbours)?;
            (0..self.layers.len()).for_each(|k| self.forward_layer(k));
            self.read_out();
            self.project();
            Ok(())
        })?;
        self.scatter_energies();
        self.scatter_features();
        Ok(())
    }

    /// As [`super::Grace::evaluate_graded`].
    pub fn evaluate_graded(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        grade: &GradeFunction,
        energy: &mut Evaluation,
        pull_back: Option<&mut PullBack>,
    ) -> Result<(), PotentialError> {
        let grade = self.network.feature_map.is_some().then_some(grade);
        let both = grade.is_some() && pull_back.is_some();
        self.threads.clone().run(|| match both {
            true => self.pass::<2>(structure, neighbours, grade),
            false => self.pass::<1>(structure, neighbours, grade),
        })?;
        self.scatter_energies();
        self.scatter_features();
        self.scatter_forces(energy);
        if let Some(pull_back) = pull_back {
            self.scatter_pull_back(both, pull_back);
        }
        Ok(())
    }

    /// Takes over elements and bonds of a structure; discards earlier results.
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
        self.batches.update(&self.elements, self.network.tape_bytes());
        for (work, layer) in self.layers.iter_mut().zip(&self.network.layers) {
            let parallel = (&self.batches, &self.threads);
            work.bonds.update(layer, structure, neighbours, &self.elements, parallel);
            work.begin(layer, &self.batches, &self.elements, &mut self.numbers);
        }
        self.begin_passes();
        Ok(())
    }

    /// As [`super::Grace::atomic_energies`].
    pub fn atomic_energies(&self) -> &[f64] {
        &self.atomic_energies
    }

    /// Number of bonds of each layer at the last structure.
    pub(super) fn bonds(&self) -> impl Iterator<Item = usize> {
        self.layers.iter().map(|work| work.bonds.bonds.len())
    }

    /// As [`super::Grace::features`].
    pub fn features(&self) -> &[f64] {
        &self.features
    }

    /// As [`super::Grace::backward`].
    pub fn backward(
        &mut self,
        feature_cotangent: Option<&[f64]>,
        energy: &mut Evaluation,
        pull_back: &mut PullBack,
    ) {
        if let Some(cotangent) = feature_cotangent {
            assert_eq!(cotangent.len(), self.features.len(), "a cotangent for every feature");
        }
        let cotangent = feature_cotangent.filter(|_| self.network.feature_map.is_some());
        self.begin_derivatives();
        // A rejected structure has no bonds.
        let layers = if self.batches.order.is_empty() { 0 } else { self.layers.len() };
        self.threads.clone().run(|| match cotangent {
            Some(cotangent) => {
                self.pull_back_features(cotangent);
                self.backward_layers::<2>(layers);
            }
            None => self.backward_layers::<1>(layers),
        });
        self.scatter_forces(energy);
        self.scatter_pull_back(cotangent.is_some(), pull_back);
    }

    /// The cotangents of all bases from those of the features, `[n, D]` in the order of the structure.
    fn pull_back_features(&mut self, cotangent: &[f64]) {
        let Some(projection) = self.network.projection() else { return };
        let width = projection.feature_dimension();
        let mut in_order = std::mem::take(&mut self.feature_cotangent);
        in_order.clear();
        for atom in &self.batches.order {
            in_order.extend_from_slice(&cotangent[*atom as usize * width..][..width]);
        }
        self.project_back(&in_order);
        self.feature_cotangent = in_order;
    }

    /// The reverse pass of all atoms through the first `layers`.
    pub(super) fn backward_layers<const N: usize>(&mut self, layers: usize) {
        for k in (0..layers).rev() {
            self.backward_layer::<N>(k);
            self.finish_layer::<N>(k);
        }
    }

    /// Evaluates a structure without storing its last layer.
    fn pass<const N: usize>(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        grade: Option<&GradeFunction>,
    ) -> Result<(), PotentialError> {
        self.take(structure, neighbours)?;
        self.begin_derivatives();
        let last = self.layers.len() - 1;
        (0..last).for_each(|k| self.forward_layer(k));
        self.pass_last_layer::<N>(grade);
        self.backward_layers::<N>(last);
        Ok(())
    }

    /// As [`super::Grace`] as a potential.
    pub fn evaluate(
        &mut self,
        structure: &Structure,
        neighbours: &NeighbourList,
        out: &mut Evaluation,
    ) -> Result<(), PotentialError> {
        self.threads.clone().run(|| self.pass::<1>(structure, neighbours, None))?;
        self.scatter_energies();
        self.scatter_forces(out);
        Ok(())
    }

    // From evaluation order to the order of the structure:

    fn scatter_energies(&mut self) {
        self.atomic_energies.resize(self.elements.len(), 0.0);
        for (atom, energy) in self.batches.order.iter().zip(&self.energies) {
            self.atomic_energies[*atom as usize] = *energy;
        }
    }

    fn scatter_features(&mut self) {
        let Some(projection) = self.network.projection() else { return };
        let width = projection.feature_dimension();
        self.features.resize(self.elements.len() * width, 0.0);
        for (atom, z) in self.batches.order.iter().zip(self.projection.features.chunks_exact(width)) {
            self.features[*atom as usize * width..][..width].copy_from_slice(z);
        }
    }

    fn scatter_forces(&self, energy: &mut Evaluation) {
        energy.reset(self.elements.len());
        energy.atomic_energies.copy_from_slice(&self.atomic_energies);
        for (atom, force) in self.batches.order.iter().zip(&self.forces[0]) {
            energy.forces[*atom as usize] = *force;
        }
        energy.virial = self.strain_derivative(0).map(|row| row.map(|x| -x));
    }

    fn scatter_pull_back(&self, is_computed: bool, pull_back: &mut PullBack) {
        pull_back.reset(self.elements.len());
        if is_computed {
            self.scatter_gradient(1, pull_back);
        }
    }

    /// The derivatives from the cotangent `k`.
    pub(super) fn scatter_gradient(&self, k: usize, pull_back: &mut PullBack) {
        pull_back.reset(self.elements.len());
        for (atom, force) in self.batches.order.iter().zip(&self.forces[k]) {
            pull_back.gradient[*atom as usize] = force.map(|x| -x);
        }
        pull_back.virial = self.strain_derivative(k);
    }

    /// ∂E/∂ε or ∂H/∂ε, summed over chunks in order.
    fn strain_derivative(&self, k: usize) -> Matrix3 {
        let mut sum = [[0.0; 3]; 3];
        for virials in &self.virials {
            add(&mut sum, &virials[k]);
        }
        symmetric(&sum)
    }
}

pub(super) fn add(sum: &mut Matrix3, x: &Matrix3) {
    for (sum, x) in sum.as_flattened_mut().iter_mut().zip(x.as_flattened()) {
        *sum += x;
    }
}

/// Symmetrises the tensor, which is symmetric up to rounding because energy and features are rotationally
/// invariant.
fn symmetric(tensor: &Matrix3) -> Matrix3 {
    std::array::from_fn(|a| std::array::from_fn(|b| 0.5 * (tensor[a][b] + tensor[b][a])))
}
