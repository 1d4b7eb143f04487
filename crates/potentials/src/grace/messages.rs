//! The sum over bonds in later layers, where each neighbour sends a message of several components.
//!
//! T_a,q,lm,n = Σ_j R_nl(r) Y_lm(v) m_q,n(j).

use std::ops::Range;

use atoms::Vec3;

use super::batches::Chunk;
use super::bonds::{BondWork, GraceBond, GraceBonds, OwnBonds, bond_gradient, directions, distances, put};
use super::layer::Layer;
use super::tape::TapeSlot;
use super::vector::Vector;

/// The cotangents that a chunk of atoms returns to the senders of its messages: up to two, for the components
/// that depend on the preceding layer. Each chunk sums its own, and the sums are added in the order of chunks,
/// so the result does not depend on the assignment to threads.
#[derive(Clone, Debug, Default)]
pub(super) struct ReturnedCotangents<V> {
    /// Places of the senders, ascending.
    to: Vec<u32>,
    /// One row per sender.
    cotangents: [Vec<V>; 2],
}

impl<V: Vector> ReturnedCotangents<V> {
    /// Finds the senders of a chunk and writes the row of each bond's neighbour. `row_of` is scratch memory
    /// with a number per atom.
    pub fn find(&mut self, bonds: &GraceBonds, chunk: &Chunk, row_of: &mut [u32], rows: &mut [u32]) {
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

    /// Sets `n` cotangents of this many lanes per atom to zero.
    #[inline(always)]
    pub fn begin(&mut self, n: usize, lanes: usize) {
        for cotangents in &mut self.cotangents[..n] {
            cotangents.clear();
            cotangents.resize(self.to.len() * lanes, V::ZERO);
        }
    }

    /// Adds the contributions for these places to their cotangent number `k`.
    #[inline(always)]
    pub fn add_to(&self, k: usize, places: &Range<usize>, lanes: usize, sums: &mut [V]) {
        let first = self.to.partition_point(|place| (*place as usize) < places.start);
        let rows = self.cotangents[k][first * lanes..].chunks_exact(lanes);
        for (place, row) in self.to[first..].iter().zip(rows) {
            if *place as usize >= places.end {
                break;
            }
            let sum = &mut sums[(*place as usize - places.start) * lanes..][..lanes];
            sum.iter_mut().zip(row).for_each(|(sum, x)| sum.add(x));
        }
    }
}

/// A block of bonds in the reverse pass.
struct BondBlock<'a, V> {
    bonds: &'a [GraceBond],
    /// R_nl and dR_nl/dr, \[bond\]\[l\]\[channel\]
    values: &'a [V],
    derivatives: &'a [V],
    /// Y_lm, \[lm\]\[bond\]
    harmonics: &'a [V],
    gradients: &'a [[V; 3]],
}

/// Adds the messages of the neighbours of an atom of element `centre` to its T.
#[inline(always)]
pub(super) fn accumulate_messages<V: Vector>(
    layer: &Layer<V>,
    centre: usize,
    own: OwnBonds<V>,
    messages: &[V],
    (density, slot): (&mut [V], TapeSlot),
    work: &mut BondWork<V>,
) {
    for (bonds, values, derivatives) in own.blocks(layer) {
        let (v, _) = directions(bonds);
        layer.harmonics.evaluate::<V, false>(&v, &mut work.harmonics, &mut work.gradients);
        let distances = distances(layer, centre, bonds);
        layer.radial.evaluate(&distances[..bonds.len()], &mut work.radial, values, derivatives);
        add_messages(layer, (bonds, values), messages, (density, slot), work);
    }
}

/// As [`super::bonds::reverse`], from `N` ≤ 2 cotangents of T. Also adds to the cotangents of the neighbours'
/// messages, at the rows in `rows`.
#[inline(always)]
pub(super) fn reverse_messages<V: Vector, const N: usize>(
    layer: &Layer<V>,
    own: OwnBonds<V>,
    messages: &[V],
    (cotangent, slots): (&[V], [TapeSlot; N]),
    work: &mut BondWork<V>,
    gradients: [&mut [Vec3]; N],
    (rows, returns): (&[u32], &mut ReturnedCotangents<V>),
) {
    let blocks = own.blocks(layer).zip(rows.chunks(V::LANES));
    for (k, ((bonds, values, derivatives), rows)) in blocks.enumerate() {
        let (v, r) = directions(bonds);
        layer.harmonics.evaluate::<V, true>(&v, &mut work.harmonics, &mut work.gradients);
        let block =
            BondBlock { bonds, values, derivatives, harmonics: &work.harmonics, gradients: &work.gradients };
        for (n, slot) in slots.into_iter().enumerate() {
            let cotangent = (cotangent, slot);
            let (along, across) = slopes(layer, &block, cotangent, messages);
            let of_block = bond_gradient(&v, &r, &along, &across);
            put(&of_block, &mut gradients[n][k * V::LANES..][..bonds.len()]);
            return_messages(layer, &block, cotangent, rows, &mut returns.cotangents[n]);
        }
    }
}

/// T_q,lm,n += Σ_b Y_lm(v_b) R_nl(r_b) m_q,n over a block.
#[inline(always)]
fn add_messages<V: Vector>(
    layer: &Layer<V>,
    (bonds, values): (&[GraceBond], &[V]),
    messages: &[V],
    (density, slot): (&mut [V], TapeSlot),
    work: &mut BondWork<V>,
) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    let (of_message, functions) = (layer.message.lanes(), layer.harmonics.len());
    for (l, lm) in orders(layer) {
        for c in 0..width {
            let terms = &mut work.terms[..bonds.len()];
            for (b, term) in terms.iter_mut().enumerate() {
                *term = values[b * lanes + l * width + c].scaled(work.harmonics[lm][b]);
            }
            for q in 0..layer.message.components {
                let sum = &mut density[slot.row(&layer.density, q * functions + lm) + c];
                let mut total = *sum;
                for (bond, term) in bonds.iter().zip(&*terms) {
                    let message = &messages[bond.neighbour as usize * of_message + q * width + c];
                    total.add_product(term, message);
                }
                *sum = total;
            }
        }
    }
}

/// g = Σ c′_lm Y_lm and G = Σ c_lm ∂Y_lm/∂v of a block, with c_lm = Σ_n R_nl Σ_q T̄_q,lm,n m_q,n and c′_lm
/// from dR/dr.
#[inline(always)]
fn slopes<V: Vector>(
    layer: &Layer<V>,
    block: &BondBlock<V>,
    (cotangent, slot): (&[V], TapeSlot),
    messages: &[V],
) -> (V, [V; 3]) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    let (of_message, functions) = (layer.message.lanes(), layer.harmonics.len());
    let (mut along, mut across) = (V::ZERO, [V::ZERO; 3]);
    for (l, lm) in orders(layer) {
        let (mut c, mut c_prime) = (V::ZERO, V::ZERO);
        for (b, bond) in block.bonds.iter().enumerate() {
            let (mut value, mut derivative) = (V::ZERO, V::ZERO);
            for k in 0..width {
                let mut sum = V::ZERO;
                for q in 0..layer.message.components {
                    let message = &messages[bond.neighbour as usize * of_message + q * width + k];
                    let row = slot.row(&layer.density, q * functions + lm);
                    sum.add_product(&cotangent[row + k], message);
                }
                value.add_product(&sum, &block.values[b * lanes + l * width + k]);
                derivative.add_product(&sum, &block.derivatives[b * lanes + l * width + k]);
            }
            (c[b], c_prime[b]) = (value.horizontal_sum(), derivative.horizontal_sum());
        }
        along.add_product(&block.harmonics[lm], &c_prime);
        for (across, gradient) in across.iter_mut().zip(&block.gradients[lm]) {
            across.add_product(gradient, &c);
        }
    }
    (along, across)
}

/// m̄_q,n(j) += Σ_l R_nl Σ_m Y_lm T̄_q,lm,n for each bond of a block.
#[inline(always)]
fn return_messages<V: Vector>(
    layer: &Layer<V>,
    block: &BondBlock<V>,
    (cotangent, slot): (&[V], TapeSlot),
    rows: &[u32],
    message_cotangents: &mut [V],
) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    let (passed, functions) = (layer.message.passed(), layer.harmonics.len());
    for (b, row) in rows.iter().enumerate() {
        let to = *row as usize * passed * width;
        for q in 0..passed {
            for c in 0..width {
                let mut total = V::ZERO;
                for l in 0..=layer.harmonics.lmax() {
                    let mut sum = V::ZERO;
                    for lm in l * l..(l + 1) * (l + 1) {
                        let row = &cotangent[slot.row(&layer.density, q * functions + lm) + c];
                        sum.add_scaled(block.harmonics[lm][b], row);
                    }
                    let sum = sum.product(&block.values[b * lanes + l * width + c]);
                    total.add(&sum);
                }
                message_cotangents[to + q * width + c].add(&total);
            }
        }
    }
}

/// (l, index of lm) of all spherical harmonics.
#[inline(always)]
fn orders<V: Vector>(layer: &Layer<V>) -> impl Iterator<Item = (usize, usize)> {
    (0..=layer.harmonics.lmax()).flat_map(|l| (l * l..(l + 1) * (l + 1)).map(move |lm| (l, lm)))
}
