//! The alarm for a mixture that forgets its training data.

use calm::forgetting::ElementForgetting;
use calm::rules::CovarianceUpdateKind;
use orchestrator::selector::OnForgetting;
use serde::Deserialize;

use crate::config::CalmSection;

/// The alarm is cleared below this level, so that it does not toggle with every decision.
const HYSTERESIS: f64 = 0.9;

/// Limits and texts of the alarm.
#[derive(Clone, Copy, Debug)]
pub struct ForgettingRule {
    /// Share of the training atoms above which the alarm is raised.
    limit: f64,
    /// Growth of the mean σ² above which it is raised, for elements without sampled atoms.
    max_growth: f64,
    covariance_update: CovarianceUpdateKind,
    action: OnForgetting,
}

/// What the selector measured after an update.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct ForgettingMeasurement {
    /// How near the alarm is: it is raised above 1.
    #[serde(default)]
    pub level: f64,
    /// Share of the sampled training atoms with γ > 1, if there are any.
    pub share_above_one: Option<f64>,
    /// Of every element with a changed component.
    #[serde(default)]
    pub elements: Vec<ElementForgetting>,
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
        Self {
            limit: calm.forgetting_alarm.get(),
            max_growth: calm.max_mean_square_growth.get(),
            covariance_update: calm.covariance_update,
            action: calm.on_forgetting,
        }
    }

    /// Whether the alarm stops the run.
    pub fn pauses(&self) -> bool {
        self.action == OnForgetting::Pause
    }

    /// Whether the alarm holds. `None` if it stays as it was.
    pub fn evaluate(&self, level: f64) -> Option<bool> {
        let raised = level > 1.0;
        (raised || level < HYSTERESIS).then_some(raised)
    }

    /// Message when the alarm is raised, with advice.
    pub fn raised_message(&self, measured: &ForgettingMeasurement) -> String {
        let other = match self.covariance_update {
            CovarianceUpdateKind::Convex => {
                "covariance_update = \"additive\", which forgets nothing, or with smaller values in calm.alpha_values"
            }
            CovarianceUpdateKind::Additive => "smaller values in calm.alpha_values",
        };
        let consequence = match (self.action, self.covariance_update) {
            (OnForgetting::Pause, _) => "The run stops (calm.on_forgetting)",
            (OnForgetting::Additive, CovarianceUpdateKind::Convex) => {
                "Updates are additive from now on (calm.on_forgetting)"
            }
            _ => "The campaign continues",
        };
        format!(
            "the mixture forgets its training data: {}, so that walks may collect structures that the potential knows. \
             {consequence}. To avoid this, start another one with {other} in [calm]; to accept it, raise the limit \
             (docs/configuration.md)",
            self.describe(measured)
        )
    }

    /// Message when the alarm is cleared.
    pub fn cleared_message(&self, measured: &ForgettingMeasurement) -> String {
        format!("the mixture covers its training data again: {}", self.describe(measured))
    }

    /// What was measured, and the limit.
    fn describe(&self, measured: &ForgettingMeasurement) -> String {
        let worst = |of: fn(&ElementForgetting) -> Option<f64>| {
            let known = measured.elements.iter().filter_map(|element| Some((element, of(element)?)));
            known.max_by(|a, b| a.1.total_cmp(&b.1)).map(|(element, value)| (&element.element, value))
        };
        let mut parts = Vec::new();
        if let Some(share) = measured.share_above_one {
            let element = match worst(|element| element.share_above_one) {
                Some((element, share)) if measured.elements.len() > 1 => {
                    format!(", {:.1} % of those of {element}", 100.0 * share)
                }
                _ => String::new(),
            };
            let (share, limit) = (100.0 * share, 100.0 * self.limit);
            parts.push(format!(
                "{share:.1} % of the training atoms have γ > 1{element} (calm.forgetting_alarm: {limit:.1} %)"
            ));
        }
        let unsampled =
            worst(|element| element.share_above_one.is_none().then_some(element.mean_square_growth));
        if let Some((element, growth)) = unsampled {
            parts.push(format!(
                "the mean σ² of the training atoms of {element} is {growth:.1} times what it was \
                 (calm.max_mean_square_growth: {})",
                self.max_growth
            ));
        }
        parts.join("; ")
    }
}

impl AlarmState {
    /// Starts without an alarm.
    pub fn new(forgetting: ForgettingRule) -> Self {
        Self { forgetting, raised: false }
    }

    /// Whether the alarm is raised and stops the run.
    pub fn pauses(&self) -> bool {
        self.raised && self.forgetting.pauses()
    }

    /// Takes the values of a decision. Returns a message if the alarm is raised or cleared.
    pub fn update(&mut self, measured: &ForgettingMeasurement) -> Option<String> {
        let holds = self.forgetting.evaluate(measured.level)?;
        match (std::mem::replace(&mut self.raised, holds), holds) {
            (false, true) => Some(format!("ALARM: {}", self.forgetting.raised_message(measured))),
            (true, false) => Some(self.forgetting.cleared_message(measured)),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULE: ForgettingRule = ForgettingRule {
        limit: 0.2,
        max_growth: 4.0,
        covariance_update: CovarianceUpdateKind::Convex,
        action: OnForgetting::Warn,
    };

    fn element(element: &str, mean_square_growth: f64, share_above_one: Option<f64>) -> ElementForgetting {
        let (element, components) = (element.to_owned(), Vec::new());
        ElementForgetting { element, mean_square_growth, share_above_one, components }
    }

    #[test]
    fn an_alarm_is_reported_when_it_begins_and_when_it_ends() {
        let mut alarm = AlarmState::new(RULE);
        let said: Vec<_> = [0.1, 0.21, 0.3, 0.19, 0.21, 0.17, 0.1, 0.25]
            .into_iter()
            .map(|share| {
                let elements = vec![element("Al", 1.5, Some(share))];
                alarm.update(&ForgettingMeasurement {
                    level: share / 0.2,
                    share_above_one: Some(share),
                    elements,
                })
            })
            .collect();
        let begins = [1, 7].map(|index: usize| said[index].clone().unwrap());
        assert!(begins[0].starts_with("ALARM: ") && begins[0].contains("additive"), "{begins:?}");
        assert!(begins[0].contains("21.0 %") && begins[0].contains("20.0 %"), "{begins:?}");
        assert!(said[5].as_ref().unwrap().contains("again"), "{said:?}");
        assert_eq!(said.iter().flatten().count(), 3, "{said:?}");
    }

    #[test]
    fn the_worst_element_is_named() {
        let elements =
            vec![element("O", 2.0, Some(0.3)), element("H", 3.0, Some(0.45)), element("U", 5.5, None)];
        let said = RULE.describe(&ForgettingMeasurement { level: 2.2, share_above_one: Some(0.1), elements });
        assert!(said.contains("10.0 % of the training atoms have γ > 1, 45.0 % of those of H"), "{said}");
        assert!(said.contains("of U is 5.5 times what it was (calm.max_mean_square_growth: 4)"), "{said}");
    }
}
