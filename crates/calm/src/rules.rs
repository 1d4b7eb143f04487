//! Rules for collecting a structure and for ending an update of the mixture. Each kind of rule has its own file.

mod atom_count;
mod maximum_grade;
mod numbers;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use self::atom_count::{AtomCount, AtomCountUpdate};
pub use self::maximum_grade::{MaximumGrade, MaximumGradeUpdate};
pub use self::numbers::{AlphaValues, Fraction, Positive, RuleError};
use crate::update::CovarianceUpdate;

/// When a structure becomes a candidate: enough of its atoms have a grade above a threshold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "rule", rename_all = "snake_case")]
pub enum CollectionRule {
    /// γ_max above a threshold.
    MaximumGrade(MaximumGrade),
    /// Enough atoms above a threshold.
    AtomCount(AtomCount),
}

/// How α is chosen.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "rule", rename_all = "snake_case")]
pub enum UpdateRule {
    /// γ_max below a target.
    MaximumGrade(MaximumGradeUpdate),
    /// Few enough atoms above a threshold.
    AtomCount(AtomCountUpdate),
}

/// What the search for α aims at in one structure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpdateGoal {
    /// Grade above which an atom counts.
    pub threshold: f64,
    /// Number of counted atoms below which the search ends. `None`: it ends when γ_max is below `target`, if need be
    /// after an inflation.
    pub limit: Option<usize>,
    /// Target of γ_max.
    pub target: f64,
}

impl CollectionRule {
    /// The grade above which a structure, or an atom of it, counts.
    pub fn threshold(&self) -> f64 {
        match self {
            Self::MaximumGrade(rule) => rule.threshold.0,
            Self::AtomCount(rule) => rule.threshold.0,
        }
    }

    /// The same rule with its threshold multiplied by `factor`, which must be finite and positive.
    pub fn with_threshold_factor(mut self, factor: f64) -> Self {
        let threshold = match &mut self {
            Self::MaximumGrade(rule) => &mut rule.threshold,
            Self::AtomCount(rule) => &mut rule.threshold,
        };
        threshold.0 *= factor;
        self
    }

    /// Number of atoms that must be above the threshold in a structure of `atoms` atoms.
    pub fn needed_atoms(&self, atoms: usize) -> usize {
        match self {
            Self::MaximumGrade(_) => 1,
            Self::AtomCount(rule) => rule.needed_atoms(atoms),
        }
    }

    /// If a structure of `atoms` atoms is too small to ever meet the rule: the number of atoms that the rule requires, and
    /// the key of that setting.
    pub fn too_small(&self, atoms: usize) -> Option<(usize, &'static str)> {
        match self {
            Self::MaximumGrade(_) => None,
            Self::AtomCount(rule) => rule.too_small(atoms),
        }
    }

    /// Whether a structure with these grades, `[atoms]`, meets the rule.
    pub fn is_met(&self, gamma: &[f64]) -> bool {
        count_above(gamma, self.threshold()) >= self.needed_atoms(gamma.len())
    }

    /// The rule as the end of a sentence about a structure.
    pub fn description(&self) -> String {
        match self {
            Self::MaximumGrade(rule) => rule.description(),
            Self::AtomCount(rule) => rule.description(),
        }
    }

    /// Name and condition of the rule for a structure of `atoms` atoms, in short.
    pub fn condition(&self, atoms: usize) -> String {
        match self {
            Self::MaximumGrade(rule) => rule.condition(),
            Self::AtomCount(rule) => rule.condition(atoms),
        }
    }
}

impl UpdateRule {
    /// Whether a structure of `atoms` atoms for which an update met this rule no longer meets `collection`. Otherwise
    /// its walk would offer it again and again.
    pub fn ends_candidacy(&self, collection: &CollectionRule, atoms: usize) -> bool {
        let UpdateGoal { threshold, limit, target } = self.goal(atoms);
        match limit {
            Some(limit) => threshold <= collection.threshold() && limit <= collection.needed_atoms(atoms),
            None => target <= collection.threshold(),
        }
    }

    /// What the search aims at in a structure of `atoms` atoms.
    pub fn goal(&self, atoms: usize) -> UpdateGoal {
        match self {
            Self::MaximumGrade(rule) => rule.goal(),
            Self::AtomCount(rule) => rule.goal(atoms),
        }
    }

    /// Name and condition of the rule for a structure of `atoms` atoms, in short.
    pub fn condition(&self, atoms: usize) -> String {
        match self {
            Self::MaximumGrade(rule) => rule.condition(),
            Self::AtomCount(rule) => rule.condition(atoms),
        }
    }
}

/// How the old covariance and that of the batch are combined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
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

/// Number of atoms with γ above a threshold.
pub fn count_above(gamma: &[f64], threshold: f64) -> usize {
    gamma.iter().filter(|&&grade| grade > threshold).count()
}

fn update_target() -> Positive {
    Positive(1.25)
}
