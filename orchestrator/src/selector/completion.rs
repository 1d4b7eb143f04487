//! Declines candidates whose labels would probably fail.

use calm::grade::maximum;
use serde_json::{Value, json};
use wire::{CompletionCoefficients, CompletionPredictors};

use super::regrade::RegradedCandidate;

/// Probabilities are rounded to this number of parts, so that they are the same numbers when they are read from the log.
const PARTS: f64 = 1e6;

/// The rule by which candidates are declined, and where their probabilities come from.
#[derive(Clone, Debug)]
pub struct CompletionRule {
    /// Candidates with a smaller probability are declined.
    pub min_probability: f64,
    /// The model, or the probability that the log has of the next candidate. `None`: nothing is known, and nothing is
    /// declined.
    pub source: Option<ProbabilitySource>,
}

/// Where the probability of a candidate comes from.
#[derive(Clone, Debug)]
pub enum ProbabilitySource {
    /// A model that was learned from finished labels.
    Model(CompletionCoefficients),
    /// The decision log, in a replay.
    Log(f64),
}

/// The probability that the label of a candidate completes, and the smallest that is accepted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CompletionCheck {
    /// Probability, rounded.
    pub probability: f64,
    /// See [`CompletionRule::min_probability`].
    pub min_probability: f64,
}

impl CompletionRule {
    /// Judges a candidate; `None` if nothing is known that distinguishes candidates. By one probability for all, a share below the
    /// limit would decline every candidate, and nothing would be learned any more.
    pub fn check(&self, graded: &RegradedCandidate) -> Option<CompletionCheck> {
        let probability = match self.source.as_ref()? {
            ProbabilitySource::Log(probability) => *probability,
            ProbabilitySource::Model(coefficients) if coefficients.is_constant() => return None,
            ProbabilitySource::Model(coefficients) => coefficients.probability(&predictors(graded)?),
        };
        let probability = (probability * PARTS).round() / PARTS;
        Some(CompletionCheck { probability, min_probability: self.min_probability })
    }

    /// The rule that a decision of the log had; `None` without one.
    pub fn from_decision(detail: &Value) -> Option<Self> {
        let found = detail.get("completion")?;
        let source = ProbabilitySource::Log(found.get("probability")?.as_f64()?);
        Some(Self { min_probability: found.get("min_probability")?.as_f64()?, source: Some(source) })
    }
}

impl CompletionCheck {
    /// Whether the candidate is declined.
    pub fn declines(&self) -> bool {
        self.probability < self.min_probability
    }

    /// What the decision log has of it.
    pub fn in_decision(&self) -> Value {
        json!({ "probability": self.probability, "min_probability": self.min_probability })
    }
}

/// As the model's examples have them. The grade is that of the original mixture, which does not move while labels are made.
fn predictors(graded: &RegradedCandidate) -> Option<CompletionPredictors> {
    let view = graded.block.view();
    let gamma = maximum(&graded.original.gamma);
    CompletionPredictors::of_structure(&view.structure(), gamma, Some(view.relative_volume())).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_itself_is_probable_enough() {
        for (probability, declines) in [(0.49, true), (0.5, false), (0.51, false)] {
            assert_eq!(CompletionCheck { probability, min_probability: 0.5 }.declines(), declines);
        }
    }
}
