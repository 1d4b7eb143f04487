//! Sums of derivatives over structures.

use super::super::network::Network;
use super::super::threads::Threads;
use super::super::vector::{Double, Vector};
use super::super::weight_arrays::WeightArrays;
use super::super::weight_gradient::WeightGradient;
use super::super::{readout::SHIFTS, tape::TapeOperation};
use super::knot_traces::KnotTraces;

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

    /// Adds other sums of the same model.
    pub fn add(&mut self, other: &Self) {
        for (sum, x) in self.layers.iter_mut().zip(&other.layers) {
            for (sum, x) in sum.steps.iter_mut().flatten().zip(x.steps.iter().flatten()) {
                sum.add(x);
            }
            sum.block.add(&x.block);
            sum.norm.iter_mut().zip(&x.norm).for_each(|(sum, x)| *sum += x);
            for (sum, x) in sum.tables.iter_mut().zip(&x.tables).chain(sum.factors.iter_mut().zip(&x.factors))
            {
                sum.iter_mut().zip(x).for_each(|(sum, x)| sum.add(x));
            }
        }
        self.perceptron.iter_mut().zip(&other.perceptron).for_each(|(sum, x)| sum.add(x));
        self.shifts.iter_mut().zip(&other.shifts).for_each(|(sum, x)| *sum += x);
    }

    /// Sets all sums to zero.
    pub fn clear(&mut self) {
        for sums in &mut self.layers {
            sums.steps.iter_mut().flatten().for_each(WeightGradient::clear);
            sums.block.clear();
            sums.norm.fill(0.0);
            sums.tables.iter_mut().chain(&mut sums.factors).for_each(|row| row.fill(Double::ZERO));
        }
        self.perceptron.iter_mut().for_each(WeightGradient::clear);
        self.shifts.fill(0.0);
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
