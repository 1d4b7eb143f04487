//! Where the numbers of a matrix stand in the arrays of the file: matrices are linear in the trained weights.

use super::vector::Vector;
use super::weight_arrays::WeightArrays;
use super::weights::Weights;

/// A matrix `[type][input × output]` as a sum of blocks, each a slice of an array.
#[derive(Clone, Debug)]
pub(super) struct WeightMap {
    /// Number of elements of the central atom with own matrices; 1 if all share one.
    pub types: usize,
    pub inputs: usize,
    pub outputs: usize,
    /// Added to the diagonal.
    pub identity: f64,
    pub blocks: Vec<WeightBlock>,
}

/// M_(t, first input + i, first output + o) += f · (n · W\[first + t s_t + i s_i + o s_o\])
#[derive(Clone, Debug)]
pub(super) struct WeightBlock {
    /// Name of W in the file.
    pub array: String,
    /// n, the norm of the array.
    pub norm: f64,
    /// f, a factor of the results.
    pub factor: f64,
    /// Index of the first weight.
    pub first: usize,
    /// s_t, s_i, s_o
    pub strides: [usize; 3],
    /// First input and number of inputs.
    pub inputs: [usize; 2],
    /// First output and number of outputs.
    pub outputs: [usize; 2],
}

impl WeightMap {
    /// The array `array` `[inputs, outputs]` of a dense layer.
    pub fn dense(array: &str, norm: f64, [inputs, outputs]: [usize; 2]) -> Self {
        let block = WeightBlock {
            array: array.to_owned(),
            norm,
            factor: 1.0,
            first: 0,
            strides: [0, outputs, 1],
            inputs: [0, inputs],
            outputs: [0, outputs],
        };
        Self { types: 1, inputs, outputs, identity: 0.0, blocks: vec![block] }
    }

    /// With further inputs before the others, which have zero weights.
    pub fn after_inputs(mut self, number: usize) -> Self {
        self.inputs += number;
        self.blocks.iter_mut().for_each(|block| block.inputs[0] += number);
        self
    }

    /// The first inputs only, of a map with one block.
    pub fn first_inputs(mut self, number: usize) -> Self {
        self.inputs = number;
        self.blocks.iter_mut().for_each(|block| block.inputs[1] = number);
        self
    }

    /// The matrix with the current weights.
    pub fn fill<V: Vector>(&self, arrays: &WeightArrays) -> Weights<V> {
        let dense = self.numbers(arrays);
        let at = |t: usize, i: usize, o: usize| (t * self.inputs + i) * self.outputs + o;
        Weights::new(self.types, self.inputs, self.outputs, |t, i, o| dense[at(t, i, o)])
    }

    /// The same as numbers, `[type, input, output]`.
    pub fn numbers(&self, arrays: &WeightArrays) -> Vec<f64> {
        let mut dense = vec![0.0; self.types * self.inputs * self.outputs];
        if self.identity != 0.0 {
            let diagonal = dense.iter_mut().step_by(self.outputs + 1);
            diagonal.take(self.inputs.min(self.outputs)).for_each(|x| *x = self.identity);
        }
        for block in &self.blocks {
            let weights = &arrays[block.array.as_str()];
            self.entries(block).for_each(|(matrix, index)| {
                dense[matrix] += block.factor * (weights[index] * block.norm);
            });
        }
        dense
    }

    /// Adds the derivatives with respect to the weights, from those with respect to the matrix, `[type, input,
    /// output]`.
    pub fn pull_back(&self, of_matrix: &[f64], of_arrays: &mut WeightArrays) {
        for block in &self.blocks {
            let weights = &mut of_arrays[block.array.as_str()];
            self.entries(block).for_each(|(matrix, index)| {
                weights[index] += block.factor * block.norm * of_matrix[matrix];
            });
        }
    }

    /// Indices in the matrix, `[type, input, output]`, and in the array.
    fn entries(&self, block: &WeightBlock) -> impl Iterator<Item = (usize, usize)> {
        let ([first_input, inputs], [first_output, outputs]) = (block.inputs, block.outputs);
        let ([by_type, by_input, by_output], first) = (block.strides, block.first);
        let (of_type, of_input) = (self.inputs * self.outputs, self.outputs);
        (0..self.types).flat_map(move |t| {
            (0..inputs).flat_map(move |i| {
                let matrix = t * of_type + (first_input + i) * of_input + first_output;
                let index = first + t * by_type + i * by_input;
                (0..outputs).map(move |o| (matrix + o, index + o * by_output))
            })
        })
    }
}
