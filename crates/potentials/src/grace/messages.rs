//! The sum over bonds in later layers, where each neighbour sends a message of several components.
//!
//! T_a,q,lm,n = Σ_j R_nl(r) Y_lm(v) m_q,n(j).

use atoms::Vec3;

use super::bonds::{Bond, BondWork, Bonds, bond_gradient, directions, pairs};
use super::layer::Layer;
use super::matrix::{LANES, Lanes, ZERO, add_product, add_scaled, horizontal_sum, product, scaled};
use super::tape::Slot;

/// The messages of all atoms, [n, q, channels], and where up to two of their cotangents are summed, of the
/// components that depend on the layer before.
pub(super) struct Messages<'a> {
    pub sent: &'a [Lanes],
    pub cotangents: [&'a mut [Lanes]; 2],
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

impl Bonds {
    /// Adds the messages of the neighbours of the atom at a place, of element `centre`, to its T.
    #[inline(always)]
    pub fn accumulate_messages(
        &mut self,
        place: usize,
        layer: &Layer,
        centre: usize,
        messages: &[Lanes],
        density: (&mut [Lanes], Slot),
        work: &mut BondWork,
    ) {
        let (mut all_values, mut all_derivatives) =
            (std::mem::take(&mut self.values), std::mem::take(&mut self.derivatives));
        let (density, slot) = density;
        for (bonds, block) in self.blocks(place, layer) {
            let (v, r) = directions(bonds);
            layer.harmonics.evaluate::<false>(&v, &mut work.harmonics, &mut work.gradients);
            let (values, derivatives) = (&mut all_values[block.clone()], &mut all_derivatives[block]);
            let pairs = pairs(layer, centre, bonds);
            layer.radial.evaluate(bonds.len(), &pairs, &r, &mut work.radial, values, derivatives);
            add_eight(layer, (bonds, values, &work.harmonics), messages, density, slot);
        }
        (self.values, self.derivatives) = (all_values, all_derivatives);
    }

    /// As [`Bonds::reverse`], from `N` ≤ 2 cotangents of T; adds to the cotangents of the neighbours' messages.
    #[inline(always)]
    pub fn reverse_messages<const N: usize>(
        &self,
        place: usize,
        layer: &Layer,
        (cotangent, slots): (&[Lanes], [Slot; N]),
        messages: Messages,
        work: &mut BondWork,
        mut sink: impl FnMut(&Bond, [Vec3; N]),
    ) {
        for (bonds, range) in self.blocks(place, layer) {
            let (v, r) = directions(bonds);
            layer.harmonics.evaluate::<true>(&v, &mut work.harmonics, &mut work.gradients);
            let block = Block {
                bonds,
                values: &self.values[range.clone()],
                derivatives: &self.derivatives[range],
                harmonics: &work.harmonics,
                gradients: &work.gradients,
            };
            let mut gradients = [[ZERO; 3]; N];
            for (n, slot) in slots.into_iter().enumerate() {
                let cotangent = (cotangent, slot);
                let (along, across) = slopes_of_eight(layer, &block, cotangent, messages.sent);
                gradients[n] = bond_gradient(&v, &r, &along, &across);
                return_messages(layer, &block, cotangent, messages.cotangents[n]);
            }
            for (b, bond) in bonds.iter().enumerate() {
                sink(bond, gradients.map(|gradient| gradient.map(|axis| axis[b])));
            }
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
    message_cotangents: &mut [Lanes],
) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    let (passed, functions) = (layer.message.passed(), layer.harmonics.len());
    for (b, bond) in block.bonds.iter().enumerate() {
        let to = bond.neighbour as usize * passed * width;
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
