//! A page in the order of a column without an index: the newest matching candidates, up to a bound, are read and sorted.

use monitor::candidate_errors::ErrorReader;
use serde::Serialize;
use store::{Store, StoreError, WalkVersions};

use super::columns::{SortColumn, TableRow, read_errors};
use super::query::{CandidateQuery, PagePlace};
use super::{DEFAULT_ROWS, MAX_READ};

/// Largest number of candidates whose errors are read to sort them.
const MAX_WITH_ERRORS: usize = 1000;

/// A page.
pub(super) struct SortedPage {
    pub rows: Vec<TableRow>,
    pub next: Option<PagePlace>,
    pub scanned: usize,
    pub among: SortedAmong,
    pub versions: WalkVersions,
}

/// What was sorted.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct SortedAmong {
    /// Number of matching candidates that have a value in the column.
    number: usize,
    /// Whether these are all that there are; otherwise the newest.
    all: bool,
}

/// The page of `query`. Candidates without a value are left out.
pub(super) async fn page(
    query: &CandidateQuery,
    column: SortColumn,
    store: &Store,
    reader: &mut ErrorReader,
) -> Result<SortedPage, StoreError> {
    let found = query.collect(store, None, MAX_READ, (MAX_READ, usize::MAX)).await?;
    let versions = store.walk_versions().await?;
    let mut is_all = found.next.is_none();
    let mut rows: Vec<_> = found.rows.into_iter().map(|one| TableRow::new(one, &versions)).collect();
    if column.is_error() {
        rows.retain(|row| row.candidate.energy.is_some());
        is_all &= rows.len() <= MAX_WITH_ERRORS;
        rows.truncate(MAX_WITH_ERRORS);
        read_errors(&mut rows, store, reader).await?;
    }
    let mut sorted: Vec<_> =
        rows.into_iter().filter_map(|row| column.value(&row).map(|value| (value, row))).collect();
    sorted.sort_by(|(a, of_a), (b, of_b)| {
        let order = a.compare(b).then(of_a.candidate.decision.cmp(&of_b.candidate.decision));
        if query.ascending { order } else { order.reverse() }
    });
    let among = SortedAmong { number: sorted.len(), all: is_all };
    let begin = match query.after {
        Some(PagePlace::Rows(number)) => number,
        _ => 0,
    };
    let limit = query.limit.unwrap_or(DEFAULT_ROWS) as usize;
    let next = begin.saturating_add(limit);
    let next = (next < sorted.len()).then_some(PagePlace::Rows(next));
    let mut rows: Vec<_> = sorted.into_iter().skip(begin).take(limit).map(|(_, row)| row).collect();
    if !column.is_error() {
        read_errors(&mut rows, store, reader).await?;
    }
    Ok(SortedPage { rows, next, scanned: found.scanned, among, versions })
}
