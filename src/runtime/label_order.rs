//! Keeps the order of the label queue while a campaign runs: computes the value of each queued structure, and learns which labels
//! complete, for the order and for the selector.

use std::panic::resume_unwind;
use std::time::Duration;

use monitor::completion_model::{self, CompletionModel};
use monitor::label_value::{FeatureScales, LabelOrderReader, OrderInputs, ValuedLabel, order};
use serde_json::json;
use store::{JobState, LabelValue, Store, StoreError};
use tokio::sync::watch;
use tokio::task::{JoinSet, spawn_blocking};
use wire::{CompletionCoefficients, ContentHash};

use super::RunContext;
use crate::config::LabelOrder;
use crate::exit_status::CommandError;
use crate::output::log_and_warn;

/// Time between two looks at the queue.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// The order is computed again when this part of the queue is new, or as many labels have been made …
const CHANGED_PART: u64 = 10;
/// … but after so many at the latest.
const MAX_CHANGES: u64 = 50;

/// Receives the newest model of the completion of labels; `None` if the campaign needs none.
pub type CompletionModels = Option<watch::Receiver<Option<CompletionCoefficients>>>;

/// The task that keeps the order. Dropping it ends the task.
pub struct LabelOrderTask {
    /// The models that it learns.
    pub completion: CompletionModels,
    _task: JoinSet<()>,
}

/// Computes the order, and again when the queue has changed.
struct OrderKeeper {
    store: Store,
    protocol: ContentHash,
    /// Name of the protocol.
    name: String,
    /// Of the potential of the walks.
    version: u32,
    by_value: bool,
    reader: LabelOrderReader,
    completion: watch::Sender<Option<CompletionCoefficients>>,
}

/// How far the queue is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct QueueProgress {
    queued: u64,
    /// Labelled or failed.
    finished: u64,
    all: u64,
}

impl LabelOrderTask {
    /// Starts the task if the configuration needs it. The first order is there when this returns. Without
    /// `label.order = "value"`, no job keeps a value.
    pub async fn start(run: RunContext<'_>) -> Result<Self, CommandError> {
        let (campaign, config) = (run.campaign, &run.campaign.config);
        let by_value = config.label.order == LabelOrder::Value;
        if !by_value {
            run.store.clear_label_values().await?;
        }
        let mut task = JoinSet::new();
        if !by_value && config.collect.min_completion_probability.is_none() {
            return Ok(Self { completion: None, _task: task });
        }
        let scales = FeatureScales::new(&campaign.artifact.mixture, campaign.model.elements());
        let (completion, receiver) = watch::channel(None);
        let mut keeper = OrderKeeper {
            store: run.store.clone(),
            protocol: campaign.protocol.hash,
            name: campaign.protocol.name.clone(),
            version: campaign.version_number(),
            by_value,
            reader: LabelOrderReader::new(campaign.version_number(), scales),
            completion,
        };
        let first = keeper.progress().await?;
        keeper.compute().await?;
        task.spawn(async move {
            if let Some(panic) = panic_of(keeper.keep(first)).await {
                log_and_warn(format!(
                    "the order of the label queue is no longer computed, and labels go on in the last one: {panic}; please report this"
                ));
            }
        });
        Ok(Self { completion: Some(receiver), _task: task })
    }
}

/// Runs a task to its end. Returns what it panicked with, if it did.
async fn panic_of(task: impl Future<Output = ()> + Send + 'static) -> Option<String> {
    let mut tasks = JoinSet::new();
    tasks.spawn(task);
    let error = tasks.join_next().await?.err()?;
    error.is_panic().then(|| error.to_string())
}

impl OrderKeeper {
    /// Computes the order again and again. Ignores errors: other writers report a broken database.
    async fn keep(mut self, mut computed: QueueProgress) {
        loop {
            tokio::time::sleep(CHECK_INTERVAL).await;
            let Ok(now) = self.progress().await else { continue };
            if now.is_due_after(computed) && self.compute().await.is_ok() {
                computed = now;
            }
        }
    }

    async fn progress(&self) -> Result<QueueProgress, StoreError> {
        let mut progress = QueueProgress { queued: 0, finished: 0, all: 0 };
        let jobs = self.store.jobs_by_protocol().await?;
        for (_, state, number) in jobs.into_iter().filter(|(name, ..)| *name == self.name) {
            progress.all += number;
            match state {
                JobState::Queued => progress.queued += number,
                JobState::Labelled | JobState::Failed => progress.finished += number,
                JobState::Leased | JobState::Dropped | JobState::Superseded => {}
            }
        }
        Ok(progress)
    }

    async fn compute(&mut self) -> Result<(), StoreError> {
        if !self.by_value {
            let examples = completion_model::examples(&self.store, self.protocol, self.version).await?;
            self.send(CompletionModel::fit(&examples.examples));
            return Ok(());
        }
        let OrderInputs { rows, covering, completion } = self.reader.read(&self.store, self.protocol).await?;
        self.send(completion);
        if rows.is_empty() {
            return Ok(());
        }
        // A long queue takes a second.
        let ordered = match spawn_blocking(move || order(&rows, &covering)).await {
            Ok(ordered) => ordered,
            Err(error) => match error.try_into_panic() {
                Ok(panic) => resume_unwind(panic),
                // The program ends.
                Err(_) => return Ok(()),
            },
        };
        let values: Vec<_> = ordered.iter().map(stored).collect();
        self.store.set_label_values(&values).await?;
        Ok(())
    }

    fn send(&self, model: Option<CompletionModel>) {
        if let Some(model) = model {
            self.completion.send_replace(Some(model.coefficients));
        }
    }
}

fn stored(valued: &ValuedLabel) -> LabelValue {
    LabelValue { job: valued.job, value: valued.value, factors: json!(valued.factors) }
}

impl QueueProgress {
    /// Whether enough has changed since the order was computed for `before`.
    fn is_due_after(self, before: Self) -> bool {
        let enough = (before.queued / CHANGED_PART).clamp(1, MAX_CHANGES);
        // Fewer are finished when labels are made again.
        self.finished.abs_diff(before.finished) >= enough || self.all.abs_diff(before.all) >= enough
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_panic_is_told() {
        let told = panic_of(async { panic!("a bug") }).await;
        assert!(told.as_ref().is_some_and(|told| told.contains("a bug")), "{told:?}");
        assert_eq!(panic_of(async {}).await, None);
    }

    #[test]
    fn the_order_is_computed_again_when_a_tenth_of_the_queue_has_changed() {
        let progress =
            |queued: u64, finished: u64| QueueProgress { queued, finished, all: queued + finished };
        for (before, after, due) in [
            (progress(0, 0), progress(0, 0), false),
            (progress(0, 0), progress(1, 0), true),
            (progress(5, 0), progress(4, 1), true),
            (progress(100, 0), progress(91, 9), false),
            (progress(100, 0), progress(90, 10), true),
            (progress(100, 0), progress(109, 0), false),
            (progress(100, 0), progress(110, 0), true),
            (progress(9000, 7), progress(8950, 57), true),
            (progress(10, 30), progress(20, 20), true),
        ] {
            assert_eq!(after.is_due_after(before), due, "{before:?} {after:?}");
        }
    }
}
