//! The table of candidates, one page at a time. A request scans a limited number of candidates. If a filter matches
//! few of them, the response says how many were scanned and where to continue.

use std::collections::{BTreeMap, HashMap};
use std::str::FromStr;

use atoms::Species;
use axum::extract::{RawQuery, State};
use serde_json::json;
use store::{JobState, ListCursor, ListOrder, ListedCandidate, NO_LABEL_VALUE, Store, StoreError};
use wire::{WalkConditions, WalkId};

use super::Dashboard;
use super::response::{ApiError, ApiResult, json};
use crate::filter::{StructureFilter, StructureProperties, species};

/// Largest number of rows of a page.
const MAX_PAGE_ROWS: u32 = 200;
/// Candidates read at a time when rows are filtered, and the largest number scanned for a response.
const SCAN_ROWS: u32 = 1000;
const MAX_SCANNED: usize = 10_000;

/// Parameters of a request.
#[derive(Debug, Default)]
struct CandidateQuery {
    order: TableOrder,
    ascending: bool,
    fate: Option<String>,
    state: Option<JobState>,
    filter: Option<StructureFilter>,
    after: Option<ListCursor>,
    limit: Option<u32>,
}

/// Order of the rows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum TableOrder {
    #[default]
    Decision,
    Gamma,
    RelativeVolume,
    /// Order in which the jobs of one state would be labelled.
    Queue,
}

/// A page of the table.
#[derive(Debug, Default)]
struct CandidatePage {
    rows: Vec<ListedCandidate>,
    /// Cursor of the next page. `None` at the end.
    next: Option<ListCursor>,
    scanned: usize,
}

/// `versions` are those of the potential by row; null in a campaign whose walks all have version 0.
///
/// `GET /api/candidates?order=…&ascending=…&fate=…&state=…&where=…&after=…&limit=…`
pub async fn page(State(dashboard): State<Dashboard>, RawQuery(query): RawQuery) -> ApiResult {
    let query = CandidateQuery::parse(query.as_deref().unwrap_or_default())?;
    let CandidatePage { rows, next, scanned } = query.page(&dashboard.store).await?;
    let next = next.map(|place| format!("{:?}:{}:{}", place.value, place.decision, place.priority));
    let imported = match query.state.filter(|_| query.order == TableOrder::Queue) {
        Some(state) => Some(dashboard.store.imported_jobs(state).await?),
        None => None,
    };
    let versions = dashboard.store.walk_versions().await?;
    let of_rows = || rows.iter().map(|row| versions.version_of(row.walk)).collect::<Vec<_>>();
    let versions = (!versions.is_single()).then(of_rows);
    json(&json!({
        "candidates": rows, "versions": versions, "next": next, "scanned": scanned, "imported": imported,
    }))
}

impl CandidateQuery {
    fn parse(text: &str) -> Result<Self, ApiError> {
        let mut query = Self::default();
        for (key, value) in form_urlencoded::parse(text.as_bytes()).filter(|(_, value)| !value.is_empty()) {
            match key.as_ref() {
                "order" => query.order = value.parse()?,
                "ascending" => query.ascending = value == "true",
                "fate" => query.fate = Some(value.into_owned()),
                "state" => {
                    let unknown = || {
                        ApiError::bad_request(format!("state is '{value}', expected a state of label jobs"))
                    };
                    query.state = Some(JobState::named(&value).ok_or_else(unknown)?);
                }
                "where" => query.filter = Some(value.parse().map_err(ApiError::bad_request)?),
                "after" => query.after = Some(parse_cursor(&value)?),
                "limit" => {
                    let wrong = || {
                        ApiError::bad_request(format!("limit is '{value}', expected 1 to {MAX_PAGE_ROWS}"))
                    };
                    let limit = value.parse().ok().filter(|limit| (1..=MAX_PAGE_ROWS).contains(limit));
                    query.limit = Some(limit.ok_or_else(wrong)?);
                }
                _ => return Err(ApiError::bad_request(format!("unknown parameter '{key}'"))),
            }
        }
        if query.order == TableOrder::Queue && query.state.is_none() {
            return Err(ApiError::bad_request("the order 'queue' applies to one state: give 'state' too"));
        }
        Ok(query)
    }

    async fn page(&self, store: &Store) -> Result<CandidatePage, StoreError> {
        let limit = self.limit.unwrap_or(50);
        let window = if self.filters_rows() { SCAN_ROWS } else { limit };
        let (mut page, mut place, mut elements) = (CandidatePage::default(), self.after, HashMap::new());
        let conditions = match self.filter {
            Some(_) => store.walk_conditions().await?,
            None => BTreeMap::new(),
        };
        loop {
            let rows = self.rows(store, place, window).await?;
            let is_last = rows.len() < window as usize;
            for row in rows {
                page.scanned += 1;
                place = Some(self.cursor_of(&row));
                if self.matches(&row, &mut elements, &conditions) {
                    page.rows.push(row);
                }
                if page.rows.len() == limit as usize {
                    page.next = place;
                    return Ok(page);
                }
            }
            if is_last || page.scanned >= MAX_SCANNED {
                page.next = place.filter(|_| !is_last);
                return Ok(page);
            }
        }
    }

    /// Whether rows that are read may be filtered out.
    fn filters_rows(&self) -> bool {
        let by_fate = self.fate.is_some() && self.order != TableOrder::Decision;
        let by_state = self.state.is_some() && self.order != TableOrder::Queue;
        by_fate || by_state || self.filter.is_some()
    }

    async fn rows(
        &self,
        store: &Store,
        after: Option<ListCursor>,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>, StoreError> {
        let descending = !self.ascending;
        let order = match (self.order, self.state, self.fate.as_deref()) {
            (TableOrder::Queue, Some(state), _) => {
                return store.list_queue(state, after, limit).await;
            }
            (TableOrder::Decision, _, Some(fate)) => {
                let (origin, reason) = match fate {
                    "control" => ("control", None),
                    "accepted" => ("biased", None),
                    reason => ("biased", Some(reason)),
                };
                let after = after.map(|place| place.decision);
                return store.list_fate(origin, reason, descending, after, limit).await;
            }
            (TableOrder::Gamma, ..) => ListOrder::Gamma,
            (TableOrder::RelativeVolume, ..) => ListOrder::Volume,
            (TableOrder::Decision | TableOrder::Queue, ..) => ListOrder::Decision,
        };
        store.list_candidates(order, descending, after, limit).await
    }

    fn cursor_of(&self, row: &ListedCandidate) -> ListCursor {
        let value = match self.order {
            TableOrder::Decision => None,
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

impl FromStr for TableOrder {
    type Err = ApiError;

    fn from_str(name: &str) -> Result<Self, ApiError> {
        match name {
            "decision" => Ok(Self::Decision),
            "gamma" => Ok(Self::Gamma),
            "relative_volume" => Ok(Self::RelativeVolume),
            "queue" => Ok(Self::Queue),
            _ => Err(ApiError::bad_request(format!(
                "order is '{name}', expected one of decision, gamma, relative_volume, queue"
            ))),
        }
    }
}

fn parse_cursor(text: &str) -> Result<ListCursor, ApiError> {
    let read = |(value, place): (&str, &str)| {
        let value = value.parse().ok().filter(|value: &f64| value.is_finite())?;
        let (decision, priority) = place.split_once(':')?;
        Some(ListCursor { priority: priority.parse().ok()?, value, decision: decision.parse().ok()? })
    };
    let wrong = || ApiError::bad_request(format!("after is '{text}', expected 'next' of the previous page"));
    text.split_once(':').and_then(read).ok_or_else(wrong)
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

    #[test]
    fn queries_are_parsed_or_refused_with_a_reason() {
        let query =
            CandidateQuery::parse("order=gamma&ascending=true&fate=&where=gamma+%3E+2&after=2.5:17:10")
                .unwrap();
        assert!(query.order == TableOrder::Gamma && query.ascending && query.fate.is_none());
        assert_eq!(query.filter.unwrap().to_string(), "gamma > 2.0");
        assert_eq!(query.after, Some(ListCursor { priority: 10, value: 2.5, decision: 17 }));
        for (query, why) in [
            ("order=size", "expected one of decision"),
            ("order=queue", "give 'state'"),
            ("limit=0", "expected 1 to 200"),
            ("after=NaN:1", "expected 'next'"),
            ("where=gamma", "expected one of = != <"),
            ("sort=gamma", "unknown parameter 'sort'"),
        ] {
            let refused = format!("{:?}", CandidateQuery::parse(query).unwrap_err());
            assert!(refused.contains(why), "{query}: {refused}");
        }
    }
}
