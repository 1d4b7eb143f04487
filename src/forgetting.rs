//! The alarm for a mixture that forgets its training data.

use calm::rules::CovarianceUpdateKind;

use crate::config::CalmSection;

/// The alarm is cleared below this fraction of the limit, so that it does not toggle with every decision.
const HYSTERESIS: f64 = 0.9;

/// Limit and texts of the alarm.
#[derive(Clone, Copy, Debug)]
pub struct ForgettingRule {
    /// Share of the training atoms above which the alarm is raised.
    limit: f64,
    covariance_update: CovarianceUpdateKind,
}

/// State of the alarm in a run.
#[derive(Clone, Debug)]
pub struct AlarmState {
    forgetting: ForgettingRule,
    raised: bool,
}

impl ForgettingRule {
    /// Reads the section `[calm]`.
    pub fn new(calm: &CalmSection) -> Self {
        Self { limit: calm.forgetting_alarm.get(), covariance_update: calm.covariance_update }
    }

    /// Whether the alarm holds for this share of training atoms with γ > 1. `raised` is the selector's own check.
    /// `None` if the alarm stays as it was.
    pub fn evaluate(&self, share: f64, raised: bool) -> Option<bool> {
        (raised || share < HYSTERESIS * self.limit).then_some(raised)
    }

    /// Message when the alarm is raised, with advice.
    pub fn raised_message(&self, share: f64) -> String {
        let other = match self.covariance_update {
            CovarianceUpdateKind::Convex => {
                "covariance_update = \"additive\", which forgets nothing, or with smaller values in calm.alpha_values"
            }
            CovarianceUpdateKind::Additive => "smaller values in calm.alpha_values",
        };
        format!(
            "the mixture forgets its training data: {:.1} % of the training atoms have γ > 1 (calm.forgetting_alarm: {:.1} %), \
             so that walks may collect structures that the potential knows. The campaign continues. To avoid this, start another \
             one with {other} in [calm]; to accept it, raise calm.forgetting_alarm (docs/configuration.md)",
            100.0 * share,
            100.0 * self.limit
        )
    }

    /// Message when the alarm is cleared.
    pub fn cleared_message(&self, share: f64) -> String {
        format!(
            "the mixture covers its training data again: {:.1} % of the training atoms have γ > 1",
            100.0 * share
        )
    }
}

impl AlarmState {
    /// Starts without an alarm.
    pub fn new(forgetting: ForgettingRule) -> Self {
        Self { forgetting, raised: false }
    }

    /// Takes the values of a decision. Returns a message if the alarm is raised or cleared.
    pub fn update(&mut self, share: f64, raised: bool) -> Option<String> {
        let holds = self.forgetting.evaluate(share, raised)?;
        match (std::mem::replace(&mut self.raised, holds), holds) {
            (false, true) => Some(format!("ALARM: {}", self.forgetting.raised_message(share))),
            (true, false) => Some(self.forgetting.cleared_message(share)),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_alarm_is_reported_when_it_begins_and_when_it_ends() {
        let forgetting = ForgettingRule { limit: 0.2, covariance_update: CovarianceUpdateKind::Convex };
        let mut alarm = AlarmState::new(forgetting);
        let said: Vec<_> = [0.1, 0.21, 0.3, 0.19, 0.21, 0.17, 0.1, 0.25]
            .into_iter()
            .map(|share| alarm.update(share, share > 0.2))
            .collect();
        let begins = [1, 7].map(|index: usize| said[index].clone().unwrap());
        assert!(begins[0].starts_with("ALARM: ") && begins[0].contains("additive"), "{begins:?}");
        assert!(begins[0].contains("21.0 %") && begins[0].contains("20.0 %"), "{begins:?}");
        assert!(said[5].as_ref().unwrap().contains("again"), "{said:?}");
        assert_eq!(said.iter().flatten().count(), 3, "{said:?}");
    }
}
