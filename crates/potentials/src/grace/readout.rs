//! From the invariant basis to atomic energies.

use super::activation::Activation;
use super::invariant_norm::InvariantNorm;
use super::matrix::StridedRows;
use super::tape::AtomBatch;
use super::vector::{Number, Vector};
use super::weight_map::WeightMap;
use super::weights::Weights;

/// Name of the constants by element, eV.
pub(super) const SHIFTS: &str = "shift_values";

/// E = s (y_0 + MLP(y_1, y_2, …)) + shift of the element, with the densities y = Σ over layers of norm(W B),
/// where B are the invariants of the layer.
#[derive(Clone, Debug)]
pub(super) struct Readout<V> {
    /// Densities of each layer.
    pub blocks: Vec<ReadoutBlock<V>>,
    /// Layers of the perceptron with their transposes. The first also has an input for y_0 with zero weights,
    /// so that it can read y unchanged.
    pub layers: Vec<Weights<V>>,
    /// Where the numbers of each layer stand in the file.
    pub maps: Vec<WeightMap>,
    /// Applied after every layer but the last.
    pub activation: Activation,
    /// s
    pub scale: f64,
    /// eV, by element
    pub shifts: Vec<f64>,
}

/// The densities of one layer.
#[derive(Clone, Debug)]
pub(super) struct ReadoutBlock<V> {
    /// W
    pub weights: Weights<V>,
    /// Where it stands in the file.
    pub map: WeightMap,
    /// Absent in one-layer models.
    pub norm: Option<InvariantNorm>,
}

impl<V: Vector> ReadoutBlock<V> {
    /// Lanes of the densities.
    #[inline(always)]
    pub fn lanes(&self) -> usize {
        self.weights.forward(0).output_lanes()
    }
}

/// Scratch arrays for one batch; each has a row per atom.
#[derive(Clone, Debug, Default)]
pub(super) struct ReadoutWork<V> {
    /// W B of each layer.
    densities: Vec<Vec<V>>,
    /// Values after each layer of the perceptron, its input first.
    values: Vec<Vec<V>>,
    /// Derivatives of the activations.
    slopes: Vec<Vec<V>>,
    cotangent: Vec<V>,
    swap: Vec<V>,
}

impl<V: Vector> Readout<V> {
    /// Lanes of y.
    pub fn density_lanes(&self) -> usize {
        self.blocks.first().map_or(0, ReadoutBlock::lanes)
    }

    /// Starts a batch of this many atoms.
    #[inline(always)]
    pub fn begin(&self, atoms: usize, work: &mut ReadoutWork<V>) {
        work.densities.resize(self.blocks.len(), Vec::new());
        work.values.resize(self.layers.len() + 1, Vec::new());
        work.slopes.resize(self.layers.len(), Vec::new());
        zeros(&mut work.values[0], atoms * self.density_lanes());
    }

    /// Adds the densities of one layer to y, from its basis, one row of `stride` lanes per atom.
    #[inline(always)]
    pub fn add_densities(
        &self,
        layer: usize,
        batch: &AtomBatch,
        basis: (&[V], usize),
        work: &mut ReadoutWork<V>,
    ) {
        let (block, lanes, atoms) = (&self.blocks[layer], self.density_lanes(), batch.atoms);
        let densities = &mut work.densities[layer];
        zeros(densities, atoms * lanes);
        let (from, to) = (StridedRows::of_atoms(atoms, basis.1), StridedRows::of_atoms(atoms, lanes));
        let weights = block.weights.forward(batch.element);
        weights.multiply_add((basis.0, &mut densities[..]), from, to, batch.instructions);
        let rows = densities.chunks_exact(lanes).zip(work.values[0].chunks_exact_mut(lanes));
        for (densities, sum) in rows.map(|(d, sum)| (V::flat(d), V::flat_mut(sum))) {
            match &block.norm {
                Some(norm) => norm.forward(densities, sum),
                None => sum.iter_mut().zip(densities).for_each(|(sum, y)| *sum += *y),
            }
        }
    }

    /// The energies of the atoms, eV, after all layers have added their densities; leaves ∂E/∂y in `work`.
    #[inline(always)]
    pub fn evaluate(&self, batch: &AtomBatch, energies: &mut [f64], work: &mut ReadoutWork<V>) {
        let atoms = batch.atoms;
        for (k, layer) in self.layers.iter().map(|layer| layer.forward(0)).enumerate() {
            let (before, after) = work.values.split_at_mut(k + 1);
            zeros(&mut after[0], atoms * layer.output_lanes());
            let from = StridedRows::of_atoms(atoms, layer.input_lanes());
            let to = StridedRows::of_atoms(atoms, layer.output_lanes());
            layer.multiply_add((&before[k][..], &mut after[0][..]), from, to, batch.instructions);
            if k + 1 < self.layers.len() {
                zeros(&mut work.slopes[k], atoms * layer.output_lanes());
                let values = V::flat_mut(&mut after[0]).iter_mut();
                for (x, slope) in values.zip(V::flat_mut(&mut work.slopes[k])) {
                    let (y, dy) = self.activation.evaluate((*x).into());
                    (*x, *slope) = (V::Number::round(y), V::Number::round(dy));
                }
            }
        }
        let lanes = self.density_lanes();
        for (atom, energy) in energies.iter_mut().enumerate() {
            let perceptron =
                if self.layers.is_empty() { 0.0 } else { work.values[self.layers.len()][atom][0].into() };
            *energy = self.scale * (work.values[0][atom * lanes][0].into() + perceptron)
                + self.shifts[batch.element];
        }
        self.backward(batch, work);
    }

    /// Writes ∂E/∂y to `work.cotangent`.
    #[inline(always)]
    fn backward(&self, batch: &AtomBatch, work: &mut ReadoutWork<V>) {
        let (atoms, lanes) = (batch.atoms, self.density_lanes());
        zeros(&mut work.cotangent, atoms);
        work.cotangent.iter_mut().for_each(|cotangent| cotangent[0] = V::Number::round(self.scale));
        self.reverse(self.layers.len(), batch, work);
        if self.layers.is_empty() {
            zeros(&mut work.cotangent, atoms * lanes);
        }
        work.cotangent
            .chunks_exact_mut(lanes)
            .for_each(|cotangent| cotangent[0][0] += V::Number::round(self.scale));
    }

    /// Goes back through the first `layers` layers of the perceptron: replaces the cotangent of what they give with that of y.
    #[inline(always)]
    fn reverse(&self, layers: usize, batch: &AtomBatch, work: &mut ReadoutWork<V>) {
        let atoms = batch.atoms;
        for (k, layer) in self.layers[..layers].iter().enumerate().rev() {
            let transposed = layer.transposed(0);
            if k + 1 < self.layers.len() {
                let cotangent = V::flat_mut(&mut work.cotangent).iter_mut();
                cotangent.zip(V::flat(&work.slopes[k])).for_each(|(c, slope)| *c *= *slope);
            }
            zeros(&mut work.swap, atoms * transposed.output_lanes());
            let from = StridedRows::of_atoms(atoms, transposed.input_lanes());
            let to = StridedRows::of_atoms(atoms, transposed.output_lanes());
            transposed.multiply_add((&work.cotangent[..], &mut work.swap[..]), from, to, batch.instructions);
            std::mem::swap(&mut work.swap, &mut work.cotangent);
        }
    }

    /// Number of layers before the last hidden one.
    fn hidden_layers(&self) -> usize {
        self.layers.len().saturating_sub(1)
    }

    /// D_ρ, the numbers y from which the energy follows.
    pub fn density_dimension(&self) -> usize {
        self.layers.first().map_or(1, |first| first.forward(0).inputs())
    }

    /// D_h, the numbers in which the energy is linear: y_0 and the last hidden layer, or all of y without hidden layers.
    pub fn hidden_dimension(&self) -> usize {
        let last = self.layers.last().map_or(1, |last| last.forward(0).inputs());
        last + usize::from(self.hidden_layers() > 0)
    }

    /// These numbers after [`Readout::evaluate`], `[atoms, D_h]`.
    #[inline(always)]
    pub fn hidden(&self, batch: &AtomBatch, out: &mut [f64], work: &ReadoutWork<V>) {
        let (hidden, first) = (self.hidden_layers(), usize::from(self.hidden_layers() > 0));
        for (atom, out) in out.chunks_exact_mut(self.hidden_dimension()).enumerate() {
            out[0] = row(&work.values[0], batch.atoms, atom)[0].into();
            let values = row(&work.values[hidden], batch.atoms, atom);
            out[first..].iter_mut().zip(values).for_each(|(out, value)| *out = (*value).into());
        }
    }

    /// Replaces ∂E/∂y in `work` with the cotangent of y from that of these numbers, `[atoms, D_h]`.
    #[inline(always)]
    pub fn hidden_backward(&self, batch: &AtomBatch, cotangent: &[f64], work: &mut ReadoutWork<V>) {
        let (hidden, first) = (self.hidden_layers(), usize::from(self.hidden_layers() > 0));
        let lanes = work.values[hidden].len();
        zeros(&mut work.cotangent, lanes);
        for (atom, cotangent) in cotangent.chunks_exact(self.hidden_dimension()).enumerate() {
            let of_lanes = lanes / batch.atoms;
            let seeds = V::flat_mut(&mut work.cotangent[atom * of_lanes..][..of_lanes]);
            seeds.iter_mut().zip(&cotangent[first..]).for_each(|(seed, c)| *seed = V::Number::round(*c));
        }
        self.reverse(hidden, batch, work);
        if first > 0 {
            let rows = work.cotangent.chunks_exact_mut(self.density_lanes());
            for (row, cotangent) in rows.zip(cotangent.chunks_exact(self.hidden_dimension())) {
                row[0][0] += V::Number::round(cotangent[0]);
            }
        }
    }

    /// ∂E/∂(W B) of all layers after [`Readout::evaluate`], `[atoms, layers, lanes]`.
    #[inline(always)]
    pub fn density_cotangents(&self, out: &mut [V], work: &ReadoutWork<V>) {
        let lanes = self.density_lanes();
        let rows = out.chunks_exact_mut(self.blocks.len() * lanes).zip(work.cotangent.chunks_exact(lanes));
        for (atom, (row, cotangent)) in rows.enumerate() {
            for (layer, out) in row.chunks_exact_mut(lanes).enumerate() {
                out.copy_from_slice(cotangent);
                if let Some(norm) = &self.blocks[layer].norm {
                    let densities = &work.densities[layer][atom * lanes..][..lanes];
                    norm.backward(V::flat(densities), V::flat_mut(out));
                }
            }
        }
    }
}

/// The numbers of one atom.
#[inline(always)]
fn row<V: Vector>(lanes: &[V], atoms: usize, atom: usize) -> &[V::Number] {
    let of_atom = lanes.len() / atoms;
    V::flat(&lanes[atom * of_atom..][..of_atom])
}

/// Zeros for this many lanes.
#[inline(always)]
pub(super) fn zeros<V: Vector>(lanes: &mut Vec<V>, n: usize) {
    lanes.clear();
    lanes.resize(n, V::ZERO);
}
