//! The alarm over a mixture that forgets its training data: when it begins, when it ends, and what can be done about it.

use calm::rules::CovarianceUpdateKind;

use crate::config::CalmSection;

/// The alarm ends when the share has fallen below so much of the limit, so that it does not come and go with every decision.
const CLEARLY_BELOW: f64 = 0.9;

/// What is looked at.
#[derive(Clone, Copy, Debug)]
pub struct Forgetting {
    /// Share of the training atoms above which there is an alarm.
    limit: f64,
    combination: CovarianceUpdateKind,
}

/// Follows the alarm through a run.
#[derive(Clone, Debug)]
pub struct Alarm {
    forgetting: Forgetting,
    raised: bool,
}

impl Forgetting {
    /// By the section `[calm]`.
    pub fn new(calm: &CalmSection) -> Self {
        Self { limit: calm.forgetting_alarm.get(), combination: calm.combination }
    }

    /// Whether the alarm holds for this share of the training atoms with γ > 1; `raised` is what the selector found. `None`
    /// where it is as it was before.
    pub fn holds(&self, share: f64, raised: bool) -> Option<bool> {
        (raised || share < CLEARLY_BELOW * self.limit).then_some(raised)
    }

    /// The alarm, with what can be done about it.
    pub fn begun(&self, share: f64) -> String {
        let other = match self.combination {
            CovarianceUpdateKind::Convex => {
                "combination = \"additive\", which forgets nothing, or with smaller values of ladder"
            }
            CovarianceUpdateKind::Additive => "smaller values of ladder",
        };
        format!(
            "the mixture forgets its training data: {:.1} % of the training atoms have γ > 1 (calm.forgetting_alarm: {:.1} %), \
             so that walks may collect what the potential knows. The campaign goes on. To change it, begin another one with \
             {other} in [calm]; to accept it, raise calm.forgetting_alarm (docs/configuration.md)",
            100.0 * share,
            100.0 * self.limit
        )
    }

    /// That the alarm is over.
    pub fn over(&self, share: f64) -> String {
        format!(
            "the mixture covers its training data again: {:.1} % of the training atoms have γ > 1",
            100.0 * share
        )
    }
}

impl Alarm {
    /// Nothing has been said yet.
    pub fn new(forgetting: Forgetting) -> Self {
        Self { forgetting, raised: false }
    }

    /// Takes in a decision; what there is to say when the alarm begins or ends.
    pub fn decided(&mut self, share: f64, raised: bool) -> Option<String> {
        let holds = self.forgetting.holds(share, raised)?;
        match (std::mem::replace(&mut self.raised, holds), holds) {
            (false, true) => Some(format!("ALARM: {}", self.forgetting.begun(share))),
            (true, false) => Some(self.forgetting.over(share)),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_alarm_is_said_when_it_begins_and_when_it_ends() {
        let forgetting = Forgetting { limit: 0.2, combination: CovarianceUpdateKind::Convex };
        let mut alarm = Alarm::new(forgetting);
        let said: Vec<_> = [0.1, 0.21, 0.3, 0.19, 0.21, 0.17, 0.1, 0.25]
            .into_iter()
            .map(|share| alarm.decided(share, share > 0.2))
            .collect();
        let begins = [1, 7].map(|index: usize| said[index].clone().unwrap());
        assert!(begins[0].starts_with("ALARM: ") && begins[0].contains("additive"), "{begins:?}");
        assert!(begins[0].contains("21.0 %") && begins[0].contains("20.0 %"), "{begins:?}");
        assert!(said[5].as_ref().unwrap().contains("again"), "{said:?}");
        assert_eq!(said.iter().flatten().count(), 3, "{said:?}");
    }
}
