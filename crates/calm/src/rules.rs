//! Rules for collecting a structure and for ending an update of the mixture.

use std::num::NonZeroUsize;

use serde::{Deserialize, Serialize};

use crate::grade::maximum;
use crate::update::CovarianceUpdate;

/// A finite number above zero.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct Positive(f64);

/// A number above 0 and at most 1.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(try_from = "f64", into = "f64")]
pub struct Fraction(f64);

/// The values of α to try: ascending, each above 0 and at most 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Vec<f64>", into = "Vec<f64>")]
pub struct AlphaValues(Vec<f64>);

/// A setting out of range.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RuleError {
    /// Not a positive number.
    #[error("found {0}, expected a finite number above 0")]
    NotPositive(f64),
    /// Not a fraction.
    #[error("found {0}, expected a number above 0 and not above 1")]
    NotFraction(f64),
    /// Not a valid list of α.
    #[error("found α = {0:?}, expected at least one value, ascending, each above 0 and not above 1")]
    NotLadder(Vec<f64>),
}

impl Positive {
    /// The number itself.
    pub fn get(self) -> f64 {
        self.0
    }
}

impl Fraction {
    pub(crate) const FIFTH: Self = Self(0.2);

    /// The number itself.
    pub fn get(self) -> f64 {
        self.0
    }
}

impl AlphaValues {
    /// The values, ascending.
    pub fn values(&self) -> &[f64] {
        &self.0
    }
}

impl TryFrom<f64> for Positive {
    type Error = RuleError;
    fn try_from(found: f64) -> Result<Self, RuleError> {
        if found.is_finite() && found > 0.0 { Ok(Self(found)) } else { Err(RuleError::NotPositive(found)) }
    }
}

impl TryFrom<f64> for Fraction {
    type Error = RuleError;
    fn try_from(found: f64) -> Result<Self, RuleError> {
        if found > 0.0 && found <= 1.0 { Ok(Self(found)) } else { Err(RuleError::NotFraction(found)) }
    }
}

impl TryFrom<Vec<f64>> for AlphaValues {
    type Error = RuleError;
    fn try_from(found: Vec<f64>) -> Result<Self, RuleError> {
        let within = found.iter().all(|&alpha| alpha > 0.0 && alpha <= 1.0);
        if !found.is_empty() && within && found.is_sorted_by(|a, b| a < b) {
            Ok(Self(found))
        } else {
            Err(RuleError::NotLadder(found))
        }
    }
}

impl From<Positive> for f64 {
    fn from(number: Positive) -> f64 {
        number.0
    }
}

impl From<Fraction> for f64 {
    fn from(number: Fraction) -> f64 {
        number.0
    }
}

impl From<AlphaValues> for Vec<f64> {
    fn from(values: AlphaValues) -> Vec<f64> {
        values.0
    }
}

/// When a structure becomes a candidate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "rule", rename_all = "snake_case", deny_unknown_fields)]
pub enum CollectionRule {
    /// γ_max above a threshold (paper, aluminium and silicon: 1.5).
    MaximumGrade {
        /// The threshold.
        #[serde(default = "collection_threshold")]
        threshold: Positive,
    },
    /// At least max[`min_atoms`, ⌈`fraction` N⌉] of the N atoms above a threshold (paper, foundation model).
    AtomCount {
        /// Grade above which an atom counts (paper: 1.3).
        #[serde(default = "atom_threshold")]
        threshold: Positive,
        /// Fraction of the atoms (paper: 0.15).
        #[serde(default = "atom_fraction")]
        fraction: Fraction,
        /// Minimum number of atoms (paper: 3).
        #[serde(default = "atom_least")]
        min_atoms: NonZeroUsize,
    },
}

/// How α is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "rule", rename_all = "snake_case", deny_unknown_fields)]
pub enum UpdateRule {
    /// The smallest α with γ_max below the target. If there is none: the last α, followed by a bounded
    /// inflation (paper, aluminium and silicon).
    MaximumGrade {
        /// Update target (paper: 1.25).
        #[serde(default = "update_target")]
        target: Positive,
    },
    /// The smallest α that leaves fewer than max[`min_atoms`, ⌈`fraction` N⌉] atoms above the threshold; if there
    /// is none, the smallest with γ_max below the target; otherwise the last (paper, foundation model).
    AtomCount {
        /// Grade above which an atom counts (paper: 1.3).
        #[serde(default = "atom_threshold")]
        threshold: Positive,
        /// Fraction of the atoms (paper: 0.15).
        #[serde(default = "atom_fraction")]
        fraction: Fraction,
        /// Minimum number of atoms (paper: 3).
        #[serde(default = "atom_least")]
        min_atoms: NonZeroUsize,
        /// Target of the fallback (paper: 1.25).
        #[serde(default = "update_target")]
        target: Positive,
    },
}

/// How the old covariance and that of the batch are combined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CovarianceUpdateKind {
    /// (1 − α) C + α C_batch (paper).
    #[default]
    Convex,
    /// C + α C_batch; forgets nothing.
    Additive,
}

impl CovarianceUpdateKind {
    /// The update of this kind with the weight α.
    pub fn with_alpha(self, alpha: f64) -> CovarianceUpdate {
        match self {
            Self::Convex => CovarianceUpdate::Convex { alpha },
            Self::Additive => CovarianceUpdate::Additive { alpha },
        }
    }

    /// The default values of α.
    ///
    /// Convex: the six of the paper. Additive: from 0.0005 to 1 in steps of about two (1, 2, 5 per decade).
    /// Without the factor 1 − α a very small α can suffice, and a larger one than needed covers too much.
    pub fn default_alphas(self) -> AlphaValues {
        AlphaValues(match self {
            Self::Convex => vec![0.05, 0.1, 0.2, 0.4, 0.7, 1.0],
            Self::Additive => vec![0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0],
        })
    }
}

/// How the mixture is updated after a structure was collected.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UpdateSettings {
    /// Convex or additive.
    #[serde(default)]
    pub covariance_update: CovarianceUpdateKind,
    /// The α to try. Default: [`CovarianceUpdateKind::default_alphas`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub alpha_values: Option<AlphaValues>,
    /// How α is chosen.
    pub stop: UpdateRule,
}

impl UpdateSettings {
    /// The values of α to try, ascending.
    pub fn alphas(&self) -> Vec<f64> {
        self.alpha_values.clone().unwrap_or_else(|| self.covariance_update.default_alphas()).into()
    }
}

impl CollectionRule {
    /// The grade above which a structure, or an atom of it, counts.
    pub fn threshold(&self) -> f64 {
        match *self {
            Self::MaximumGrade { threshold } | Self::AtomCount { threshold, .. } => threshold.0,
        }
    }

    /// The same rule with its threshold multiplied by `factor`, which must be finite and positive.
    pub fn with_threshold_factor(mut self, factor: f64) -> Self {
        match &mut self {
            Self::MaximumGrade { threshold } | Self::AtomCount { threshold, .. } => threshold.0 *= factor,
        }
        self
    }

    /// Whether a structure with these grades, `[atoms]`, meets the rule.
    pub fn is_met(&self, gamma: &[f64]) -> bool {
        match *self {
            Self::MaximumGrade { threshold } => maximum(gamma) > threshold.0,
            Self::AtomCount { threshold, fraction, min_atoms } => {
                count_above(gamma, threshold.0) >= atom_limit(gamma.len(), fraction, min_atoms)
            }
        }
    }
}

/// Number of atoms with γ above a threshold.
pub fn count_above(gamma: &[f64], threshold: f64) -> usize {
    gamma.iter().filter(|&&grade| grade > threshold).count()
}

/// max[min_atoms, ⌈fraction · atoms⌉]; products that are integers up to rounding count as integers.
pub fn atom_limit(atoms: usize, fraction: Fraction, min_atoms: NonZeroUsize) -> usize {
    let share = (fraction.0 * atoms as f64 * (1.0 - 1e-12)).ceil() as usize;
    share.max(min_atoms.get())
}

fn collection_threshold() -> Positive {
    Positive(1.5)
}

fn atom_threshold() -> Positive {
    Positive(1.3)
}

fn atom_fraction() -> Fraction {
    Fraction(0.15)
}

fn atom_least() -> NonZeroUsize {
    NonZeroUsize::MIN.saturating_add(2)
}

fn update_target() -> Positive {
    Positive(1.25)
}
