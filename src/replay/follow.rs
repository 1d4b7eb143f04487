//! Feeds decisions and candidates from the store to the replay.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;

use calm::Mixture;
use orchestrator::selector::{RegradedCandidate, Regrader, Replay, ReplayedDecision, SelectorError, VERSION};
use store::{LoggedDecision, Store, StoredCandidate};

use super::failure;
use super::report::{LogEntry, ReplayReport};
use crate::all_cores;
use crate::campaign::{self, grader};
use crate::config::Config;
use crate::exit_status::CommandError;
use crate::output::Bar;
use crate::runtime::cores;
use crate::versions::VersionOnDisk;

/// Decisions read at a time.
const PAGE_ROWS: i64 = 500;
/// Candidates that each core grades per batch. With more of them, the mixture is more often outdated when they are
/// decided.
const CANDIDATES_PER_CORE: u32 = 8;

/// Follows the log up to decision `last`, or until something differs or is missing.
pub async fn follow(
    store: &Store,
    config: &Config,
    replay: &mut Replay,
    report: &mut ReplayReport,
    last: i64,
    bar: &Bar,
) -> Result<(), CommandError> {
    let mut prefetch = Prefetch::new(replay.is_exact());
    for first in pages(1, last) {
        for recorded in &page(store, first, last).await? {
            if recorded.kind == VERSION {
                let now = take_up_version(store, config, replay, recorded).await?;
                prefetch.ready.clear();
                report.add(LogEntry { decision: recorded, candidate: None }, now, replay.is_exact());
                continue;
            }
            let candidate = match recorded.candidate {
                Some(_) if replay.is_reached(recorded).map_err(failure)? => {
                    Some(prefetch.take(store, replay, recorded.sequence).await?)
                }
                _ => None,
            };
            if let Some(PrefetchedCandidate { examined: None, .. }) = candidate {
                report.stop(recorded);
                return Ok(());
            }
            let (stored, examined) = candidate.map(|ready| (ready.stored, ready.examined)).unzip();
            let examined = examined.flatten().transpose().map_err(CommandError::failed)?;
            let now = replay.apply(recorded, examined).map_err(failure)?;
            report.add(LogEntry { decision: recorded, candidate: stored.as_ref() }, now, replay.is_exact());
            bar.set(recorded.sequence.unsigned_abs(), String::new);
            if report.difference.is_some() {
                return Ok(());
            }
        }
    }
    Ok(())
}

/// Replays the decision to switch to a version of the potential, with the model and the mixture of that version.
async fn take_up_version(
    store: &Store,
    config: &Config,
    replay: &mut Replay,
    recorded: &LoggedDecision,
) -> Result<Option<ReplayedDecision>, CommandError> {
    let directory = tempfile::tempdir().map_err(CommandError::failed)?;
    let found = VersionOnDisk::taken_up_by(store, recorded, directory.path()).await?;
    let name = format!("(version {})", found.version.version);
    let (model, artifact, training) = campaign::load_for_grades(&found.applied_to(config), Path::new(&name))?;
    let original = Arc::new(artifact.mixture);
    replay.take_up_version(recorded, grader(&model), original, training).map_err(failure)
}

/// The first decisions of the pages from decision `first` to decision `last`.
pub fn pages(first: i64, last: i64) -> impl Iterator<Item = i64> {
    (first..=last).step_by(PAGE_ROWS as usize)
}

/// The page of decisions from `first` on, up to decision `last`.
pub async fn page(store: &Store, first: i64, last: i64) -> Result<Vec<LoggedDecision>, CommandError> {
    let to = last.min(first + PAGE_ROWS - 1);
    let page = store.decisions(first..=to).await?;
    match page.len() as i64 == to - first + 1 {
        true => Ok(page),
        false => Err(damaged(first, &format!("one of the {} from it on is missing", to - first + 1))),
    }
}

/// An entry of the log that cannot be what was written.
pub fn damaged(decision: i64, problem: &str) -> CommandError {
    CommandError::Failed(format!(
        "decision {decision}: {problem}: the database is damaged; restore the campaign from a backup"
    ))
}

/// A stored candidate without its arrays, and graded unless its features were not kept.
struct PrefetchedCandidate {
    stored: StoredCandidate,
    examined: Option<Result<RegradedCandidate, SelectorError>>,
}

/// Candidates after a position in the log.
struct Prefetch {
    /// Whether candidates of control walks are needed.
    control: bool,
    ready: VecDeque<PrefetchedCandidate>,
}

impl Prefetch {
    fn new(control: bool) -> Self {
        Self { control, ready: VecDeque::new() }
    }

    /// The candidate of a decision. Skips candidates that were not needed.
    async fn take(
        &mut self,
        store: &Store,
        replay: &Replay,
        decision: i64,
    ) -> Result<PrefetchedCandidate, CommandError> {
        self.ready.retain(|ready| ready.stored.decision >= decision);
        if self.ready.is_empty() {
            let cores = cores();
            let stored = store.candidates(decision - 1, self.control, CANDIDATES_PER_CORE * cores).await?;
            let (examiner, mixture) = (replay.regrader(), replay.mixture());
            let examined = all_cores::map(
                stored.into_iter(),
                || (),
                |(), stored| examine_one(stored, examiner, mixture),
            );
            self.ready = examined.into_iter().collect::<Result<_, _>>()?;
        }
        let ready = self.ready.pop_front().filter(|ready| ready.stored.decision == decision);
        ready.ok_or_else(|| damaged(decision, "its candidate is missing"))
    }
}

fn examine_one(
    mut stored: StoredCandidate,
    examiner: &Regrader,
    mixture: &Arc<Mixture>,
) -> Result<PrefetchedCandidate, CommandError> {
    let Some(features) = stored.features.take() else {
        return Ok(PrefetchedCandidate { stored, examined: None });
    };
    let block = stored
        .block
        .with_features(&features)
        .map_err(|error| damaged(stored.decision, &error.to_string()))?;
    Ok(PrefetchedCandidate { examined: Some(examiner.regrade_block(block, mixture)), stored })
}
