//! Tensors coupled channel by channel, and rows of one tensor combined.

use super::matrix::{Lanes, ZERO, add_product, add_scaled, scaled};

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
    pub fn forward(&self, tape: &mut [Lanes]) {
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

    /// Adds to the cotangents of both factors.
    #[inline(always)]
    pub fn backward(&self, tape: &[Lanes], cotangent: &mut [Lanes]) {
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

    /// As [`super::tape::Operation::keep`].
    pub fn keep(&mut self, needed: &mut [bool]) {
        self.outputs.retain(|output| needed[output.row]);
        for term in self.outputs.iter().flat_map(|output| &output.terms) {
            needed[term.left as usize] = true;
            needed[term.right as usize] = true;
        }
    }
}

/// out_n,f = Σ_c C_c x_n,r(c), the sum over the terms c of f.
#[derive(Clone, Debug)]
pub(super) struct Combination {
    /// First lane of the result.
    pub start: usize,
    /// Lanes of a component.
    pub width: usize,
    /// For each component that is needed its first lane, and the first lane and factor of what it sums.
    pub outputs: Vec<(usize, Vec<(u32, f64)>)>,
}

impl Combination {
    #[inline(always)]
    pub fn forward(&self, tape: &mut [Lanes]) {
        let (before, out) = tape.split_at_mut(self.start);
        for (row, terms) in &self.outputs {
            for (c, out) in out[row - self.start..][..self.width].iter_mut().enumerate() {
                let mut sum = ZERO;
                for (from, coefficient) in terms {
                    add_scaled(&mut sum, *coefficient, &before[*from as usize + c]);
                }
                *out = sum;
            }
        }
    }

    /// Adds to the cotangents of what it read.
    #[inline(always)]
    pub fn backward(&self, cotangent: &mut [Lanes]) {
        let (before, out) = cotangent.split_at_mut(self.start);
        for (row, terms) in &self.outputs {
            for (c, out) in out[row - self.start..][..self.width].iter().enumerate() {
                for (from, coefficient) in terms {
                    add_scaled(&mut before[*from as usize + c], *coefficient, out);
                }
            }
        }
    }

    /// As [`super::tape::Operation::keep`].
    pub fn keep(&mut self, needed: &mut [bool]) {
        self.outputs.retain(|(row, _)| needed[*row]);
        for (from, _) in self.outputs.iter().flat_map(|(_, terms)| terms) {
            needed[*from as usize] = true;
        }
    }
}
