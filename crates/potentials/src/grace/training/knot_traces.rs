//! The radial network at the knots of its tables: from weights to tables, and from derivatives of tables to those of
//! weights.

use std::ops::Range;

use super::super::activation::Activation;
use super::super::instructions::Instructions;
use super::super::matrix::{Matrix, StridedRows};
use super::super::networks::matrix;
use super::super::radial::RadialFunctions;
use super::super::radial_network::RadialNetwork;
use super::super::threads::Threads;
use super::super::vector::{Double, Vector};
use super::super::weight_arrays::WeightArrays;
use super::super::weight_gradient::WeightGradient;

/// Number of parts into which the knots of a table are divided. Sums over parts have the same bits for any number of
/// threads.
const PARTS: usize = 4;

/// What the radial network of a layer computes at the knots of each table, in parts of consecutive knots.
#[derive(Clone, Debug)]
pub(super) struct KnotTraces {
    parts: Vec<KnotTrace>,
}

/// Rows of the network's layers, one for each of some knots.
#[derive(Clone, Debug)]
struct KnotTrace {
    table: usize,
    knots: Range<usize>,
    /// The input of each layer; the first does not change.
    inputs: Vec<Vec<Double>>,
    /// The derivatives of the activations before each layer but the first.
    slopes: Vec<Vec<Double>>,
    /// R_nl at the knots.
    values: Vec<Double>,
}

impl KnotTraces {
    /// The polynomials at the knots of these tables.
    pub fn new(radial: &RadialFunctions<Double>) -> Self {
        let (network, mut jet, mut parts) = (radial.network(), Default::default(), Vec::new());
        for (table, spline) in radial.tables().iter().enumerate() {
            let knots: Vec<f64> = spline.knots().collect();
            for part in 0..PARTS {
                let range = part * knots.len() / PARTS..(part + 1) * knots.len() / PARTS;
                let mut rows = Vec::new();
                for r in &knots[range.clone()] {
                    network.basis(*r, spline.cutoff(), &mut jet);
                    rows.extend_from_slice(&jet[0]);
                }
                let (inputs, slopes, values) = (vec![rows], Vec::new(), Vec::new());
                parts.push(KnotTrace { table, knots: range, inputs, slopes, values });
            }
        }
        Self { parts }
    }

    /// Sets the network's weights and makes its tables anew.
    pub fn update(&mut self, radial: &mut RadialFunctions<Double>, arrays: &WeightArrays, threads: &Threads) {
        let (network, tables) = radial.parts_mut();
        network.layers = network.maps.iter().map(|map| matrix(map, arrays)).collect();
        let network = &*network;
        threads.for_each(&mut self.parts, |part| part.evaluate(network));
        for (table, parts) in tables.iter_mut().zip(self.parts.chunks(PARTS)) {
            let mut samples: Vec<Double> = parts.iter().flat_map(|part| &part.values).copied().collect();
            table.interpolate(&mut samples);
        }
    }

    /// Adds the derivatives with respect to the network's weights, from those with respect to the coefficients of
    /// the tables.
    pub fn pull_back(
        &self,
        radial: &RadialFunctions<Double>,
        of_tables: &[Vec<Double>],
        out: &mut WeightArrays,
        threads: &Threads,
    ) {
        let (network, lanes) = (radial.network(), radial.output_lanes());
        let tables = radial.tables().iter().zip(of_tables);
        let of_samples: Vec<_> = tables.map(|(table, of_table)| table.of_samples(of_table)).collect();
        let mut found: Vec<_> = self.parts.iter().map(|part| (part, Vec::new())).collect();
        threads.for_each(&mut found, |(part, gradients)| {
            let rows = part.knots.start * lanes..part.knots.end * lanes;
            *gradients = part.reverse(network, of_samples[part.table][rows].to_vec());
        });
        let mut gradients = found.into_iter().map(|(_, gradients)| gradients);
        let Some(mut sums) = gradients.next() else { return };
        for others in gradients {
            sums.iter_mut().zip(&others).for_each(|(sum, other)| sum.add(other));
        }
        for (map, sum) in network.maps.iter().zip(&sums) {
            map.pull_back(&sum.numbers(map), out);
        }
    }
}

impl KnotTrace {
    /// Computes the radial functions at the knots; keeps what the reverse pass needs.
    fn evaluate(&mut self, network: &RadialNetwork) {
        self.inputs.truncate(1);
        self.slopes.clear();
        let last = network.layers.len() - 1;
        for (k, layer) in network.layers.iter().enumerate() {
            let mut out = multiply(layer, self.knots.len(), &self.inputs[k]);
            if k == last {
                self.values = out;
                return;
            }
            let mut slopes = out.clone();
            for (x, slope) in Double::flat_mut(&mut out).iter_mut().zip(Double::flat_mut(&mut slopes)) {
                (*x, *slope) = Activation::Silu.evaluate(*x);
            }
            self.inputs.push(out);
            self.slopes.push(slopes);
        }
    }

    /// The derivatives with respect to each layer, from the cotangents of the radial functions at the knots.
    fn reverse(&self, network: &RadialNetwork, mut cotangent: Vec<Double>) -> Vec<WeightGradient<Double>> {
        let mut gradients = Vec::new();
        for (k, (layer, map)) in network.layers.iter().zip(&network.maps).enumerate().rev() {
            let mut gradient = WeightGradient::new(map);
            let rows = |stride| StridedRows::of_atoms(self.knots.len(), stride);
            let (from, to) = (rows(layer.input_lanes()), rows(layer.output_lanes()));
            gradient.add_all_outer_products(self.knots.len(), (&self.inputs[k], from), (&cotangent, to));
            gradients.push(gradient);
            if k > 0 {
                cotangent = multiply(&layer.transposed(), self.knots.len(), &cotangent);
                cotangent.iter_mut().zip(&self.slopes[k - 1]).for_each(|(c, slope)| *c = c.product(slope));
            }
        }
        gradients.reverse();
        gradients
    }
}

/// Each row times the matrix.
fn multiply(matrix: &Matrix<Double>, rows: usize, from: &[Double]) -> Vec<Double> {
    let mut out = vec![Double::ZERO; rows * matrix.output_lanes()];
    let (x, y) = (matrix.input_lanes(), matrix.output_lanes());
    let (x, y) = (StridedRows::of_atoms(rows, x), StridedRows::of_atoms(rows, y));
    matrix.multiply_add((from, &mut out[..]), x, y, Instructions::best());
    out
}
