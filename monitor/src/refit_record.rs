//! Whether a refit is recorded already: its process may have been killed after that, or may not know it, because the answer of the
//! database was lost.

use store::{Store, StoreError, VersionRecord, VersionState};

use crate::refit_progress::{LABEL_SET, LabelSplit};

/// The record that an earlier process of a refit made, if there is one among the `versions`.
///
/// A registered version that is newer than the `parent` was made since this refit was configured. The parent of a refused one
/// remains; the directory of the refit with its number `is_left`, nothing was accepted since, and the labels are the same.
pub async fn recorded_before(
    (store, split): (&Store, &LabelSplit),
    versions: &[VersionRecord],
    parent: u32,
    is_left: impl FnOnce(u32) -> bool,
) -> Result<Option<VersionRecord>, StoreError> {
    let Some(last) = versions.last() else { return Ok(None) };
    let is_recorded = match last.state {
        VersionState::Registered => last.number > parent,
        VersionState::Refused => is_left(last.number) && !has_news_since(store, split, last).await?,
    };
    Ok(is_recorded.then(|| last.clone()))
}

/// Whether structures were accepted, or labels changed, since an attempt.
async fn has_news_since(
    store: &Store,
    split: &LabelSplit,
    attempt: &VersionRecord,
) -> Result<bool, StoreError> {
    let (set, _) = split.label_set(store).await?.unwrap_or_default();
    let before = attempt.figures[LABEL_SET].as_str();
    Ok(store.accepted_structures().await? != attempt.structures || before.is_some_and(|before| before != set))
}
