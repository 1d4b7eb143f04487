//! Progress of a training: a bar on a terminal, otherwise a line for each epoch and now and then.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ::upfit::{EpochRecord, SetErrors, TrainingEvent, UpdateProgress};

use crate::output::{Bar, count, log_and_warn, print_stderr};
use crate::wording;

/// Time between two lines within an epoch.
const LINE_INTERVAL: Duration = Duration::from_secs(30);

const BAR: &str = "{bar:32} {percent} %  {msg}";

/// The display of a training.
pub struct TrainingDisplay {
    checkpoint: PathBuf,
    bar: Bar,
    line: Instant,
}

impl TrainingDisplay {
    /// Of a training with this checkpoint.
    pub fn new(checkpoint: &Path) -> Self {
        Self { checkpoint: checkpoint.to_owned(), bar: Bar::new(None, BAR), line: Instant::now() }
    }

    /// Shows an event.
    pub fn show(&mut self, event: &TrainingEvent<'_>) {
        match event {
            TrainingEvent::Begun { resumed, zero, spread, .. } => {
                if let Some(epochs) = resumed {
                    let (path, epochs) = (self.checkpoint.display(), count(*epochs, "epoch"));
                    self.bar.suspend(|| {
                        print_stderr(format_args!("continuing from {path}: {epochs} finished"));
                    });
                }
                if let Some(text) = wording::upfit::zero(zero) {
                    self.bar.suspend(|| print_stderr(text));
                }
                if let Some(text) = wording::upfit::spread(spread) {
                    self.bar.suspend(|| log_and_warn(text));
                }
            }
            TrainingEvent::Update(progress) => self.show_update(progress),
            TrainingEvent::Epoch { record, seconds_left } => {
                let text = epoch_text(record, *seconds_left);
                tracing::info!("{text}");
                if !self.bar.is_shown() {
                    self.line = Instant::now();
                    print_stderr(text);
                }
            }
        }
    }

    fn show_update(&mut self, progress: &UpdateProgress) {
        self.bar.set_length(progress.all_updates);
        self.bar.set(progress.updates, || update_text(progress));
        if !self.bar.is_shown() && self.line.elapsed() > LINE_INTERVAL {
            self.line = Instant::now();
            print_stderr(update_text(progress));
        }
    }
}

fn update_text(progress: &UpdateProgress) -> String {
    format!(
        "epoch {} of {}: loss {:.3e}, {}; learning rate {:.2e}, {:.1} updates/s{}",
        progress.epoch,
        progress.epochs,
        progress.loss,
        errors_text(&progress.errors),
        progress.learning_rate,
        progress.updates_per_second,
        wording::upfit::time_left(progress.seconds_left)
    )
}

fn epoch_text(record: &EpochRecord, seconds_left: Option<f64>) -> String {
    let training = &record.errors.training;
    let validation = record
        .errors
        .validation
        .as_ref()
        .map(|errors| format!("; validation: loss {:.3e}, {}", errors.loss, errors_text(errors)));
    format!(
        "epoch {}: loss {:.3e}, {}{}; learning rate {:.2e}, {:.1} updates/s{}",
        record.epoch,
        training.loss,
        errors_text(training),
        validation.unwrap_or_default(),
        record.learning_rate,
        record.updates_per_second,
        wording::upfit::time_left(seconds_left)
    )
}

/// Mean absolute errors. Without labelled stresses, there is none of them.
fn errors_text(errors: &SetErrors) -> String {
    let stress = errors.stress_mae.map(|stress| format!(", {stress:.2e} eV/Å³")).unwrap_or_default();
    format!("MAE {:.2e} eV/atom, {:.2e} eV/Å{stress}", errors.energy_mae, errors.force_mae)
}

#[cfg(test)]
mod tests {
    use ::upfit::ErrorsBySet;

    use super::*;

    #[test]
    fn lines_have_errors_with_their_units_and_the_expected_end() {
        let errors = SetErrors {
            structures: 3,
            loss: 0.25,
            energy_mae: 0.002,
            energy_rmse: 0.3,
            force_mae: 0.04,
            force_rmse: 0.3,
            stress_mae: Some(5e-4),
            stress_rmse: Some(0.3),
        };
        let progress = UpdateProgress {
            epoch: 2,
            epochs: 10,
            updates: 7,
            all_updates: 40,
            updates_per_second: 1.5,
            seconds_left: Some(180.0),
            learning_rate: 1e-3,
            loss: 0.5,
            errors,
        };
        let maes = "MAE 2.00e-3 eV/atom, 4.00e-2 eV/Å, 5.00e-4 eV/Å³";
        assert_eq!(
            update_text(&progress),
            format!(
                "epoch 2 of 10: loss 5.000e-1, {maes}; learning rate 1.00e-3, 1.5 updates/s, 3 minutes left"
            )
        );
        let without = SetErrors { stress_mae: None, ..errors };
        let record = EpochRecord {
            epoch: 1,
            stage: 0,
            learning_rate: 1e-3,
            errors: ErrorsBySet { training: errors, validation: Some(without) },
            updates_per_second: 1.5,
        };
        assert_eq!(
            epoch_text(&record, None),
            format!(
                "epoch 1: loss 2.500e-1, {maes}; validation: loss 2.500e-1, MAE 2.00e-3 eV/atom, 4.00e-2 eV/Å; learning rate \
                 1.00e-3, 1.5 updates/s"
            )
        );
    }
}
