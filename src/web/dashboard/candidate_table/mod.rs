//! The table of candidates, one page at a time. A request scans a limited number of candidates. If a filter matches
//! few of them, the response says how many were scanned and where to continue.

mod columns;
pub mod download;
mod query;
mod sorted;

use std::collections::{BTreeMap, HashMap};

use atoms::Species;
use axum::extract::{RawQuery, State};
use monitor::candidate_errors::ErrorReader;
use serde_json::json;
use store::{JobState, ListCursor, ListOrder, ListedCandidate, NO_LABEL_VALUE, Store, StoreError};
use wire::{WalkConditions, WalkId};

use self::columns::TableRow;
use self::query::{CandidateQuery, PagePlace, TableOrder};
use super::Dashboard;
use super::response::{ApiResult, json};
use crate::filter::{StructureFilter, StructureProperties, species};

/// Largest number of rows of a page, and the number without `limit`.
const MAX_PAGE_ROWS: u32 = 200;
const DEFAULT_ROWS: u32 = 50;
/// Candidates read at a time when rows are filtered, and the largest number scanned for a response.
const SCAN_ROWS: u32 = 1000;
const MAX_SCANNED: usize = 10_000;
/// Up to this number of jobs, those of a state lead to its candidates. With more, they are found among all candidates.
const MAX_JOBS_OF_STATE: u32 = 100_000;

/// Rows of the table.
#[derive(Debug, Default)]
struct CandidatePage {
    rows: Vec<ListedCandidate>,
    /// Cursor of the next page. `None` at the end.
    next: Option<ListCursor>,
    scanned: usize,
}

/// `versions` are those of the potential by row; null in a campaign whose walks all have version 0. `errors` are by row too.
///
/// `GET /api/candidates?order=…&ascending=…&fate=…&state=…&where=…&after=…&limit=…`
pub async fn page(State(dashboard): State<Dashboard>, RawQuery(query): RawQuery) -> ApiResult {
    let query = CandidateQuery::parse(query.as_deref().unwrap_or_default())?;
    let store = &dashboard.store;
    let versions = store.walk_versions().await?;
    let mut reader = ErrorReader::new(store).await?;
    let (rows, next, scanned, sorted) = if let TableOrder::Column(column) = query.order {
        let found = sorted::page(&query, column, store, &versions, &mut reader).await?;
        (found.rows, found.next, found.scanned, Some(found.among))
    } else {
        let CandidatePage { rows, next, scanned } = query.page(store).await?;
        let mut rows: Vec<_> = rows.into_iter().map(|one| TableRow::new(one, &versions)).collect();
        columns::read_errors(&mut rows, store, &mut reader).await?;
        (rows, next.map(PagePlace::Behind), scanned, None)
    };
    let imported = match query.state.filter(|_| query.order == TableOrder::Queue) {
        Some(state) => Some(store.imported_jobs(state).await?),
        None => None,
    };
    let of_rows = || rows.iter().map(|row| row.version).collect::<Vec<_>>();
    let version_of_rows = (!versions.is_single()).then(of_rows);
    let errors: Vec<_> = rows.iter().map(|row| row.errors).collect();
    let candidates: Vec<_> = rows.iter().map(|row| &row.candidate).collect();
    json(&json!({
        "candidates": candidates, "versions": version_of_rows, "errors": errors, "next": next.map(PagePlace::text),
        "scanned": scanned, "imported": imported, "sorted_among": sorted,
    }))
}

impl CandidateQuery {
    /// A page in an order that has an index.
    async fn page(&self, store: &Store) -> Result<CandidatePage, StoreError> {
        let limit = self.limit.unwrap_or(DEFAULT_ROWS);
        self.collect(store, self.cursor(), limit as usize, MAX_SCANNED).await
    }

    /// At most `limit` matching rows behind a cursor, in an order that has an index.
    async fn collect(
        &self,
        store: &Store,
        after: Option<ListCursor>,
        limit: usize,
        max_scanned: usize,
    ) -> Result<CandidatePage, StoreError> {
        let state = self.leading_state(store).await?;
        let window = if self.filters_rows(state) { SCAN_ROWS } else { SCAN_ROWS.min(limit as u32) };
        let (mut page, mut place, mut elements) = (CandidatePage::default(), after, HashMap::new());
        let conditions = match self.filter {
            Some(_) => store.walk_conditions().await?,
            None => BTreeMap::new(),
        };
        loop {
            let rows = self.rows(store, state, place, window).await?;
            let is_last = rows.len() < window as usize;
            for row in rows {
                page.scanned += 1;
                place = Some(self.cursor_of(&row));
                if self.matches(&row, &mut elements, &conditions) {
                    page.rows.push(row);
                }
                if page.rows.len() == limit {
                    page.next = place;
                    return Ok(page);
                }
            }
            if is_last || page.scanned >= max_scanned {
                page.next = place.filter(|_| !is_last);
                return Ok(page);
            }
        }
    }

    /// Whether rows that are read may be filtered out. `leading`: see [`Self::leading_state`].
    fn filters_rows(&self, leading: Option<JobState>) -> bool {
        let by_fate = self.fate.is_some() && !self.is_by_decision() && leading.is_none();
        let by_state = self.state.is_some() && self.order != TableOrder::Queue && leading.is_none();
        by_fate || by_state || self.filter.is_some()
    }

    /// The state whose jobs lead to the rows; `None` where an index of candidates does.
    async fn leading_state(&self, store: &Store) -> Result<Option<JobState>, StoreError> {
        let Some(state) = self.state.filter(|_| self.order != TableOrder::Queue) else { return Ok(None) };
        let is_of_walk = self.is_by_decision() && self.only_walk().is_some();
        let has_many = is_of_walk || store.has_more_jobs(state, MAX_JOBS_OF_STATE).await?;
        Ok((!has_many).then_some(state))
    }

    /// Rows as they are read, in an order that has an index. `leading`: see [`Self::leading_state`].
    async fn rows(
        &self,
        store: &Store,
        leading: Option<JobState>,
        after: Option<ListCursor>,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>, StoreError> {
        // By a column, the newest are sorted.
        let descending = !self.ascending || matches!(self.order, TableOrder::Column(_));
        let order = match self.order {
            TableOrder::Gamma => ListOrder::Gamma,
            TableOrder::RelativeVolume => ListOrder::Volume,
            TableOrder::Decision | TableOrder::Queue | TableOrder::Column(_) => ListOrder::Decision,
        };
        let (origin, reason) = match self.fate.as_deref() {
            None => (None, None),
            Some("control") => (Some("control"), None),
            Some("accepted") => (Some("biased"), None),
            Some(reason) => (Some("biased"), Some(reason)),
        };
        match (leading, self.state, self.only_walk(), origin) {
            (_, Some(state), ..) if self.order == TableOrder::Queue => {
                store.list_queue(state, after, limit).await
            }
            // What was declined has no label job.
            (_, Some(_), ..) if reason.is_some() => Ok(Vec::new()),
            (_, _, Some(walk), _) if self.is_by_decision() => {
                let after = after.map(|place| place.decision);
                store.list_decided_of_walk(walk, descending, after, limit).await
            }
            (Some(state), ..) => store.list_state(state, origin, (order, descending), after, limit).await,
            (.., Some(origin)) if self.is_by_decision() => {
                let after = after.map(|place| place.decision);
                store.list_fate(origin, reason, descending, after, limit).await
            }
            _ => store.list_candidates(order, descending, after, limit).await,
        }
    }

    /// Whether rows are read in the order of the decisions.
    fn is_by_decision(&self) -> bool {
        matches!(self.order, TableOrder::Decision | TableOrder::Column(_))
    }

    /// The only walk whose candidates can match.
    fn only_walk(&self) -> Option<u32> {
        self.filter.as_ref().and_then(StructureFilter::only_walk)
    }

    fn cursor_of(&self, row: &ListedCandidate) -> ListCursor {
        let value = match self.order {
            TableOrder::Decision | TableOrder::Column(_) => None,
            TableOrder::Gamma => row.gamma,
            TableOrder::RelativeVolume => row.relative_volume,
            TableOrder::Queue => Some(row.value.unwrap_or(NO_LABEL_VALUE)),
        };
        let priority = row.priority.unwrap_or_default();
        ListCursor { priority, value: value.unwrap_or_default(), decision: row.decision }
    }

    /// `elements` caches the species of formulas.
    fn matches(
        &self,
        row: &ListedCandidate,
        elements: &mut HashMap<String, Vec<Species>>,
        conditions: &BTreeMap<WalkId, WalkConditions>,
    ) -> bool {
        let fate = if row.origin == "control" { "control" } else { &row.fate };
        if self.fate.as_deref().is_some_and(|wanted| wanted != fate) {
            return false;
        }
        if self.state.is_some_and(|wanted| row.job_state.as_deref() != Some(wanted.name())) {
            return false;
        }
        let Some(filter) = &self.filter else { return true };
        let species = elements.entry(row.formula.clone()).or_insert_with(|| species(&row.formula));
        filter.matches(&properties(row, species, conditions.get(&WalkId(row.walk))))
    }
}

/// Properties for the filter, the same as in `calmwalk export`.
fn properties<'a>(
    row: &'a ListedCandidate,
    species: &'a [Species],
    conditions: Option<&'a WalkConditions>,
) -> StructureProperties<'a> {
    StructureProperties {
        gamma: row.gamma,
        gamma_current: row.selector_gamma,
        gamma_nbr: row.gamma_nbr,
        relative_volume: row.relative_volume,
        kinetic_temperature: row.temperature,
        conditions,
        walk: Some(row.walk),
        step: Some(row.step),
        mixture_version: Some(row.mixture_version),
        energy: row.energy,
        max_force: row.max_force,
        retry_adjustments: row.retry_adjustments.as_deref(),
        // The list has no positions.
        fragments: None,
        species,
        origin: &row.origin,
        seed_structure: Some(&row.seed_structure),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formulas_are_atoms() {
        let symbols = |formula| species(formula).iter().map(|s| s.symbol()).collect::<Vec<_>>().join(" ");
        assert_eq!(symbols("Al3MoN2"), "Al Al Al Mo N N");
        assert_eq!(symbols("C"), "C");
        assert_eq!(symbols(""), "");
        assert_eq!(symbols("Xx2é9"), "");
    }
}
