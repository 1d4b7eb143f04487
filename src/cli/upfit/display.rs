//! Progress of a training: a bar on a terminal, otherwise a line for each epoch and now and then.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ::upfit::{EpochRecord, TrainingEvent, UpdateProgress};

use super::report::{spread_text, zero_text};
use crate::output::{Bar, count, log_and_warn, print_stderr};

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
                if let Some(text) = zero_text(zero) {
                    self.bar.suspend(|| print_stderr(text));
                }
                if let Some(text) = spread_text(spread) {
                    self.bar.suspend(|| log_and_warn(text));
                }
            }
            TrainingEvent::Update(progress) => self.show_update(progress),
            TrainingEvent::Epoch(record) => {
                tracing::info!("{}", epoch_text(record));
                if !self.bar.is_shown() {
                    self.line = Instant::now();
                    print_stderr(epoch_text(record));
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
    let left = Duration::from_secs_f64(progress.seconds_left.clamp(0.0, 1e10));
    format!(
        "epoch {} of {}: loss {:.3e}, {:.1} updates/s, {} left",
        progress.epoch,
        progress.epochs,
        progress.loss,
        progress.updates_per_second,
        indicatif::HumanDuration(left)
    )
}

fn epoch_text(record: &EpochRecord) -> String {
    let (shown, set) = match &record.errors.validation {
        Some(errors) => (errors, "validation"),
        None => (&record.errors.training, "training"),
    };
    format!(
        "epoch {}: loss {:.3e}, {set}: loss {:.3e}, energy {:.2} meV/atom, forces {:.1} meV/Å (RMSE); learning rate {:.2e}, {:.1} \
         updates/s",
        record.epoch,
        record.errors.training.loss,
        shown.loss,
        1e3 * shown.energy_rmse,
        1e3 * shown.force_rmse,
        record.learning_rate,
        record.updates_per_second
    )
}
