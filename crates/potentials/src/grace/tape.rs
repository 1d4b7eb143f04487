//! The equivariant tensors of one atom, and the operations that make one from others.
//!
//! All tensors of an atom stand behind one another on a tape, each \[component\]\[channel\]. An operation
//! reads rows that stand before its result. Cotangents stand on a second tape of the same layout, which
//! the operations walk backwards.

use super::matrix::{Lanes, Matrix, ZERO, add_product, add_scaled, scaled};

/// Where a tensor stands on the tape.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tensor {
    /// First lane.
    pub start: usize,
    /// Number of angular components.
    pub components: usize,
    /// Number of channels without padding.
    pub channels: usize,
    /// Lanes of one component.
    pub width: usize,
}

impl Tensor {
    /// First lane of a component.
    pub fn row(&self, component: usize) -> usize {
        self.start + component * self.width
    }

    /// One lane past the tensor.
    pub fn end(&self) -> usize {
        self.start + self.components * self.width
    }
}

/// One step along the tape.
#[derive(Clone, Debug)]
pub(super) enum Operation {
    /// Channels mixed with weights.
    Linear(Linear),
    /// Components coupled, channel by channel.
    Product(Product),
}

impl Operation {
    #[inline(always)]
    pub fn forward(&self, tape: &mut [Lanes]) {
        match self {
            Self::Linear(linear) => linear.forward(tape),
            Self::Product(product) => product.forward(tape),
        }
    }

    /// Adds to the cotangents of what it read.
    #[inline(always)]
    pub fn backward(&self, tape: &[Lanes], cotangent: &mut [Lanes]) {
        match self {
            Self::Linear(linear) => linear.backward(cotangent),
            Self::Product(product) => product.backward(tape, cotangent),
        }
    }

    /// Drops every result that nobody needs, and marks as needed what the others read;
    /// `needed` says it for each lane of the tape at which a row begins.
    pub fn keep(&mut self, needed: &mut [bool]) {
        match self {
            Self::Linear(linear) => linear.keep(needed),
            Self::Product(product) => product.keep(needed),
        }
    }
}

/// out_k,w = Σ over parts, Σ_n W_kn x_n,w′.
#[derive(Clone, Debug)]
pub(super) struct Linear {
    /// First lane of the result.
    pub start: usize,
    /// Rows that share weights.
    pub parts: Vec<LinearPart>,
}

/// Rows of one or more tensors multiplied by the same weights.
#[derive(Clone, Debug)]
pub(super) struct LinearPart {
    /// [n_in × n_out]
    pub weights: Matrix,
    /// [n_out × n_in]
    pub transposed: Matrix,
    /// Where each row is read, lanes from the beginning of the tape.
    pub from: Vec<u32>,
    /// Where each is added, lanes from the beginning of the result.
    pub to: Vec<u32>,
}

impl Linear {
    #[inline(always)]
    fn forward(&self, tape: &mut [Lanes]) {
        let (before, out) = tape.split_at_mut(self.start);
        for part in &self.parts {
            part.weights.multiply_add(before, &part.from, out, &part.to);
        }
    }

    #[inline(always)]
    fn backward(&self, cotangent: &mut [Lanes]) {
        let (before, out) = cotangent.split_at_mut(self.start);
        for part in &self.parts {
            part.transposed.multiply_add(out, &part.to, before, &part.from);
        }
    }

    fn keep(&mut self, needed: &mut [bool]) {
        for part in &mut self.parts {
            let rows = part.from.iter().zip(&part.to);
            let kept: Vec<(u32, u32)> =
                rows.map(|(f, t)| (*f, *t)).filter(|(_, to)| needed[self.start + *to as usize]).collect();
            kept.iter().for_each(|(from, _)| needed[*from as usize] = true);
            (part.from, part.to) = kept.into_iter().unzip();
        }
        self.parts.retain(|part| !part.from.is_empty());
    }
}

/// out_n,f = Σ_c C_c left_n,l(c) right_n,r(c), the sum over the terms c of f.
#[derive(Clone, Debug)]
pub(super) struct Product {
    /// First lane of the result.
    pub start: usize,
    /// Lanes of a component, the same for result and factors.
    pub width: usize,
    /// Each component of the result that is needed.
    pub outputs: Vec<ProductOutput>,
}

/// One component of a product.
#[derive(Clone, Debug)]
pub(super) struct ProductOutput {
    /// First lane on the tape.
    pub row: usize,
    /// What it sums.
    pub terms: Vec<Term>,
}

/// One coupling.
#[derive(Clone, Copy, Debug)]
pub(super) struct Term {
    /// First lane of the left factor on the tape.
    pub left: u32,
    /// First lane of the right factor on the tape.
    pub right: u32,
    /// Clebsch–Gordan coefficient.
    pub coefficient: f64,
}

impl Product {
    #[inline(always)]
    fn forward(&self, tape: &mut [Lanes]) {
        let (before, out) = tape.split_at_mut(self.start);
        for output in &self.outputs {
            for (c, out) in out[output.row - self.start..][..self.width].iter_mut().enumerate() {
                let mut sum = ZERO;
                for term in &output.terms {
                    let left = scaled(term.coefficient, &before[term.left as usize + c]);
                    add_product(&mut sum, &left, &before[term.right as usize + c]);
                }
                *out = sum;
            }
        }
    }

    #[inline(always)]
    fn backward(&self, tape: &[Lanes], cotangent: &mut [Lanes]) {
        let (before, out) = cotangent.split_at_mut(self.start);
        for output in &self.outputs {
            for (c, out) in out[output.row - self.start..][..self.width].iter().enumerate() {
                for term in &output.terms {
                    let (left, right) = (term.left as usize + c, term.right as usize + c);
                    let cotangent = scaled(term.coefficient, out);
                    add_product(&mut before[left], &cotangent, &tape[right]);
                    add_product(&mut before[right], &cotangent, &tape[left]);
                }
            }
        }
    }

    fn keep(&mut self, needed: &mut [bool]) {
        self.outputs.retain(|output| needed[output.row]);
        for term in self.outputs.iter().flat_map(|output| &output.terms) {
            needed[term.left as usize] = true;
            needed[term.right as usize] = true;
        }
    }
}

/// The rows of the tape that the energy and the features are made of, one after another.
#[derive(Clone, Debug, Default)]
pub(super) struct Gather {
    /// First lane and number of lanes of each row.
    pub rows: Vec<(usize, usize)>,
}

impl Gather {
    /// Lanes of all rows together.
    pub fn lanes(&self) -> usize {
        self.rows.iter().map(|(_, width)| width).sum()
    }

    #[inline(always)]
    pub fn forward(&self, tape: &[Lanes], out: &mut [Lanes]) {
        let mut position = 0;
        for (row, width) in &self.rows {
            out[position..position + width].copy_from_slice(&tape[*row..row + width]);
            position += width;
        }
    }

    /// Adds to the cotangents of the rows.
    #[inline(always)]
    pub fn backward(&self, out: &[Lanes], cotangent: &mut [Lanes]) {
        let mut position = 0;
        for (row, width) in &self.rows {
            for (sum, x) in cotangent[*row..row + width].iter_mut().zip(&out[position..]) {
                add_scaled(sum, 1.0, x);
            }
            position += width;
        }
    }
}
