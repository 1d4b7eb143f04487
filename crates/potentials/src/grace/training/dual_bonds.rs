//! The sums over bonds with their derivative along a direction, and the reverse pass to messages and radial functions.
//!
//! T_q,lm,n = Σ_j R_nl(r) Y_lm(v) m_q,n(j), and with ′ for the derivative along the direction u of each bond,
//! T′ = Σ_j (R_r r′ Y + R Y′) m + R Y m′, where r′ = v·u, v′ = (u − r′ v)/r and R_r = dR/dr.

use super::super::bonds::{GraceBond, directions, distances};
use super::super::layer::Layer;
use super::super::radial_network::RadialWork;
use super::super::radial_table::b_splines;
use super::super::tape::TapeSlot;
use super::super::vector::{Double, MAX_LANES, Vector};
use super::moving_bonds::MovingBonds;
use super::sums::LayerSums;

/// Scratch arrays for one block of bonds.
#[derive(Clone, Debug, Default)]
pub(super) struct BlockWork {
    /// Y_lm and Y_lm′, \[lm\]\[bond\]
    harmonics: [Vec<Double>; 2],
    /// ∂Y_lm/∂v
    gradients: Vec<[Double; 3]>,
    /// R_nl and dR_nl/dr, \[bond\]\[l\]\[channel\]
    radial: [Vec<Double>; 2],
    /// Their cotangents for one bond, \[l\]\[channel\]
    of_radial: [Vec<Double>; 2],
    /// r′, \[bond\]
    rates: Double,
    network: RadialWork,
}

impl BlockWork {
    /// Evaluates the functions of a block of bonds around an atom of element `centre`.
    #[inline(always)]
    fn evaluate(&mut self, layer: &Layer<Double>, centre: usize, block: MovingBonds) {
        let (functions, lanes) = (layer.harmonics.len(), layer.radial.output_lanes());
        self.harmonics.iter_mut().for_each(|row| row.resize(functions, Double::ZERO));
        self.gradients.resize(functions, [Double::ZERO; 3]);
        self.radial.iter_mut().for_each(|rows| rows.resize(Double::LANES * lanes, Double::ZERO));
        self.of_radial.iter_mut().for_each(|row| row.resize(lanes, Double::ZERO));
        let ((v, r), mut u) = (directions::<Double>(block.bonds), [Double::ZERO; 3]);
        for (b, direction) in block.directions.iter().enumerate() {
            (0..3).for_each(|axis| u[axis][b] = direction[axis]);
        }
        let [values, along] = &mut self.harmonics;
        layer.harmonics.evaluate::<Double, true>(&v, values, &mut self.gradients);
        let mut turned = [Double::ZERO; 3];
        for b in 0..Double::LANES {
            self.rates[b] = (0..3).map(|axis| v[axis][b] * u[axis][b]).sum();
            (0..3).for_each(|axis| turned[axis][b] = (u[axis][b] - self.rates[b] * v[axis][b]) / r[b]);
        }
        for (along, gradient) in along.iter_mut().zip(&self.gradients) {
            *along = gradient[0].product(&turned[0]);
            along.add_product(&gradient[1], &turned[1]);
            along.add_product(&gradient[2], &turned[2]);
        }
        let distances = distances(layer, centre, block.bonds);
        let [values, derivatives] = &mut self.radial;
        layer.radial.evaluate(&distances[..block.bonds.len()], &mut self.network, values, derivatives);
    }
}

/// Adds the bonds of an atom of element `centre` to T and T′. `messages` are m and m′ of all atoms.
#[inline(always)]
pub(super) fn accumulate(
    layer: &Layer<Double>,
    centre: usize,
    bonds: MovingBonds,
    messages: [&[Double]; 2],
    (tapes, slot): ([&mut [Double]; 2], TapeSlot),
    work: &mut BlockWork,
) {
    let [values, along] = tapes;
    for block in bonds.blocks() {
        work.evaluate(layer, centre, block);
        add_block(layer, block.bonds, messages, ([&mut *values, &mut *along], slot), work);
    }
}

#[inline(always)]
fn add_block(
    layer: &Layer<Double>,
    bonds: &[GraceBond],
    [messages, messages_along]: [&[Double]; 2],
    ([values, along], slot): ([&mut [Double]; 2], TapeSlot),
    work: &BlockWork,
) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    let (of_message, functions) = (layer.message.lanes(), layer.harmonics.len());
    let mut terms = [[Double::ZERO; 2]; MAX_LANES];
    for lm in 0..functions {
        let l = lm.isqrt();
        for c in 0..width {
            for (b, [term, term_along]) in terms.iter_mut().enumerate().take(bonds.len()) {
                let (y, y_along) = (work.harmonics[0][lm][b], work.harmonics[1][lm][b]);
                let at = b * lanes + l * width + c;
                *term = work.radial[0][at].scaled(y);
                *term_along = work.radial[1][at].scaled(work.rates[b] * y);
                term_along.add_scaled(y_along, &work.radial[0][at]);
            }
            for q in 0..layer.message.components {
                let row = slot.row(&layer.density, q * functions + lm) + c;
                let (mut sum, mut sum_along) = (values[row], along[row]);
                for (bond, [term, term_along]) in bonds.iter().zip(&terms) {
                    let at = bond.neighbour as usize * of_message + q * width + c;
                    sum.add_product(term, &messages[at]);
                    sum_along.add_product(term_along, &messages[at]);
                    if q < layer.message.passed() {
                        sum_along.add_product(term, &messages_along[at]);
                    }
                }
                (values[row], along[row]) = (sum, sum_along);
            }
        }
    }
}

/// From the cotangents of T′ and T of an atom, at the two slots, to those of m′ and m of its neighbours, `returned` `[place, passed
/// components]`, of their elements' factors and of the tables.
#[inline(always)]
pub(super) fn reverse(
    layer: &Layer<Double>,
    centre: usize,
    bonds: MovingBonds,
    messages: [&[Double]; 2],
    (cotangent, slots): (&[Double], [TapeSlot; 2]),
    work: &mut BlockWork,
    (returned, sums): ([&mut [Double]; 2], &mut LayerSums),
) {
    let [returned_along, returned_values] = returned;
    for block in bonds.blocks() {
        work.evaluate(layer, centre, block);
        let mut places = Double::ZERO;
        for (b, bond) in block.bonds.iter().enumerate() {
            let pair = layer.radial.pair(centre, bond.element as usize);
            places[b] = layer.radial.tables()[layer.radial.table_of_pair(pair)].locate(bond.r).1;
        }
        let splines = b_splines(&places);
        for (b, bond) in block.bonds.iter().enumerate() {
            let returned = [&mut *returned_along, &mut *returned_values];
            reverse_bond(layer, (b, bond), messages, (cotangent, slots), work, (returned, sums));
            let table = layer.radial.table_of_pair(layer.radial.pair(centre, bond.element as usize));
            let (radial, of_table) = (&layer.radial.tables()[table], &mut sums.tables[table]);
            let of_radial = work.of_radial.each_ref().map(|row| &row[..]);
            radial.add_gradient(radial.locate(bond.r).0, b, &splines, of_radial, of_table);
        }
    }
}

/// With c and c′ for the cotangents of T and T′: P = Σ_m Y c + Y′ c′ and P′ = Σ_m Y c′ of each q, l and channel give
/// R̄ = Σ_q m P + m′ P′, R̄_r = r′ Σ_q m P′, m̄ = Σ_l R P + R_r r′ P′ and m̄′ = Σ_l R P′.
#[inline(always)]
fn reverse_bond(
    layer: &Layer<Double>,
    (b, bond): (usize, &GraceBond),
    [messages, messages_along]: [&[Double]; 2],
    cotangent: (&[Double], [TapeSlot; 2]),
    work: &mut BlockWork,
    ([returned_along, returned], sums): ([&mut [Double]; 2], &mut LayerSums),
) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    let passed = layer.message.passed();
    let first = bond.neighbour as usize * layer.message.lanes();
    let rate = work.rates[b];
    work.of_radial.iter_mut().for_each(|row| row.fill(Double::ZERO));
    for q in 0..layer.message.components {
        for c in 0..width {
            let m = messages[first + q * width + c];
            let m_along = if q < passed { messages_along[first + q * width + c] } else { Double::ZERO };
            let (mut of_message, mut of_message_along) = (Double::ZERO, Double::ZERO);
            for l in 0..=layer.harmonics.lmax() {
                let [p, p_along] = harmonic_sums(layer, (b, &*work), cotangent, [q, l, c]);
                let at = l * width + c;
                let (value, derivative) = (work.radial[0][b * lanes + at], work.radial[1][b * lanes + at]);
                of_message.add_product(&value, &p);
                of_message_along.add_product(&value, &p_along);
                let p_rate = p_along.scaled(rate);
                of_message.add_product(&derivative, &p_rate);
                let [of_values, of_derivatives] = &mut work.of_radial;
                of_values[at].add_product(&m, &p);
                of_values[at].add_product(&m_along, &p_along);
                of_derivatives[at].add_product(&m, &p_rate);
            }
            if q < passed {
                let at = (bond.neighbour as usize * passed + q) * width + c;
                returned[at].add(&of_message);
                returned_along[at].add(&of_message_along);
            }
            if q + 1 == layer.message.components {
                sums.factors[bond.element as usize][c].add(&of_message);
            }
        }
    }
}

/// P and P′ of bond `b` for the component q of its message, the order l and the channel c.
#[inline(always)]
fn harmonic_sums(
    layer: &Layer<Double>,
    (b, work): (usize, &BlockWork),
    (cotangent, [slot_along, slot]): (&[Double], [TapeSlot; 2]),
    [q, l, c]: [usize; 3],
) -> [Double; 2] {
    let functions = layer.harmonics.len();
    let (mut p, mut p_along) = (Double::ZERO, Double::ZERO);
    for lm in l * l..(l + 1) * (l + 1) {
        let (y, y_along) = (work.harmonics[0][lm][b], work.harmonics[1][lm][b]);
        let component = q * functions + lm;
        let of_along = cotangent[slot_along.row(&layer.density, component) + c];
        p.add_scaled(y, &cotangent[slot.row(&layer.density, component) + c]);
        p.add_scaled(y_along, &of_along);
        p_along.add_scaled(y, &of_along);
    }
    [p, p_along]
}
