//! Rules about the largest grade of a structure.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Positive, UpdateGoal};

/// γ_max above a threshold (paper, aluminium and silicon: 1.5).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MaximumGrade {
    /// The threshold.
    #[serde(default = "threshold")]
    pub threshold: Positive,
}

/// The smallest α with γ_max below the target. If there is none: the last α, followed by a bounded inflation (paper,
/// aluminium and silicon).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MaximumGradeUpdate {
    /// Update target (paper: 1.25).
    #[serde(default = "super::update_target")]
    pub target: Positive,
}

impl MaximumGrade {
    pub(super) const NAME: &str = "maximum_grade";

    pub(super) fn description(&self) -> String {
        format!("the largest γ of its atoms is above {}", self.threshold.0)
    }

    pub(super) fn condition(&self) -> String {
        format!("{}: γ_max > {}", Self::NAME, self.threshold.0)
    }
}

impl MaximumGradeUpdate {
    pub(super) fn goal(&self) -> UpdateGoal {
        UpdateGoal { threshold: self.target.0, limit: None, target: self.target.0 }
    }

    pub(super) fn condition(&self) -> String {
        format!("{}: γ_max below {}", MaximumGrade::NAME, self.target.0)
    }
}

fn threshold() -> Positive {
    Positive(1.5)
}
