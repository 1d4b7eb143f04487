//! The sum over bonds in later layers, where each neighbour sends a message of several components.
//!
//! T_a,q,lm,n = Σ_j R_nl(r) Y_lm(v) m_q,n(j).

use std::ops::Range;

use atoms::Vec3;

use super::batches::Chunk;
use super::bonds::{Bond, BondWork, Bonds, OwnBonds, bond_gradient, directions, pairs, put};
use super::layer::Layer;
use super::matrix::{LANES, Lanes, ZERO, add_product, add_scaled, horizontal_sum, product, scaled};
use super::tape::Slot;

/// What a chunk of atoms returns to those whose messages it got: up to two cotangents of the components that depend on the
/// layer before. Every chunk sums its own, and the sums are added in the order of chunks, so that it does not matter who
/// worked them out.
#[derive(Clone, Debug, Default)]
pub(super) struct Returns {
    /// Places of those, in ascending order.
    to: Vec<u32>,
    /// A row for each of them.
    cotangents: [Vec<Lanes>; 2],
}

impl Returns {
    /// Finds out to whom the chunk returns, and writes the row of each bond's neighbour. `row_of` has a number for each atom of
    /// the structure, which is not read.
    pub fn find(&mut self, bonds: &Bonds, chunk: &Chunk, row_of: &mut [u32], rows: &mut [u32]) {
        const NONE: u32 = u32::MAX;
        row_of.fill(NONE);
        let range = bonds.offsets[chunk.places.start]..bonds.offsets[chunk.places.end];
        let bonds = &bonds.bonds[range.clone()];
        self.to.clear();
        for bond in bonds {
            if row_of[bond.neighbour as usize] == NONE {
                row_of[bond.neighbour as usize] = 0;
                self.to.push(bond.neighbour);
            }
        }
        self.to.sort_unstable();
        for (row, place) in self.to.iter().enumerate() {
            row_of[*place as usize] = row as u32;
        }
        for (row, bond) in rows[range].iter_mut().zip(bonds) {
            *row = row_of[bond.neighbour as usize];
        }
    }

    /// Sets `n` cotangents to zero, of so many lanes for each atom.
    #[inline(always)]
    pub fn begin(&mut self, n: usize, lanes: usize) {
        for cotangents in &mut self.cotangents[..n] {
            cotangents.clear();
            cotangents.resize(self.to.len() * lanes, ZERO);
        }
    }

    /// Adds what there is for some places to their cotangent number `k`.
    #[inline(always)]
    pub fn add_to(&self, k: usize, places: &Range<usize>, lanes: usize, sums: &mut [Lanes]) {
        let first = self.to.partition_point(|place| (*place as usize) < places.start);
        let rows = self.cotangents[k][first * lanes..].chunks_exact(lanes);
        for (place, row) in self.to[first..].iter().zip(rows) {
            if *place as usize >= places.end {
                break;
            }
            let sum = &mut sums[(*place as usize - places.start) * lanes..][..lanes];
            sum.iter_mut().zip(row).for_each(|(sum, x)| add_scaled(sum, 1.0, x));
        }
    }
}

/// Up to eight bonds of one atom as the reverse sweep sees them.
struct Block<'a> {
    bonds: &'a [Bond],
    /// R_nl and dR_nl/dr, \[bond\]\[l\]\[channel\]
    values: &'a [Lanes],
    derivatives: &'a [Lanes],
    /// Y_lm, \[lm\]\[bond\]
    harmonics: &'a [Lanes],
    gradients: &'a [[Lanes; 3]],
}

/// Adds the messages of the neighbours of an atom of element `centre` to its T.
#[inline(always)]
pub(super) fn accumulate_messages(
    layer: &Layer,
    centre: usize,
    own: OwnBonds,
    messages: &[Lanes],
    (density, slot): (&mut [Lanes], Slot),
    work: &mut BondWork,
) {
    for (bonds, values, derivatives) in own.blocks(layer) {
        let (v, r) = directions(bonds);
        layer.harmonics.evaluate::<false>(&v, &mut work.harmonics, &mut work.gradients);
        let pairs = pairs(layer, centre, bonds);
        layer.radial.evaluate(bonds.len(), &pairs, &r, &mut work.radial, values, derivatives);
        add_eight(layer, (bonds, values, &work.harmonics), messages, density, slot);
    }
}

/// As [`super::bonds::reverse`], from `N` ≤ 2 cotangents of T; adds to the cotangents of the neighbours' messages, whose
/// rows stand in `rows`.
#[inline(always)]
pub(super) fn reverse_messages<const N: usize>(
    layer: &Layer,
    own: OwnBonds,
    messages: &[Lanes],
    (cotangent, slots): (&[Lanes], [Slot; N]),
    work: &mut BondWork,
    gradients: [&mut [Vec3]; N],
    (rows, returns): (&[u32], &mut Returns),
) {
    let blocks = own.blocks(layer).zip(rows.chunks(LANES));
    for (k, ((bonds, values, derivatives), rows)) in blocks.enumerate() {
        let (v, r) = directions(bonds);
        layer.harmonics.evaluate::<true>(&v, &mut work.harmonics, &mut work.gradients);
        let block =
            Block { bonds, values, derivatives, harmonics: &work.harmonics, gradients: &work.gradients };
        for (n, slot) in slots.into_iter().enumerate() {
            let cotangent = (cotangent, slot);
            let (along, across) = slopes_of_eight(layer, &block, cotangent, messages);
            let of_eight = bond_gradient(&v, &r, &along, &across);
            put(&of_eight, &mut gradients[n][k * LANES..][..bonds.len()]);
            return_messages(layer, &block, cotangent, rows, &mut returns.cotangents[n]);
        }
    }
}

/// T_q,lm,n += Σ_b Y_lm(v_b) R_nl(r_b) m_q,n over up to eight bonds.
#[inline(always)]
fn add_eight(
    layer: &Layer,
    (bonds, values, harmonics): (&[Bond], &[Lanes], &[Lanes]),
    messages: &[Lanes],
    density: &mut [Lanes],
    slot: Slot,
) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    let (of_message, functions) = (layer.message.lanes(), layer.harmonics.len());
    for (l, lm) in orders(layer) {
        for c in 0..width {
            let mut terms = [ZERO; LANES];
            for (b, term) in terms.iter_mut().enumerate().take(bonds.len()) {
                *term = scaled(harmonics[lm][b], &values[b * lanes + l * width + c]);
            }
            for q in 0..layer.message.components {
                let sum = &mut density[slot.row(&layer.density, q * functions + lm) + c];
                let mut total = *sum;
                for (bond, term) in bonds.iter().zip(&terms) {
                    let message = &messages[bond.neighbour as usize * of_message + q * width + c];
                    add_product(&mut total, term, message);
                }
                *sum = total;
            }
        }
    }
}

/// g = Σ c′_lm Y_lm and G = Σ c_lm ∂Y_lm/∂v of up to eight bonds, with c_lm = Σ_n R_nl Σ_q T̄_q,lm,n m_q,n and c′_lm
/// from dR/dr.
#[inline(always)]
fn slopes_of_eight(
    layer: &Layer,
    block: &Block,
    (cotangent, slot): (&[Lanes], Slot),
    messages: &[Lanes],
) -> (Lanes, [Lanes; 3]) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    let (of_message, functions) = (layer.message.lanes(), layer.harmonics.len());
    let (mut along, mut across) = (ZERO, [ZERO; 3]);
    for (l, lm) in orders(layer) {
        let (mut c, mut c_prime) = (ZERO, ZERO);
        for (b, bond) in block.bonds.iter().enumerate() {
            let (mut value, mut derivative) = (ZERO, ZERO);
            for k in 0..width {
                let mut sum = ZERO;
                for q in 0..layer.message.components {
                    let message = &messages[bond.neighbour as usize * of_message + q * width + k];
                    let row = slot.row(&layer.density, q * functions + lm);
                    add_product(&mut sum, &cotangent[row + k], message);
                }
                add_product(&mut value, &sum, &block.values[b * lanes + l * width + k]);
                add_product(&mut derivative, &sum, &block.derivatives[b * lanes + l * width + k]);
            }
            (c[b], c_prime[b]) = (horizontal_sum(&value), horizontal_sum(&derivative));
        }
        add_product(&mut along, &block.harmonics[lm], &c_prime);
        for (across, gradient) in across.iter_mut().zip(&block.gradients[lm]) {
            add_product(across, gradient, &c);
        }
    }
    (along, across)
}

/// m̄_q,n(j) += Σ_l R_nl Σ_m Y_lm T̄_q,lm,n for each of up to eight bonds.
#[inline(always)]
fn return_messages(
    layer: &Layer,
    block: &Block,
    (cotangent, slot): (&[Lanes], Slot),
    rows: &[u32],
    message_cotangents: &mut [Lanes],
) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    let (passed, functions) = (layer.message.passed(), layer.harmonics.len());
    for (b, row) in rows.iter().enumerate() {
        let to = *row as usize * passed * width;
        for q in 0..passed {
            for c in 0..width {
                let mut total = ZERO;
                for l in 0..=layer.harmonics.lmax() {
                    let mut sum = ZERO;
                    for lm in l * l..(l + 1) * (l + 1) {
                        let row = &cotangent[slot.row(&layer.density, q * functions + lm) + c];
                        add_scaled(&mut sum, block.harmonics[lm][b], row);
                    }
                    let sum = product(&sum, &block.values[b * lanes + l * width + c]);
                    add_scaled(&mut total, 1.0, &sum);
                }
                add_scaled(&mut message_cotangents[to + q * width + c], 1.0, &total);
            }
        }
    }
}

/// (l, index of lm) of all spherical harmonics.
#[inline(always)]
fn orders(layer: &Layer) -> impl Iterator<Item = (usize, usize)> {
    (0..=layer.harmonics.lmax()).flat_map(|l| (l * l..(l + 1) * (l + 1)).map(move |lm| (l, lm)))
}
