//! Radial functions R_nl(r) of every pair of elements, evaluated exactly or from tables.

use super::radial_network::{RadialNetwork, RadialWork};
use super::radial_table::{RadialTable, b_splines};
use super::vector::{Double, MAX_LANES, Number, Vector};

/// Limit of the total size of tables if every pair of elements needs its own, bytes.
const MAX_TABLE_BYTES: usize = 1 << 28;

/// How radial functions are evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum RadialPath {
    /// The network itself, for every bond.
    Exact,
    /// Splines of degree seven. The errors of values and derivatives, relative to the largest, are at most
    /// 10⁻¹¹, in mixed precision 10⁻⁸ before coefficients are rounded; they are measured when a model is read.
    /// If tables for every pair of elements would exceed 256 MiB (three layers, tens of elements), the network
    /// itself is evaluated.
    #[default]
    Table,
}

/// The radial functions of every pair of elements.
#[derive(Clone, Debug)]
pub(super) struct RadialFunctions<V> {
    network: RadialNetwork,
    n_elements: usize,
    /// r_c for centre and neighbour element, `[n_elements²]`, Å.
    cutoffs: Vec<f64>,
    /// One table per distinct cutoff, or per pair if the elements matter; empty on the exact path.
    tables: Vec<RadialTable<V>>,
    /// Index of the table for centre and neighbour element, `[n_elements²]`.
    table_of_pair: Vec<usize>,
}

impl<V: Vector> RadialFunctions<V> {
    /// With tables of this relative error, or without tables.
    pub fn new(
        network: RadialNetwork,
        n_elements: usize,
        cutoffs: Vec<f64>,
        table_error: Option<f64>,
    ) -> Self {
        let mut tables: Vec<RadialTable<V>> = Vec::new();
        let mut table_of_pair = Vec::new();
        let errors = table_error.into_iter().cycle();
        for ((pair, cutoff), error) in cutoffs.iter().enumerate().zip(errors) {
            let same = |table: &RadialTable<V>| network.pair_biases.is_empty() && table.cutoff() == *cutoff;
            let known = tables.iter().position(same);
            table_of_pair.push(known.unwrap_or(tables.len()));
            if known.is_none() {
                tables.push(RadialTable::new(&network, *cutoff, pair, error).rounded());
            }
            if !network.pair_biases.is_empty() && tables[0].bytes() * cutoffs.len() > MAX_TABLE_BYTES {
                tables.clear();
                break;
            }
        }
        Self { network, n_elements, cutoffs, tables, table_of_pair }
    }

    /// Index of a pair of elements.
    #[inline(always)]
    pub fn pair(&self, centre: usize, neighbour: usize) -> usize {
        centre * self.n_elements + neighbour
    }

    /// r_c of a pair, Å.
    #[inline(always)]
    pub fn cutoff(&self, pair: usize) -> f64 {
        self.cutoffs[pair]
    }

    /// The largest r_c, Å.
    pub fn largest_cutoff(&self) -> f64 {
        self.cutoffs.iter().copied().fold(0.0, f64::max)
    }

    /// Lanes of R_nl of one bond, \[l\]\[channel\].
    pub fn output_lanes(&self) -> usize {
        self.network.output_lanes() * Double::LANES / V::LANES
    }

    /// Number of Chebyshev polynomials.
    pub fn basis_size(&self) -> usize {
        self.network.basis_size
    }

    /// The tables.
    pub fn tables(&self) -> &[RadialTable<V>] {
        &self.tables
    }

    /// The table of a pair of elements.
    #[inline(always)]
    pub fn table_of_pair(&self, pair: usize) -> usize {
        self.table_of_pair[pair]
    }

    pub fn network(&self) -> &RadialNetwork {
        &self.network
    }

    /// The network and the tables, to be changed.
    pub fn parts_mut(&mut self) -> (&mut RadialNetwork, &mut [RadialTable<V>]) {
        (&mut self.network, &mut self.tables)
    }

    /// R_nl and dR_nl/dr of at most as many bonds as a vector has lanes, each \[bond\]\[l\]\[channel\], from
    /// the pair of elements and the distance of each, within the cutoff of the pair.
    #[inline(always)]
    pub fn evaluate(
        &self,
        bonds: &[(usize, f64)],
        work: &mut RadialWork,
        values: &mut [V],
        derivatives: &mut [V],
    ) {
        if self.tables.is_empty() {
            return self.evaluate_exactly(bonds, work, values, derivatives);
        }
        let (lanes, mut places) = (self.output_lanes(), V::ZERO);
        let mut located = [(&self.tables[0], 0); MAX_LANES];
        for (b, (pair, r)) in bonds.iter().enumerate() {
            let table = &self.tables[self.table_of_pair[*pair]];
            let (interval, t) = table.locate(*r);
            places[b] = V::Number::round(t);
            located[b] = (table, interval);
        }
        let weights = b_splines(&places);
        let rows = values.chunks_exact_mut(lanes).zip(derivatives.chunks_exact_mut(lanes));
        for (b, (values, derivatives)) in rows.enumerate().take(bonds.len()) {
            let (table, interval) = located[b];
            table.combine(interval, b, &weights, values, derivatives);
        }
    }

    fn evaluate_exactly(
        &self,
        bonds: &[(usize, f64)],
        work: &mut RadialWork,
        values: &mut [V],
        derivatives: &mut [V],
    ) {
        let lanes = self.output_lanes();
        let rows = values.chunks_exact_mut(lanes).zip(derivatives.chunks_exact_mut(lanes));
        for ((pair, r), (values, derivatives)) in bonds.iter().zip(rows) {
            let [value, derivative, _] = self.network.evaluate(*r, self.cutoffs[*pair], *pair, work);
            round(value, values);
            round(derivative, derivatives);
        }
    }
}

fn round<V: Vector>(from: &[Double], to: &mut [V]) {
    for (to, from) in V::flat_mut(to).iter_mut().zip(Double::flat(from)) {
        *to = V::Number::round(*from);
    }
}

#[cfg(test)]
mod tests {
    use super::super::radial_network::tests::network;
    use super::*;

    #[test]
    fn the_table_keeps_its_stated_error_everywhere() {
        for envelope_last in [false, true] {
            check_table(&network(envelope_last));
        }
    }

    fn check_table(network: &RadialNetwork) {
        let cutoff = 5.0;
        let table = RadialTable::new(network, cutoff, 0, 1e-11);
        let stated = table.errors();
        assert!(stated[0] <= 1e-11 && stated[1] <= 1e-11, "{stated:?}");
        let (mut work, mut worst) = (RadialWork::default(), [0.0_f64; 2]);
        let (mut largest, n) = ([0.0_f64; 2], network.output_lanes());
        let (mut values, mut derivatives) = (vec![Double::ZERO; n], vec![Double::ZERO; n]);
        for k in 0..5000 {
            let r = cutoff * (k as f64 + 0.37) / 5000.0;
            let exact = network.evaluate(r, cutoff, 0, &mut work);
            table.evaluate_one(r, &mut values, &mut derivatives);
            for (order, found) in [&values, &derivatives].into_iter().enumerate() {
                for (f, e) in Double::flat(found).iter().zip(Double::flat(&exact[order])) {
                    worst[order] = worst[order].max((f - e).abs());
                    largest[order] = largest[order].max(e.abs());
                }
            }
        }
        for order in 0..2 {
            let error = worst[order] / largest[order];
            // The bound is measured where the error is largest, up to its variation within an interval.
            assert!(error <= 1.2 * stated[order] + 1e-15, "{order}: {error:e}, stated {:e}", stated[order]);
        }
    }
}
