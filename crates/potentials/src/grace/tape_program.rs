//! Executes the operations of a layer on a batch, forward and in reverse.

use super::tape::{AtomBatch, TapeOperation};
use super::vector::Vector;
use super::weight_gradient::WeightGradient;

/// The operations of a layer in order, with the lanes of all rows on both tapes.
///
/// Both tapes start with the same rows: the sum over neighbours, the message to the next layer, and others with
/// fixed lanes. On the forward tape there follow the rows that the reverse pass reads, then those whose lanes
/// are reused.
#[derive(Clone, Debug)]
pub(super) struct TapeProgram<V: Vector> {
    pub steps: Vec<TapeStep<V>>,
    /// Basis rows that no operation produces.
    pub given: Gather,
    /// Lanes of the rows with the same position on both tapes, for one slot.
    pub fixed_lanes: usize,
    /// Lanes at the start of the tape that the reverse pass needs.
    pub kept_lanes: usize,
    pub tape_lanes: usize,
    pub cotangent_lanes: usize,
    /// Lanes of the basis B.
    pub basis_lanes: usize,
}

/// An operation with what precedes and follows it.
#[derive(Clone, Debug)]
pub(super) struct TapeStep<V: Vector> {
    pub operation: TapeOperation<V>,
    /// Results that are sums and must be zeroed, on the tape.
    pub sums: Ranges,
    /// Cotangents that receive their first contribution in this step of the reverse pass.
    pub fresh: Ranges,
    /// Results that belong to the basis.
    pub basis: Gather,
}

impl<V: Vector> TapeProgram<V> {
    /// All operations.
    pub fn operations(&self) -> impl Iterator<Item = &TapeOperation<V>> {
        self.steps.iter().map(|step| &step.operation)
    }

    /// From the sum over neighbours to the basis, one row per atom.
    #[inline(always)]
    pub fn forward(&self, batch: &AtomBatch, tape: &mut [V], basis: &mut [V]) {
        let lanes = self.basis_lanes;
        self.given.forward(batch.atoms, tape, basis, lanes);
        for step in &self.steps {
            step.sums.clear(batch.atoms, tape);
            step.operation.forward(batch, tape);
            step.basis.forward(batch.atoms, tape, basis, lanes);
        }
    }

    /// From `N` cotangents of the basis, one row per atom, to those of the sum over neighbours.
    #[inline(always)]
    pub fn backward<const N: usize>(
        &self,
        batch: &AtomBatch,
        tape: &[V],
        cotangent: &mut [V],
        bases: [&[V]; N],
    ) {
        for step in self.steps.iter().rev() {
            step.fresh.clear(N * batch.atoms, cotangent);
            step.basis.backward(batch.atoms, bases, cotangent, self.basis_lanes);
            step.operation.backward::<N>(batch, tape, cotangent);
        }
        self.given.backward(batch.atoms, bases, cotangent, self.basis_lanes);
    }
}

/// The derivative of a tape along a direction beside the tape, both for the same batch.
impl<V: Vector> TapeProgram<V> {
    /// From the sums over neighbours to the bases, values and derivatives.
    #[inline(always)]
    pub fn forward_derivative(&self, batch: &AtomBatch, tapes: [&mut [V]; 2], bases: [&mut [V]; 2]) {
        let (lanes, [tape, along], [basis, along_basis]) = (self.basis_lanes, tapes, bases);
        self.given.forward(batch.atoms, tape, basis, lanes);
        self.given.forward(batch.atoms, along, along_basis, lanes);
        for step in &self.steps {
            step.sums.clear(batch.atoms, tape);
            step.sums.clear(batch.atoms, along);
            step.operation.forward(batch, tape);
            step.operation.forward_derivative(batch, tape, along);
            step.basis.forward(batch.atoms, tape, basis, lanes);
            step.basis.forward(batch.atoms, along, along_basis, lanes);
        }
    }

    /// From two cotangents of the basis, of its derivative and of its values, to those of the sum over neighbours.
    /// Adds the derivatives with respect to the weights of each step's linear parts.
    #[inline(always)]
    pub fn backward_derivative(
        &self,
        batch: &AtomBatch,
        tapes: [&[V]; 2],
        cotangent: &mut [V],
        bases: [&[V]; 2],
        of_weights: &mut [Vec<WeightGradient<V>>],
    ) {
        for (step, of_weights) in self.steps.iter().zip(of_weights).rev() {
            step.fresh.clear(2 * batch.atoms, cotangent);
            step.basis.backward(batch.atoms, bases, cotangent, self.basis_lanes);
            if let TapeOperation::Linear(linear) = &step.operation {
                linear.add_weight_gradients(batch, tapes, cotangent, of_weights);
            }
            step.operation.backward_derivative(batch, tapes, cotangent);
        }
        self.given.backward(batch.atoms, bases, cotangent, self.basis_lanes);
    }

    /// Zero derivatives with respect to the weights of each step's linear parts.
    pub fn weight_gradients(&self) -> Vec<Vec<WeightGradient<V>>> {
        let of_step = |operation: &TapeOperation<V>| match operation {
            TapeOperation::Linear(linear) => {
                linear.parts.iter().map(|part| WeightGradient::new(&part.map)).collect()
            }
            _ => Vec::new(),
        };
        self.operations().map(of_step).collect()
    }
}

/// Rows to copy to the basis B.
#[derive(Clone, Debug, Default)]
pub(super) struct Gather(pub Vec<Gathered>);

/// A row of the basis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Gathered {
    /// First lane on the tape and on the cotangents' tape.
    pub tape: usize,
    pub cotangent: usize,
    /// First lane in the basis.
    pub position: usize,
    /// Number of lanes.
    pub width: usize,
}

impl Gather {
    /// Copies the rows to `out`, one row of `stride` lanes per atom.
    #[inline(always)]
    fn forward<V: Vector>(&self, atoms: usize, tape: &[V], out: &mut [V], stride: usize) {
        for &Gathered { tape: row, position, width, .. } in &self.0 {
            for atom in 0..atoms {
                let (to, from) = (atom * stride + position, row * atoms + atom * width);
                out[to..to + width].copy_from_slice(&tape[from..from + width]);
            }
        }
    }

    /// Adds to `N` cotangents of the rows, from one row of `stride` lanes per atom.
    #[inline(always)]
    fn backward<V: Vector, const N: usize>(
        &self,
        atoms: usize,
        bases: [&[V]; N],
        cotangent: &mut [V],
        stride: usize,
    ) {
        for &Gathered { cotangent: row, position, width, .. } in &self.0 {
            for (k, basis) in bases.iter().enumerate() {
                for atom in 0..atoms {
                    let (from, to) = (atom * stride + position, (row * N + k * width) * atoms + atom * width);
                    for (sum, x) in cotangent[to..to + width].iter_mut().zip(&basis[from..from + width]) {
                        sum.add(x);
                    }
                }
            }
        }
    }
}

/// Ranges of lanes on a tape, for one slot.
#[derive(Clone, Debug, Default)]
pub(super) struct Ranges(Vec<(usize, usize)>);

impl Ranges {
    /// From first lanes and widths of rows, which may repeat.
    pub fn new(mut rows: Vec<(usize, usize)>) -> Self {
        rows.sort_unstable();
        rows.dedup();
        let mut ranges: Vec<(usize, usize)> = Vec::new();
        for (row, width) in rows {
            match ranges.last_mut() {
                Some((_, end)) if *end == row => *end = row + width,
                _ => ranges.push((row, row + width)),
            }
        }
        Self(ranges)
    }

    #[inline(always)]
    fn clear<V: Vector>(&self, slots: usize, tape: &mut [V]) {
        for (start, end) in &self.0 {
            tape[start * slots..end * slots].fill(V::ZERO);
        }
    }
}
