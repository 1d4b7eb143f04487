//! Linear mixing of channels.

use super::matrix::StridedRows;
use super::tape::AtomBatch;
use super::vector::Vector;
use super::weight_arrays::WeightArrays;
use super::weight_gradient::WeightGradient;
use super::weight_map::WeightMap;
use super::weights::Weights;

/// out_k,w = Σ over parts of Σ_n W_kn x_n,w′.
#[derive(Clone, Debug)]
pub(super) struct Linear<V> {
    /// Rows that share weights.
    pub parts: Vec<LinearPart<V>>,
}

/// Rows of one or more tensors multiplied by the same weights.
#[derive(Clone, Debug)]
pub(super) struct LinearPart<V> {
    /// `[n_in × n_out]`
    pub weights: Weights<V>,
    /// Where they stand in the file.
    pub map: WeightMap,
    /// Lanes at which each row is read and to which it is added.
    pub tape: [Vec<u32>; 2],
    /// The same on the cotangents' tape; set by [`Linear::rename`].
    cotangents: [Vec<u32>; 2],
}

impl<V: Vector> LinearPart<V> {
    /// From the lanes at which each row is read and to which it is added.
    pub fn new(map: WeightMap, arrays: &WeightArrays, (from, to): (Vec<u32>, Vec<u32>)) -> Self {
        Self { weights: map.fill(arrays), map, tape: [from, to], cotangents: Default::default() }
    }

    /// Adds the weights of a part with the same rows.
    pub fn add(&mut self, other: Self) {
        self.weights.add(&other.weights);
        self.map.identity += other.map.identity;
        self.map.blocks.extend(other.map.blocks);
    }

    /// Input and output rows at these lanes.
    #[inline(always)]
    fn rows<'a>(&self, [from, to]: &'a [Vec<u32>; 2], slots: usize) -> (StridedRows<'a>, StridedRows<'a>) {
        let weights = self.weights.forward(0);
        let rows = |starts, stride| StridedRows { starts, slots, stride, shift: 0 };
        (rows(from, weights.input_lanes()), rows(to, weights.output_lanes()))
    }
}

impl<V: Vector> Linear<V> {
    /// Adds the results to their rows.
    #[inline(always)]
    pub fn forward(&self, batch: &AtomBatch, tape: &mut [V]) {
        for part in &self.parts {
            let (from, to) = part.rows(&part.tape, batch.atoms);
            let weights = part.weights.forward(batch.element);
            weights.multiply_add(&mut *tape, from, to, batch.instructions);
        }
    }

    /// Adds to `N` cotangents of the inputs.
    #[inline(always)]
    pub fn backward<const N: usize>(&self, batch: &AtomBatch, cotangent: &mut [V]) {
        for part in &self.parts {
            let (from, to) = part.rows(&part.cotangents, N * batch.atoms);
            let weights = part.weights.transposed(batch.element);
            weights.multiply_add(&mut *cotangent, to, from, batch.instructions);
        }
    }

    /// Adds the derivatives with respect to the weights of each part, from two cotangents of the results: of their
    /// derivative along a direction and of their values.
    #[inline(always)]
    pub fn add_weight_gradients(
        &self,
        batch: &AtomBatch,
        tapes: [&[V]; 2],
        cotangent: &[V],
        of_weights: &mut [WeightGradient<V>],
    ) {
        for (part, of_weights) in self.parts.iter().zip(of_weights) {
            let (from, _) = part.rows(&part.tape, batch.atoms);
            let (_, first) = part.rows(&part.cotangents, 2 * batch.atoms);
            let second = StridedRows { shift: batch.atoms * first.stride, ..first };
            let [values, along] = tapes;
            of_weights.add_outer_products(batch.element, batch.atoms, (along, from), (cotangent, first));
            of_weights.add_outer_products(batch.element, batch.atoms, (values, from), (cotangent, second));
        }
    }

    /// As [`super::tape::TapeOperation::keep`].
    pub fn keep(&mut self, needed: &mut [bool]) {
        for part in &mut self.parts {
            let [from, to] = &part.tape;
            let rows = from.iter().copied().zip(to.iter().copied());
            let kept: Vec<(u32, u32)> = rows.filter(|(_, to)| needed[*to as usize]).collect();
            kept.iter().for_each(|(from, _)| needed[*from as usize] = true);
            let (from, to) = kept.into_iter().unzip();
            part.tape = [from, to];
        }
        self.parts.retain(|part| !part.tape[0].is_empty());
    }

    /// As [`super::tape::TapeOperation::rename`].
    pub fn rename(&mut self, on_tape: impl Fn(u32) -> u32, of_cotangent: impl Fn(u32) -> u32) {
        for part in &mut self.parts {
            part.cotangents =
                part.tape.each_ref().map(|rows| rows.iter().map(|r| of_cotangent(*r)).collect());
            part.tape.iter_mut().flatten().for_each(|row| *row = on_tape(*row));
        }
    }
}
