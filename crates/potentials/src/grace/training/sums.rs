//! Sums of derivatives over structures.

use super::super::network::Network;
use super::super::threads::Threads;
use super::super::vector::{Double, Vector};
use super::super::weight_arrays::WeightArrays;
use super::super::weight_gradient::WeightGradient;
use super::super::{readout::SHIFTS, tape::TapeOperation};
use super::knot_traces::KnotTraces;

/// Numbers that a thread adds at a time.
const PART: usize = 8192;

/// The derivatives of a loss with respect to the matrices and tables of a model, summed over structures.
#[derive(Clone, Debug)]
pub struct WeightSums {
    pub(super) layers: Vec<LayerSums>,
    /// For each layer of the perceptron.
    pub(super) perceptron: Vec<WeightGradient<Double>>,
    /// `[element]`
    pub(super) shifts: Vec<f64>,
}

/// Those of one layer.
#[derive(Clone, Debug)]
pub(super) struct LayerSums {
    /// For each linear part of each step.
    pub steps: Vec<Vec<WeightGradient<Double>>>,
    /// Of the weights of the basis.
    pub block: WeightGradient<Double>,
    /// Of the scale of the norm.
    pub norm: Vec<f64>,
    /// Of the coefficients of each table.
    pub tables: Vec<Vec<Double>>,
    /// Of ζ, \[element\]\[channel\].
    pub factors: Vec<Vec<Double>>,
}

impl WeightSums {
    /// Zeros.
    pub(super) fn new(network: &Network<Double>) -> Self {
        let layers = network.layers.iter().zip(&network.readout.blocks).map(|(layer, block)| LayerSums {
            steps: layer.steps.weight_gradients(),
            block: WeightGradient::new(&block.map),
            norm: vec![0.0; block.norm.as_ref().map_or(0, |norm| norm.scale.len())],
            tables: layer.radial.tables().iter().map(|table| vec![Double::ZERO; table.size()]).collect(),
            factors: vec![vec![Double::ZERO; layer.density.width]; layer.message.constants.len()],
        });
        Self {
            layers: layers.collect(),
            perceptron: network.readout.maps.iter().map(WeightGradient::new).collect(),
            shifts: vec![0.0; network.readout.shifts.len()],
        }
    }

    /// Sets all to the sums of others of the same model. Each number is summed in the order of `others`, so that threads change no bit.
    pub fn set_to_sum(&mut self, others: &[&Self], threads: &Threads) {
        self.combine(others, true, threads);
    }

    /// Adds others of the same model, as [`Self::set_to_sum`].
    pub fn add_all(&mut self, others: &[&Self], threads: &Threads) {
        self.combine(others, false, threads);
    }

    fn combine(&mut self, others: &[&Self], from_zero: bool, threads: &Threads) {
        let others: Vec<_> = others.iter().map(|other| other.slices()).collect();
        let parts = |(array, sums): (usize, _)| {
            let parts = <[f64]>::chunks_mut(sums, PART).enumerate();
            parts.map(move |(number, part)| (array, number * PART, part))
        };
        let mut tasks: Vec<_> = self.slices_mut().into_iter().enumerate().flat_map(parts).collect();
        threads.for_each(&mut tasks, |(array, begin, sums)| {
            if from_zero {
                sums.fill(0.0);
            }
            for other in &others {
                let x = &other[*array][*begin..][..sums.len()];
                sums.iter_mut().zip(x).for_each(|(sum, x)| *sum += x);
            }
        });
    }

    /// Sets all sums to zero.
    pub fn clear(&mut self) {
        self.slices_mut().into_iter().for_each(|sums| sums.fill(0.0));
    }

    /// All arrays, in a fixed order.
    fn slices(&self) -> Vec<&[f64]> {
        let Self { layers, perceptron, shifts } = self;
        let mut all = Vec::new();
        for LayerSums { steps, block, norm, tables, factors } in layers {
            all.extend(steps.iter().flatten().chain([block]).map(WeightGradient::flat));
            all.extend(tables.iter().chain(factors).map(|row| Double::flat(row)));
            all.push(norm.as_slice());
        }
        all.extend(perceptron.iter().map(WeightGradient::flat));
        all.push(shifts.as_slice());
        all
    }

    /// The same arrays in the same order.
    fn slices_mut(&mut self) -> Vec<&mut [f64]> {
        let Self { layers, perceptron, shifts } = self;
        let mut all = Vec::new();
        for LayerSums { steps, block, norm, tables, factors } in layers {
            all.extend(steps.iter_mut().flatten().chain([block]).map(WeightGradient::flat_mut));
            all.extend(tables.iter_mut().chain(factors).map(|row| Double::flat_mut(row)));
            all.push(norm.as_mut_slice());
        }
        all.extend(perceptron.iter_mut().map(WeightGradient::flat_mut));
        all.push(shifts.as_mut_slice());
        all
    }

    /// Adds the derivatives with respect to the arrays of the file to `out`.
    pub(super) fn pull_back(
        &self,
        network: &Network<Double>,
        arrays: &WeightArrays,
        (traces, threads): (&[KnotTraces], &Threads),
        out: &mut WeightArrays,
    ) {
        let layers = self.layers.iter().zip(&network.layers).zip(&network.readout.blocks);
        for (((sums, layer), block), traces) in layers.zip(traces) {
            for (operation, of_parts) in layer.steps.operations().zip(&sums.steps) {
                let TapeOperation::Linear(linear) = operation else { continue };
                for (part, sum) in linear.parts.iter().zip(of_parts) {
                    part.map.pull_back(&sum.numbers(&part.map), out);
                }
            }
            block.map.pull_back(&sums.block.numbers(&block.map), out);
            if let Some(norm) = &block.norm {
                let scale = out[norm.array.as_str()].iter_mut();
                scale.zip(&sums.norm).for_each(|(x, sum)| *x += sum);
            }
            let factors = &layer.message.factors;
            let rows: Vec<Vec<f64>> =
                sums.factors.iter().map(|row| Double::flat(row)[..factors.channels].to_vec()).collect();
            factors.pull_back(arrays, &rows, out);
            traces.pull_back(&layer.radial, &sums.tables, out, threads);
        }
        for (map, sum) in network.readout.maps.iter().zip(&self.perceptron) {
            map.pull_back(&sum.numbers(map), out);
        }
        if let Some(shifts) = out.get_mut(SHIFTS) {
            shifts.iter_mut().zip(&self.shifts).for_each(|(x, sum)| *x += sum);
        }
    }
}
