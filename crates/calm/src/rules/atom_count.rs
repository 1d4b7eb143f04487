//! Rules about the number of atoms above a threshold.

use std::num::NonZeroUsize;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Fraction, Positive, UpdateGoal};

/// At least max[`min_atoms`, ⌈`fraction` N⌉] of the N atoms above a threshold (paper, foundation model).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AtomCount {
    /// Grade above which an atom counts (paper: 1.3).
    #[serde(default = "threshold")]
    pub threshold: Positive,
    /// Fraction of the atoms (paper: 0.15).
    #[serde(default = "fraction")]
    pub fraction: Fraction,
    /// Minimum number of atoms (paper: 3).
    #[serde(default = "min_atoms")]
    pub min_atoms: NonZeroUsize,
}

/// The smallest α that leaves fewer than max[`min_atoms`, ⌈`fraction` N⌉] atoms above the threshold; if there is none,
/// the smallest with γ_max below the target; otherwise the last (paper, foundation model).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AtomCountUpdate {
    /// Grade above which an atom counts (paper: 1.3).
    #[serde(default = "threshold")]
    pub threshold: Positive,
    /// Fraction of the atoms (paper: 0.15).
    #[serde(default = "fraction")]
    pub fraction: Fraction,
    /// Minimum number of atoms (paper: 3).
    #[serde(default = "min_atoms")]
    pub min_atoms: NonZeroUsize,
    /// Target of the fallback (paper: 1.25).
    #[serde(default = "super::update_target")]
    pub target: Positive,
}

impl AtomCount {
    pub(super) const NAME: &str = "atom_count";

    pub(super) fn needed_atoms(&self, atoms: usize) -> usize {
        atom_limit(atoms, self.fraction, self.min_atoms)
    }

    pub(super) fn too_small(&self, atoms: usize) -> Option<(usize, &'static str)> {
        (self.min_atoms.get() > atoms).then_some((self.min_atoms.get(), "min_atoms"))
    }

    pub(super) fn description(&self) -> String {
        let Self { threshold, fraction, min_atoms } = self;
        format!("at least max({min_atoms}, ⌈{} N⌉) of its N atoms have γ above {}", fraction.0, threshold.0)
    }

    pub(super) fn condition(&self, atoms: usize) -> String {
        format!(
            "{}: at least {} atoms with γ > {} (the larger of {} and {} % of {atoms})",
            Self::NAME,
            self.needed_atoms(atoms),
            self.threshold.0,
            self.min_atoms,
            100.0 * self.fraction.0
        )
    }
}

impl AtomCountUpdate {
    pub(super) fn goal(&self, atoms: usize) -> UpdateGoal {
        let limit = atom_limit(atoms, self.fraction, self.min_atoms);
        UpdateGoal { threshold: self.threshold.0, limit: Some(limit), target: self.target.0 }
    }

    pub(super) fn condition(&self, atoms: usize) -> String {
        let limit = atom_limit(atoms, self.fraction, self.min_atoms);
        format!(
            "{}: fewer than {limit} atoms with γ > {}, else γ_max below {}",
            AtomCount::NAME,
            self.threshold.0,
            self.target.0
        )
    }
}

/// max[min_atoms, ⌈fraction · atoms⌉]; products that are integers up to rounding count as integers.
fn atom_limit(atoms: usize, fraction: Fraction, min_atoms: NonZeroUsize) -> usize {
    let share = (fraction.0 * atoms as f64 * (1.0 - 1e-12)).ceil() as usize;
    share.max(min_atoms.get())
}

fn threshold() -> Positive {
    Positive(1.3)
}

fn fraction() -> Fraction {
    Fraction(0.15)
}

fn min_atoms() -> NonZeroUsize {
    NonZeroUsize::MIN.saturating_add(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whole_share_is_not_rounded_up() {
        for percent in 1..=100_usize {
            let fraction = Fraction::try_from(percent as f64 / 100.0).unwrap();
            for atoms in 1..400 {
                let exact = (percent * atoms).div_ceil(100);
                let found = atom_limit(atoms, fraction, NonZeroUsize::MIN);
                assert_eq!(found, exact.max(1), "{percent} % of {atoms}");
            }
        }
    }
}
