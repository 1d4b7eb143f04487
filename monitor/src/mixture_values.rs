//! What the selector stores about the mixture: forgetting and staleness.

use calm::Staleness;
use calm::forgetting::ElementForgetting;
use serde::Deserialize;
use serde_json::{Value, json};
use store::records::{LEFT_OUT, STALENESS, TRAINING_FRAMES};

/// Values that the selector stores with its commits, by name.
#[derive(Debug)]
pub struct MixtureValues(pub Vec<(String, String)>);

impl MixtureValues {
    /// The grades of the training frames under the newest mixture; null if they are not monitored.
    pub fn training_frames(&self) -> Value {
        self.read(TRAINING_FRAMES).unwrap_or_default()
    }

    /// What the newest mixture has forgotten, see [`forgetting_by_element`].
    pub fn forgetting(&self) -> Vec<ElementForgetting> {
        forgetting_by_element(&self.training_frames())
    }

    /// The fraction of the training atoms with γ > 1, if they are monitored.
    pub fn share_above_one(&self) -> Option<f64> {
        self.training_frames()["share_above_one"].as_f64()
    }

    /// By how many versions walkers' mixtures were behind the newest at decisions; null before the first decision.
    pub fn staleness_json(&self) -> Value {
        let Some(staleness) = self.staleness() else { return Value::Null };
        let mut json = json!(staleness);
        json["decisions"] = json!(staleness.decisions());
        json["share_of_newest"] = json!(staleness.share_of_newest());
        json["median"] = json!(staleness.quantile(0.5));
        json["quantile_90"] = json!(staleness.quantile(0.9));
        json
    }

    /// The same as a histogram.
    pub fn staleness(&self) -> Option<Staleness> {
        self.read(STALENESS)
    }

    /// Number of candidates that could not be graded, and of control frames with atoms too close.
    pub fn left_out(&self) -> u64 {
        self.read(LEFT_OUT).unwrap_or(0)
    }

    fn read<T: serde::de::DeserializeOwned>(&self, name: &str) -> Option<T> {
        let (_, text) = self.0.iter().find(|(key, _)| key == name)?;
        serde_json::from_str(text).ok()
    }
}

/// The elements with a changed component in the value [`TRAINING_FRAMES`]. Those whose mean σ² has grown most come first.
pub fn forgetting_by_element(training_frames: &Value) -> Vec<ElementForgetting> {
    let mut elements =
        Vec::<ElementForgetting>::deserialize(&training_frames["elements"]).unwrap_or_default();
    elements.sort_by(|a, b| b.mean_square_growth.total_cmp(&a.mean_square_growth));
    elements
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn staleness_has_its_quantiles() {
        let mut staleness = Staleness::default();
        [0, 0, 0, 1, 2, 7].iter().for_each(|age| staleness.add(*age));
        let values = MixtureValues(vec![(STALENESS.into(), json!(staleness).to_string())]);
        let expected = json!({
            "counts": { "0": 3, "1": 1, "2": 1, "7": 1 }, "largest": 7, "decisions": 6, "share_of_newest": 0.5,
            "median": 0, "quantile_90": 7,
        });
        assert_eq!(values.staleness_json(), expected);
        assert_eq!(MixtureValues(Vec::new()).staleness_json(), Value::Null);
    }
}
