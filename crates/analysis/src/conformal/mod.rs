//! Upper bounds of errors by the grade of an atom, told with how often they held: a rolling conformal map.
//!
//! Atoms of one structure are correlated, so structures are the units. Within a bin of the grade each structure has
//! weight one, which its atoms in the bin share equally. The bound is the quantile of the pooled distribution at
//! level q (1 + 1/n) for n structures (pooled CDFs of Dunn, Wasserman & Ramdas, J. Am. Stat. Assoc. 118, 2491 (2023);
//! at this level it holds for finite n: Lee, Barber & Willett, arXiv:2306.06342). Collection changes the distribution
//! while labels arrive, so q is corrected after each structure (adaptive conformal inference, Gibbs & Candès, NeurIPS 2021).

mod map;
#[cfg(test)]
mod tests;
mod window;

pub use map::{ConformalMap, GradedError, RollingCoverage};
pub use window::ConformalWindow;

/// What a conformal map promises and from how much it learns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConformalSettings {
    /// Share of errors that are to be below the bound, between 0 and 1.
    pub level: f64,
    /// Fewest structures of a bin with a bound. No bound is finite with fewer than level / (1 − level).
    pub least: usize,
    /// Largest number of structures of a bin: the newest.
    pub window: usize,
    /// Step size of the correction: change of the level in force when all atoms of a structure are above their bound and
    /// the level is 1. With 0 there is no correction.
    pub step: f64,
    /// Number of structures over which coverage is counted: the newest.
    pub counted: usize,
}

impl ConformalSettings {
    /// Fewest structures of a bin with a bound.
    pub fn least(&self) -> usize {
        let finite = (self.level / (1.0 - self.level) - 1e-9).ceil();
        self.least.max(finite as usize).max(1)
    }
}
