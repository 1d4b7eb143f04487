//! The settings of a training.

use crate::error::UpfitError;
use crate::learning_rate::CosineDecay;
use crate::loss::LossSettings;
use crate::optimiser::Optimiser;

/// The settings of a training. All but the number of threads affect its result.
#[derive(Clone, Debug, PartialEq)]
pub struct UpfitSettings {
    /// Number of passes over the training set.
    pub epochs: u64,
    /// Structures for each update; the last batch of an epoch may have fewer.
    pub batch_size: usize,
    /// The optimiser.
    pub optimiser: Optimiser,
    /// The loss.
    pub loss: LossSettings,
    /// Of the first update and of the last, without the warm-up of the optimiser.
    pub learning_rate: CosineDecay,
    /// Random seed of the order of the structures.
    pub seed: u64,
    /// Groups of weights that are not trained: beginnings of their names.
    pub frozen: Vec<String>,
    /// Decay of an exponential moving average of the weights, which is validated and returned in their place.
    pub average: Option<f64>,
    /// Ends the training if the validation loss has no new minimum for this many epochs.
    pub patience: Option<u64>,
    /// Number of threads, at least 1; each takes whole structures.
    pub threads: usize,
}

impl UpfitSettings {
    /// Checks ranges.
    ///
    /// # Errors
    /// A setting out of its range; a stage of the loss without epochs.
    pub fn check(&self) -> Result<(), UpfitError> {
        let CosineDecay { first, last } = self.learning_rate;
        let weights = self.loss.stages.iter().map(|stage| stage.weights);
        let are_weights = |numbers: [f64; 3]| {
            numbers.iter().all(|x| x.is_finite() && *x >= 0.0) && numbers.iter().any(|x| *x > 0.0)
        };
        let mut weights = weights.map(|weights| [weights.energy, weights.forces, weights.stress]);
        let begins: Vec<_> = self.loss.stages.iter().map(|stage| stage.begins).collect();
        let positive = |x: f64| x.is_finite() && x > 0.0;
        let rules = [
            (self.epochs >= 1, "the number of epochs", self.epochs.to_string(), "1 or more"),
            (self.batch_size >= 1, "the batch size", self.batch_size.to_string(), "1 or more"),
            (self.threads >= 1, "the number of threads", self.threads.to_string(), "1 or more"),
            (positive(first), "the learning rate", first.to_string(), "a positive number"),
            (
                last.is_finite() && (0.0..=first).contains(&last),
                "the smallest learning rate",
                last.to_string(),
                "0 up to the learning rate",
            ),
            (positive(self.loss.delta), "δ of the loss", self.loss.delta.to_string(), "a positive number"),
            (
                weights.all(are_weights),
                "a weight of the loss",
                format!("{:?}", self.loss.stages),
                "numbers, 0 or more, not all 0",
            ),
            (
                begins.first() == Some(&0.0) && begins.is_sorted(),
                "the list of stages of the loss",
                format!("{begins:?}"),
                "ascending shares from 0",
            ),
            (
                self.average.is_none_or(|decay| (0.0..1.0).contains(&decay)),
                "the decay of the average",
                format!("{:?}", self.average),
                "0 up to, not including, 1",
            ),
            (self.patience != Some(0), "the patience", "0".to_owned(), "1 epoch or more"),
        ];
        if let Some((_, name, found, expected)) = rules.into_iter().find(|(holds, ..)| !holds) {
            return Err(UpfitError::Setting { name, found, expected });
        }
        match self.loss.empty_stage(self.epochs) {
            Some(index) => {
                let begins = self.loss.stages[index].begins;
                Err(UpfitError::StageWithoutEpochs { stage: index + 1, begins, epochs: self.epochs })
            }
            None => Ok(()),
        }
    }

    /// Names and values of the settings that affect the result, for messages and to recognise a training.
    pub fn entries(&self) -> Vec<(String, String)> {
        let stages = self.loss.stages.iter().map(|stage| {
            let weights = stage.weights;
            format!("{} {} {} from {}", weights.energy, weights.forces, weights.stress, stage.begins)
        });
        let optional = |text: Option<String>| text.unwrap_or_else(|| "none".to_owned());
        let frozen = Some(self.frozen.join(" ")).filter(|names| !names.is_empty());
        let entries = [
            ("number of epochs", self.epochs.to_string()),
            ("batch size", self.batch_size.to_string()),
            ("loss (weights of energy, forces, stress)", stages.collect::<Vec<_>>().join(", ")),
            ("optimiser", self.optimiser.name().to_owned()),
            ("Huber δ", self.loss.delta.to_string()),
            ("learning rate", self.learning_rate.first.to_string()),
            ("smallest learning rate", self.learning_rate.last.to_string()),
            ("random seed", self.seed.to_string()),
            ("list of frozen weights", optional(frozen)),
            ("decay of the average", optional(self.average.map(|decay| decay.to_string()))),
            ("patience", optional(self.patience.map(|epochs| epochs.to_string()))),
        ];
        entries.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_frames::settings;

    type Change = fn(&mut UpfitSettings);

    #[test]
    fn settings_out_of_range_are_named() {
        settings().check().unwrap();
        let changes: [(Change, &str); 9] = [
            (|settings| settings.epochs = 0, "the number of epochs is 0, expected 1 or more"),
            (|settings| settings.batch_size = 0, "the batch size is 0"),
            (|settings| settings.learning_rate.first = f64::NAN, "the learning rate is NaN"),
            (|settings| settings.learning_rate.last = 1.0, "the smallest learning rate is 1"),
            (|settings| settings.loss.delta = 0.0, "δ of the loss is 0"),
            (|settings| settings.loss.stages[0].weights.energy = -1.0, "a weight of the loss"),
            (|settings| settings.average = Some(1.0), "the decay of the average"),
            (|settings| settings.patience = Some(0), "the patience is 0"),
            (
                |settings| (settings.epochs, settings.loss) = (1, LossSettings::paper()),
                "stage 2 of the loss begins after a share of 0.417 of 1 epochs and has none",
            ),
        ];
        for (change, expected) in changes {
            let mut changed = settings();
            change(&mut changed);
            let message = changed.check().unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn threads_are_no_part_of_a_training() {
        let other = UpfitSettings { threads: 7, ..settings() };
        assert_eq!(other.entries(), settings().entries());
        assert_ne!(UpfitSettings { seed: 7, ..settings() }.entries(), settings().entries());
    }
}
