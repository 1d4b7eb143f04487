//! What the live mixture has forgotten of the training data, by element.

use std::collections::{BTreeMap, BTreeSet};

use calm::Mixture;
use calm::forgetting::{
    ComponentForgetting, ElementForgetting, ForgettingAlarm, GradeDistribution, mean_square_growth,
};
use serde_json::{Value, json};

use super::error::SelectorError;
use super::training_frames::TrainingFrames;

/// Minimum number of sampled atoms of an element for which the share above 1 means something.
const MIN_ATOMS: usize = 50;

/// Compares the live mixture with the original one.
pub(super) struct Forgetting {
    /// Chemical symbols by element index.
    symbols: Vec<String>,
    training: Option<TrainingFrames>,
    /// Growth of the mean σ² of each component that has changed, by element and slot.
    growth: BTreeMap<(usize, usize), f64>,
}

/// The state after an update.
pub(super) struct ForgettingState {
    /// The grades of the sampled training atoms, if there are any.
    pub training: Option<GradeDistribution>,
    /// Of every element with a changed component.
    pub elements: Vec<ElementForgetting>,
    /// How near the alarm is: it is raised above 1.
    pub level: f64,
    /// The same from the shares of sampled atoms with γ > 1 alone.
    level_of_share: f64,
    /// The same from the growth of the mean σ² of elements without a sample alone.
    level_of_growth: f64,
}

impl Forgetting {
    pub fn new(symbols: Vec<String>, training: Option<TrainingFrames>) -> Self {
        Self { symbols, training, growth: BTreeMap::new() }
    }

    /// Takes an update of these components, by element and slot. Changes nothing if a training atom cannot be graded.
    pub fn update(
        &mut self,
        original: &Mixture,
        live: &Mixture,
        changed: &BTreeSet<(usize, usize)>,
    ) -> Result<(), SelectorError> {
        if let Some(training) = &mut self.training {
            let elements: BTreeSet<usize> = changed.iter().map(|(element, _)| *element).collect();
            training.regrade(live, |element| elements.contains(&element))?;
        }
        for &(element, slot) in changed {
            let components = original.component(element, slot).zip(live.component(element, slot));
            let growth = components.and_then(|(before, now)| mean_square_growth(before, now));
            self.growth.extend(growth.map(|growth| ((element, slot), growth)));
        }
        Ok(())
    }

    /// The original mixture is in force again.
    pub fn restart(&mut self) {
        self.growth.clear();
        if let Some(training) = &mut self.training {
            training.restart();
        }
    }

    /// The state under the live mixture.
    pub fn state(&self, original: &Mixture, alarm: ForgettingAlarm) -> ForgettingState {
        let elements: BTreeSet<usize> = self.growth.keys().map(|(element, _)| *element).collect();
        let elements: Vec<_> = elements.into_iter().map(|element| self.element(original, element)).collect();
        let level = |is_sampled: bool| {
            let of_kind = elements.iter().filter(|(_, before)| before.is_some() == is_sampled);
            of_kind.map(|(element, before)| alarm.level_of(element, *before)).fold(0.0, f64::max)
        };
        let training = self.training.as_ref().map(|training| (training.original(), training.live()));
        let total = training.map_or(0.0, |(before, live)| alarm.level_of_share(before, live));
        let (level_of_share, level_of_growth) = (level(true).max(total), level(false));
        ForgettingState {
            level: level_of_share.max(level_of_growth),
            level_of_share,
            level_of_growth,
            training: training.map(|(_, live)| live),
            elements: elements.into_iter().map(|(element, _)| element).collect(),
        }
    }

    /// An element, with the share above 1 under the original mixture.
    fn element(&self, original: &Mixture, element: usize) -> (ElementForgetting, Option<f64>) {
        let components = original.components(element).unwrap_or_default().iter().enumerate();
        let (mut sum, mut atoms, mut changed) = (0.0, 0.0, Vec::new());
        for (slot, component) in components {
            let count = component.statistics().map_or(0.0, |statistics| statistics.count);
            let growth = self.growth.get(&(element, slot)).copied();
            sum += count * growth.unwrap_or(1.0);
            atoms += count;
            changed.extend(
                growth.map(|growth| ComponentForgetting { component: slot, mean_square_growth: growth }),
            );
        }
        let shares = self.training.as_ref().and_then(|training| training.shares_of(element, MIN_ATOMS));
        let forgetting = ElementForgetting {
            element: self.symbols.get(element).cloned().unwrap_or_default(),
            mean_square_growth: if atoms > 0.0 { sum / atoms } else { 1.0 },
            share_above_one: shares.map(|[_, live]| live),
            components: changed,
        };
        (forgetting, shares.map(|[before, _]| before))
    }
}

impl ForgettingState {
    pub fn is_alarming(&self) -> bool {
        self.level > 1.0
    }

    /// As recorded with the decision: without components.
    pub fn in_decision(&self) -> Value {
        let without =
            |element: &ElementForgetting| ElementForgetting { components: Vec::new(), ..element.clone() };
        json!({ "level": self.level, "elements": self.elements.iter().map(without).collect::<Vec<_>>() })
    }

    /// As stored for display.
    pub fn to_json(&self) -> Value {
        let mut value = self.training.map_or_else(|| json!({}), |training| json!(training));
        value["elements"] = json!(self.elements);
        value["level"] = json!(self.level);
        value["level_of_share"] = json!(self.level_of_share);
        value["level_of_growth"] = json!(self.level_of_growth);
        value["alarm"] = json!(self.is_alarming());
        value
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use calm::Component;

    use super::*;

    #[test]
    fn the_alarm_is_raised_above_one() {
        let state = |level| ForgettingState {
            training: None,
            elements: Vec::new(),
            level,
            level_of_share: level,
            level_of_growth: 0.0,
        };
        assert_eq!([0.9, 1.0, 1.1].map(|level| state(level).is_alarming()), [false, false, true]);
    }

    /// Mixtures of other programs may have no counts of atoms.
    #[test]
    fn an_element_without_counts_has_not_grown() {
        let component = Component::new(vec![0.0], vec![1.0], 1.0, None).unwrap();
        let mixture = Mixture::new(0, vec![vec![Arc::new(component)]]).unwrap();
        let (element, share) = Forgetting::new(vec!["Al".to_owned()], None).element(&mixture, 0);
        assert_eq!((element.element.as_str(), element.mean_square_growth, share), ("Al", 1.0, None));
    }
}
