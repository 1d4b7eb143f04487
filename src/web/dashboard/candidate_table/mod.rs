//! The table of candidates, one page at a time. A request scans a limited number of candidates. If a filter matches
//! few of them, the response says how many were scanned and where to continue.

mod columns;
pub mod download;
mod query;
mod rows;
mod sorted;

use std::collections::{BTreeMap, HashMap};

use atoms::Species;
use axum::extract::{RawQuery, State};
use monitor::candidate_errors::ErrorReader;
use serde_json::json;
use store::{ListCursor, ListedCandidate, Store, StoreError};
use wire::{WalkConditions, WalkId};

use self::columns::TableRow;
use self::query::{CandidateQuery, PagePlace, TableOrder};
use self::rows::RowSource;
use super::Dashboard;
use super::response::{ApiResult, json};
use crate::filter::{StructureProperties, species};

/// Largest number of rows of a page, and the number without `limit`.
const MAX_PAGE_ROWS: u32 = 200;
const DEFAULT_ROWS: u32 = 50;
/// Candidates read at a time when rows are filtered, and the largest number read for a response.
const READ_ROWS: u32 = 1000;
const MAX_READ: usize = 10_000;
/// The largest number searched for a response, where the store reads only those within limits.
const MAX_SEARCHED: usize = 500_000;

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
    let mut reader = ErrorReader::new(store).await?;
    // Versions are read after the rows: before, they may lack walks that have begun meanwhile.
    let (rows, next, scanned, sorted, versions) = if let TableOrder::Column(column) = query.order {
        let found = sorted::page(&query, column, store, &mut reader).await?;
        (found.rows, found.next, found.scanned, Some(found.among), found.versions)
    } else {
        let CandidatePage { rows, next, scanned } = query.page(store).await?;
        let versions = store.walk_versions().await?;
        let mut rows: Vec<_> = rows.into_iter().map(|one| TableRow::new(one, &versions)).collect();
        columns::read_errors(&mut rows, store, &mut reader).await?;
        (rows, next.map(PagePlace::Behind), scanned, None, versions)
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
        self.collect(store, self.cursor(), limit as usize, (MAX_READ, MAX_SEARCHED)).await
    }

    /// At most `limit` matching rows behind a cursor, in an order that has an index. Ends after a number of candidates that were read,
    /// or that were searched.
    async fn collect(
        &self,
        store: &Store,
        after: Option<ListCursor>,
        limit: usize,
        (max_read, max_searched): (usize, usize),
    ) -> Result<CandidatePage, StoreError> {
        let source = self.row_source(store).await?;
        let window = match (self.filters_rows(source), source) {
            (false, _) => READ_ROWS.min(limit as u32),
            // Each reading goes through all jobs of the state.
            (true, RowSource::State(_)) => MAX_READ as u32,
            (true, _) => READ_ROWS,
        };
        let (mut page, mut place, mut elements) = (CandidatePage::default(), after, HashMap::new());
        let conditions = match self.filter {
            Some(_) => store.walk_conditions().await?,
            None => BTreeMap::new(),
        };
        let mut read = 0;
        loop {
            let found = self.read(store, source, place, window).await?;
            for (index, row) in found.rows.into_iter().enumerate() {
                read += 1;
                if !self.matches(&row, &mut elements, &conditions) {
                    continue;
                }
                place = Some(self.cursor_of(&row));
                page.rows.push(row);
                if page.rows.len() == limit {
                    page.scanned += found.first.map_or(index + 1, |first| {
                        first.abs_diff(page.rows[limit - 1].decision) as usize + 1
                    });
                    page.next = place;
                    return Ok(page);
                }
            }
            page.scanned += found.searched;
            place = found.next;
            if place.is_none() || read >= max_read || page.scanned >= max_searched {
                page.next = place;
                return Ok(page);
            }
        }
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
        // The list has no positions, and refuses such a filter.
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
