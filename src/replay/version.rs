//! Computes the mixture of an earlier version, which the store does not keep.

use std::sync::Arc;

use calm::Mixture;
use store::Store;

use super::report::{MissingFeatures, ReplayReport};
use super::{BAR, RelocatedFilesArgs, follow, is_other_processor, open, overrides, relocated, resolved};
use crate::exit_status::CommandError;
use crate::output::Bar;

/// The mixture of a version between the first and the newest, by a replay of the decisions before it.
///
/// # Errors
/// Files that are missing or have another content, features that were not kept, decisions that are not reproduced.
pub async fn mixture_of(
    store: &Store,
    version: u64,
    moved: &RelocatedFilesArgs,
) -> Result<Arc<Mixture>, CommandError> {
    let campaign = store.campaign().await?;
    let resolved = resolved(&campaign)?;
    let mut config = overrides::configuration(&campaign.configuration, &[])?;
    relocated::find(&mut config, &resolved, &store.grade_files().await?, moved)?;
    let mut replay = open(store, &config, &[]).await?;
    let last = store.first_decision_of(version).await?;
    let last = last.ok_or_else(|| {
        CommandError::Failed(format!(
            "mixture version {version}: no decision made it: the database is damaged"
        ))
    })?;
    let mut report = ReplayReport::new(&campaign, &[], is_other_processor(&resolved), last);
    let bar = Bar::new(Some(last.unsigned_abs()), BAR);
    follow::follow(store, &mut replay, &mut report, last, &bar).await?;
    drop(bar);
    if let Some(MissingFeatures { decision, candidate, .. }) = &report.stopped {
        return Err(CommandError::Input(format!(
            "mixture version {version} is the result of decision {last} and cannot be computed again: the features of candidate \
             {candidate} (decision {decision}) were not stored (limit: collect.declined_features_mb); expected at most version {} or \
             the newest",
            replay.mixture().version()
        )));
    }
    if let Some(difference) = &report.difference {
        let processor = match report.other_processor {
            true => {
                " (the campaign was started on another type of processor, whose floating-point results differ)"
            }
            false => "",
        };
        return Err(CommandError::Failed(format!(
            "mixture version {version} cannot be computed again: decision {} is not reproduced: {} was {}, and is now {}{processor}",
            difference.decision, difference.what, difference.recorded, difference.now
        )));
    }
    let found = replay.mixture_of(version).map(Arc::clone);
    found.ok_or_else(|| {
        CommandError::Failed(format!(
            "mixture version {version}: after decision {last} the replay has version {}",
            replay.mixture().version()
        ))
    })
}
