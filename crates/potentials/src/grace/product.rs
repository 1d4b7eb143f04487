//! Tensor products per channel, and linear combinations of rows.

use std::collections::BTreeMap;

use super::vector::{Number, Vector};

/// out_n,f = Σ_c C_c left_n,l(c) right_n,r(c), summed over the terms c of f.
#[derive(Clone, Debug)]
pub(super) struct Product<V: Vector> {
    /// Lanes of a component, the same for result and factors.
    pub width: usize,
    /// Channels of a component.
    pub channels: usize,
    /// The components of the result that are needed.
    pub outputs: Vec<Coupled<V>>,
    /// The components of the factors with the derivatives of the result: terms of the result's cotangent (left)
    /// and the other factor (right). Set by [`Product::keep`].
    pub inputs: Vec<Coupled<V>>,
}

/// A component and the terms of its sum.
#[derive(Clone, Debug)]
pub(super) struct Coupled<V: Vector> {
    /// First lane on the tape.
    pub row: usize,
    pub terms: Vec<Term<V>>,
}

/// One coupling.
#[derive(Clone, Copy, Debug)]
pub(super) struct Term<V: Vector> {
    /// First lane of the left factor on the tape.
    pub left: u32,
    /// First lane of the right factor on the tape.
    pub right: u32,
    /// Clebsch–Gordan coefficient.
    pub coefficient: V::Number,
}

/// Lanes summed together, so that each term is decoded once for all of them.
const LANES_PER_PASS: usize = 4;

impl<V: Vector> Product<V> {
    #[inline(always)]
    pub fn forward(&self, atoms: usize, tape: &mut [V]) {
        let lanes = self.width * atoms;
        let whole = lanes / LANES_PER_PASS * LANES_PER_PASS;
        for output in &self.outputs {
            let out = output.row * atoms;
            for c in (0..whole).step_by(LANES_PER_PASS) {
                let [sums] = couple::<V, 1, LANES_PER_PASS>(&output.terms, (tape, atoms, 0), tape, atoms, c);
                tape[out + c..][..LANES_PER_PASS].copy_from_slice(&sums);
            }
            for c in whole..lanes {
                let [[sum]] = couple::<V, 1, 1>(&output.terms, (tape, atoms, 0), tape, atoms, c);
                tape[out + c] = sum;
            }
        }
    }

    /// Adds to `N` cotangents of both factors.
    #[inline(always)]
    pub fn backward<const N: usize>(&self, atoms: usize, tape: &[V], cotangent: &mut [V]) {
        let lanes = self.width * atoms;
        let whole = lanes / LANES_PER_PASS * LANES_PER_PASS;
        for input in &self.inputs {
            let out = input.row * N * atoms;
            for c in (0..whole).step_by(LANES_PER_PASS) {
                let left = (&*cotangent, N * atoms, lanes);
                let sums = couple::<V, N, LANES_PER_PASS>(&input.terms, left, tape, atoms, c);
                add::<V, N, LANES_PER_PASS>(&mut cotangent[out + c..], lanes, &sums);
            }
            for c in whole..lanes {
                let left = (&*cotangent, N * atoms, lanes);
                let sums = couple::<V, N, 1>(&input.terms, left, tape, atoms, c);
                add::<V, N, 1>(&mut cotangent[out + c..], lanes, &sums);
            }
        }
    }

    /// The derivative of the result along those of the factors: Σ C (left′ right + left right′).
    #[inline(always)]
    pub fn forward_derivative(&self, atoms: usize, tape: &[V], along: &mut [V]) {
        let lanes = self.width * atoms;
        let whole = lanes / LANES_PER_PASS * LANES_PER_PASS;
        for output in &self.outputs {
            let out = output.row * atoms;
            for c in (0..whole).step_by(LANES_PER_PASS) {
                let sums = couple_derivative::<V, LANES_PER_PASS>(&output.terms, tape, along, atoms, c);
                along[out + c..][..LANES_PER_PASS].copy_from_slice(&sums);
            }
            for c in whole..lanes {
                let [sum] = couple_derivative::<V, 1>(&output.terms, tape, along, atoms, c);
                along[out + c] = sum;
            }
        }
    }

    /// Adds to the second of two cotangents of both factors what the first contributes by the derivative of the
    /// other factor.
    #[inline(always)]
    pub fn backward_derivative(&self, atoms: usize, along: &[V], cotangent: &mut [V]) {
        let lanes = self.width * atoms;
        let whole = lanes / LANES_PER_PASS * LANES_PER_PASS;
        for input in &self.inputs {
            let out = input.row * 2 * atoms + lanes;
            for c in (0..whole).step_by(LANES_PER_PASS) {
                let left = (&*cotangent, 2 * atoms, 0);
                let sums = couple::<V, 1, LANES_PER_PASS>(&input.terms, left, along, atoms, c);
                add::<V, 1, LANES_PER_PASS>(&mut cotangent[out + c..], 0, &sums);
            }
            for c in whole..lanes {
                let left = (&*cotangent, 2 * atoms, 0);
                let sums = couple::<V, 1, 1>(&input.terms, left, along, atoms, c);
                add::<V, 1, 1>(&mut cotangent[out + c..], 0, &sums);
            }
        }
    }

    /// As [`super::tape::TapeOperation::keep`].
    pub fn keep(&mut self, needed: &mut [bool]) {
        self.outputs.retain(|output| needed[output.row]);
        for term in self.outputs.iter().flat_map(|output| &output.terms) {
            needed[term.left as usize] = true;
            needed[term.right as usize] = true;
        }
        self.inputs = self.derivatives();
    }

    /// As [`super::tape::TapeOperation::rename`].
    pub fn rename(&mut self, on_tape: impl Fn(u32) -> u32, of_cotangent: impl Fn(u32) -> u32) {
        for output in &mut self.outputs {
            output.row = on_tape(output.row as u32) as usize;
            for term in &mut output.terms {
                (term.left, term.right) = (on_tape(term.left), on_tape(term.right));
            }
        }
        for input in &mut self.inputs {
            input.row = of_cotangent(input.row as u32) as usize;
            for term in &mut input.terms {
                (term.left, term.right) = (of_cotangent(term.left), on_tape(term.right));
            }
        }
    }

    /// A product with only these results.
    pub fn with_outputs(&self, outputs: Vec<Coupled<V>>) -> Self {
        let mut product = Self { outputs, inputs: Vec::new(), ..*self };
        product.inputs = product.derivatives();
        product
    }

    /// ∂out/∂x for every component x of the factors, with one term per pair of result and other factor.
    fn derivatives(&self) -> Vec<Coupled<V>> {
        let mut inputs: BTreeMap<u32, BTreeMap<(u32, u32), f64>> = BTreeMap::new();
        for output in &self.outputs {
            for Term { left, right, coefficient } in &output.terms {
                for (x, other) in [(left, right), (right, left)] {
                    let terms = inputs.entry(*x).or_default();
                    *terms.entry((output.row as u32, *other)).or_default() += (*coefficient).into();
                }
            }
        }
        let term = |((left, right), coefficient): ((u32, u32), f64)| Term {
            left,
            right,
            coefficient: V::Number::round(coefficient),
        };
        let coupled = |(x, terms): (u32, BTreeMap<(u32, u32), f64>)| Coupled {
            row: x as usize,
            terms: terms.into_iter().map(term).collect(),
        };
        inputs.into_iter().map(coupled).collect()
    }
}

/// Σ C left_k right over some terms, for `L` lanes from lane `c` of their rows; the left factors have `slots`
/// slots, and `N` of them are `apart` lanes from each other.
#[inline(always)]
fn couple<V: Vector, const N: usize, const L: usize>(
    terms: &[Term<V>],
    (left, slots, apart): (&[V], usize, usize),
    right: &[V],
    atoms: usize,
    c: usize,
) -> [[V; L]; N] {
    let mut sums = [[V::ZERO; L]; N];
    for term in terms {
        let right = &right[term.right as usize * atoms + c..][..L];
        let right: [V; L] = std::array::from_fn(|l| right[l].scaled(term.coefficient));
        for (k, sums) in sums.iter_mut().enumerate() {
            let left = &left[term.left as usize * slots + k * apart + c..][..L];
            for l in 0..L {
                sums[l].add_product(&left[l], &right[l]);
            }
        }
    }
    sums
}

/// Σ C (left′ right + left right′) over some terms, for `L` lanes from lane `c` of their rows.
#[inline(always)]
fn couple_derivative<V: Vector, const L: usize>(
    terms: &[Term<V>],
    tape: &[V],
    along: &[V],
    atoms: usize,
    c: usize,
) -> [V; L] {
    let mut sums = [V::ZERO; L];
    for term in terms {
        let (left, right) = (term.left as usize * atoms + c, term.right as usize * atoms + c);
        for (l, sum) in sums.iter_mut().enumerate() {
            let mut both = along[left + l].product(&tape[right + l]);
            both.add_product(&tape[left + l], &along[right + l]);
            sum.add_scaled(term.coefficient, &both);
        }
    }
    sums
}

/// Adds sums to `N` rows that are `apart` lanes from each other.
#[inline(always)]
fn add<V: Vector, const N: usize, const L: usize>(rows: &mut [V], apart: usize, sums: &[[V; L]; N]) {
    for (k, sums) in sums.iter().enumerate() {
        for (out, sum) in rows[k * apart..][..L].iter_mut().zip(sums) {
            out.add(sum);
        }
    }
}

/// out_n,f = Σ_c C_c x_n,r(c), summed over the terms c of f.
#[derive(Clone, Debug)]
pub(super) struct Combination<V: Vector> {
    /// Lanes of a component.
    width: usize,
    /// Channels of a component.
    pub channels: usize,
    /// The components that are needed.
    pub outputs: Vec<Combined<V>>,
    /// The same on the cotangents' tape; set by [`Combination::rename`].
    cotangents: Vec<Combined<V>>,
}

/// First lane of a component, and first lane and factor of each of its terms.
pub(super) type Combined<V> = (u32, Vec<(u32, <V as Vector>::Number)>);

impl<V: Vector> Combination<V> {
    /// From components with these lanes and channels.
    pub fn new(width: usize, channels: usize, outputs: Vec<Combined<V>>) -> Self {
        Self { width, channels, outputs, cotangents: Vec::new() }
    }

    #[inline(always)]
    pub fn forward(&self, slots: usize, tape: &mut [V]) {
        for (row, terms) in &self.outputs {
            let out = *row as usize * slots;
            for c in 0..self.width * slots {
                let mut sum = V::ZERO;
                for (from, coefficient) in terms {
                    sum.add_scaled(*coefficient, &tape[*from as usize * slots + c]);
                }
                tape[out + c] = sum;
            }
        }
    }

    /// Adds to the cotangents of the inputs.
    #[inline(always)]
    pub fn backward(&self, slots: usize, cotangent: &mut [V]) {
        for (row, terms) in &self.cotangents {
            let out = *row as usize * slots;
            for c in 0..self.width * slots {
                let of_sum = cotangent[out + c];
                for (from, coefficient) in terms {
                    cotangent[*from as usize * slots + c].add_scaled(*coefficient, &of_sum);
                }
            }
        }
    }

    /// As [`super::tape::TapeOperation::keep`].
    pub fn keep(&mut self, needed: &mut [bool]) {
        self.outputs.retain(|(row, _)| needed[*row as usize]);
        for (from, _) in self.outputs.iter().flat_map(|(_, terms)| terms) {
            needed[*from as usize] = true;
        }
    }

    /// As [`super::tape::TapeOperation::rename`].
    pub fn rename(&mut self, on_tape: impl Fn(u32) -> u32, of_cotangent: impl Fn(u32) -> u32) {
        self.cotangents = renamed::<V>(&self.outputs, of_cotangent);
        self.outputs = renamed::<V>(&self.outputs, on_tape);
    }
}

fn renamed<V: Vector>(outputs: &[Combined<V>], name: impl Fn(u32) -> u32) -> Vec<Combined<V>> {
    let terms =
        |terms: &[(u32, V::Number)]| terms.iter().map(|(row, factor)| (name(*row), *factor)).collect();
    outputs.iter().map(|(row, summed)| (name(*row), terms(summed))).collect()
}
