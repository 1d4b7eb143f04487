//! The radial network at the knots of its tables: from weights to tables, and from derivatives of tables to those of
//! weights.

use super::super::instructions::Instructions;
use super::super::matrix::{Matrix, StridedRows};
use super::super::networks::matrix;
use super::super::radial::RadialFunctions;
use super::super::radial_network::{RadialNetwork, silu_with_slope};
use super::super::vector::{Double, Vector};
use super::super::weight_arrays::WeightArrays;
use super::super::weight_gradient::WeightGradient;

/// What the network computes at the knots of each table.
#[derive(Clone, Debug)]
pub(super) struct RadialWeights {
    tables: Vec<TableTrace>,
}

/// Rows of the network's layers, one for each knot.
#[derive(Clone, Debug)]
struct TableTrace {
    knots: usize,
    /// The input of each layer; the first does not change.
    inputs: Vec<Vec<Double>>,
    /// The derivatives of the activations before each layer but the first.
    slopes: Vec<Vec<Double>>,
}

impl RadialWeights {
    /// The polynomials at the knots of these tables.
    pub fn new(radial: &RadialFunctions<Double>) -> Self {
        let network = radial.network();
        let mut jet = Default::default();
        let mut tables = Vec::new();
        for table in radial.tables() {
            let (mut rows, mut knots) = (Vec::new(), 0);
            for r in table.knots() {
                network.basis(r, table.cutoff(), &mut jet);
                rows.extend_from_slice(&jet[0]);
                knots += 1;
            }
            tables.push(TableTrace { knots, inputs: vec![rows], slopes: Vec::new() });
        }
        Self { tables }
    }

    /// Sets the network's weights and makes its tables anew.
    pub fn update(&mut self, radial: &mut RadialFunctions<Double>, arrays: &WeightArrays) {
        let (network, tables) = radial.parts_mut();
        network.layers = network.maps.iter().map(|map| matrix(map, arrays)).collect();
        for (trace, table) in self.tables.iter_mut().zip(tables) {
            table.interpolate(&mut trace.evaluate(network));
        }
    }

    /// Adds the derivatives with respect to the network's weights, from those with respect to the coefficients of
    /// the tables.
    pub fn pull_back(
        &self,
        radial: &RadialFunctions<Double>,
        of_tables: &[Vec<Double>],
        out: &mut WeightArrays,
    ) {
        for ((trace, table), of_table) in self.tables.iter().zip(radial.tables()).zip(of_tables) {
            trace.pull_back(radial.network(), table.of_samples(of_table), out);
        }
    }
}

impl TableTrace {
    /// The radial functions at the knots; keeps what the reverse pass needs.
    fn evaluate(&mut self, network: &RadialNetwork) -> Vec<Double> {
        self.inputs.truncate(1);
        self.slopes.clear();
        for (k, layer) in network.layers.iter().enumerate() {
            let mut out = multiply(layer, self.knots, &self.inputs[k]);
            if k + 1 == network.layers.len() {
                return out;
            }
            let mut slopes = out.clone();
            for (x, slope) in Double::flat_mut(&mut out).iter_mut().zip(Double::flat_mut(&mut slopes)) {
                [*x, *slope] = silu_with_slope(*x);
            }
            self.inputs.push(out);
            self.slopes.push(slopes);
        }
        self.inputs[0].clone()
    }

    /// From the cotangents of the radial functions at the knots.
    fn pull_back(&self, network: &RadialNetwork, mut cotangent: Vec<Double>, out: &mut WeightArrays) {
        for (k, (layer, map)) in network.layers.iter().zip(&network.maps).enumerate().rev() {
            let mut gradient = WeightGradient::new(map);
            let rows = |stride| StridedRows::of_atoms(self.knots, stride);
            let (from, to) = (rows(layer.input_lanes()), rows(layer.output_lanes()));
            gradient.add_all_outer_products(self.knots, (&self.inputs[k], from), (&cotangent, to));
            map.pull_back(&gradient.numbers(map), out);
            if k > 0 {
                cotangent = multiply(&layer.transposed(), self.knots, &cotangent);
                cotangent.iter_mut().zip(&self.slopes[k - 1]).for_each(|(c, slope)| *c = c.product(slope));
            }
        }
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
