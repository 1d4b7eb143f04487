//! Rows of the table as the store has them: which index leads to those of a query.

use std::ops::Range;

use store::{
    JobState, ListCursor, ListLimits, ListOrder, ListedCandidate, NO_LABEL_VALUE, Store, StoreError,
};

use super::query::{CandidateQuery, TableOrder};
use crate::filter::{NumberField, StructureFilter};

/// Up to this number of label jobs of a state, its candidates are found by them. With more, they are found among all candidates.
const MAX_JOBS_OF_STATE: u32 = 100_000;
/// Candidates, of a fate if one is asked for, that are searched at a time for those within limits.
const SEARCHED_CANDIDATES: u64 = 100_000;

/// How rows are found.
#[derive(Clone, Copy, Debug)]
pub(super) enum RowSource {
    /// The index of an order.
    Order,
    /// The label jobs of a state.
    State(JobState),
    /// The decisions, of which the store returns those within limits.
    Limits(LimitSearch),
}

/// A search for candidates within limits.
#[derive(Clone, Copy, Debug)]
pub(super) struct LimitSearch {
    limits: ListLimits,
    /// The newest decision.
    newest: i64,
    /// Decisions that are searched at a time.
    step: i64,
}

/// Rows that were read at once.
#[derive(Debug)]
pub(super) struct FoundRows {
    pub rows: Vec<ListedCandidate>,
    /// The decision at which the search for those within limits began.
    pub first: Option<i64>,
    /// Number of candidates that were searched for them.
    pub searched: usize,
    /// Where to continue; `None` at the end.
    pub next: Option<ListCursor>,
}

impl CandidateQuery {
    /// How the rows are found.
    pub async fn row_source(&self, store: &Store) -> Result<RowSource, StoreError> {
        if self.order == TableOrder::Queue || (self.is_by_decision() && self.only_walk().is_some()) {
            return Ok(RowSource::Order);
        }
        if let Some(state) = self.state
            && !store.has_more_jobs(state, MAX_JOBS_OF_STATE).await?
        {
            return Ok(RowSource::State(state));
        }
        let limits = |of| self.filter.as_ref().map_or([None; 2], |filter| filter.limits(of));
        let limits = ListLimits {
            gamma: limits(NumberField::Gamma),
            relative_volume: limits(NumberField::RelativeVolume),
        };
        if !self.is_by_decision() || limits == ListLimits::default() {
            return Ok(RowSource::Order);
        }
        let newest = store.newest_candidate().await?;
        let of_fate = match self.origin_and_reason() {
            (Some(origin), reason) => store.candidates_of_fate(origin, reason).await?,
            (None, _) => None,
        };
        Ok(RowSource::Limits(LimitSearch { limits, newest, step: search_step(newest, of_fate) }))
    }

    /// Whether rows that are read may be filtered out.
    pub fn filters_rows(&self, source: RowSource) -> bool {
        let is_order = matches!(source, RowSource::Order);
        let by_fate = self.fate.is_some() && is_order && !self.is_by_decision();
        let by_state = self.state.is_some() && is_order && self.order != TableOrder::Queue;
        by_fate || by_state || self.filter.is_some()
    }

    /// At most `limit` rows.
    pub async fn read(
        &self,
        store: &Store,
        source: RowSource,
        after: Option<ListCursor>,
        limit: u32,
    ) -> Result<FoundRows, StoreError> {
        // What was declined has no label job.
        if self.state.is_some() && self.origin_and_reason().1.is_some() {
            return Ok(FoundRows { rows: Vec::new(), first: None, searched: 0, next: None });
        }
        if let RowSource::Limits(search) = source {
            return self.read_within(store, search, after, limit).await;
        }
        let rows = self.read_in_order(store, source, after, limit).await?;
        let is_full = rows.len() == limit as usize;
        let next = rows.last().filter(|_| is_full).map(|last| self.cursor_of(last));
        Ok(FoundRows { first: None, searched: rows.len(), rows, next })
    }

    async fn read_in_order(
        &self,
        store: &Store,
        source: RowSource,
        after: Option<ListCursor>,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>, StoreError> {
        let (descending, decision) = (self.is_descending(), after.map(|place| place.decision));
        let order = match self.order {
            TableOrder::Gamma => ListOrder::Gamma,
            TableOrder::RelativeVolume => ListOrder::Volume,
            TableOrder::Decision | TableOrder::Queue | TableOrder::Column(_) => ListOrder::Decision,
        };
        let (origin, reason) = self.origin_and_reason();
        match (source, self.state, self.only_walk(), origin) {
            (RowSource::State(state), ..) => {
                store.list_state(state, origin, (order, descending), after, limit).await
            }
            (_, Some(state), ..) if self.order == TableOrder::Queue => {
                store.list_queue(state, after, limit).await
            }
            (_, _, Some(walk), _) if self.is_by_decision() => {
                store.list_decided_of_walk(walk, descending, decision, limit).await
            }
            (.., Some(origin)) if self.is_by_decision() => {
                store.list_fate(origin, reason, descending, decision, limit).await
            }
            _ => store.list_candidates(order, descending, after, limit).await,
        }
    }

    /// Rows within limits, of the next decisions.
    async fn read_within(
        &self,
        store: &Store,
        LimitSearch { limits, newest, step }: LimitSearch,
        after: Option<ListCursor>,
        limit: u32,
    ) -> Result<FoundRows, StoreError> {
        let (descending, after) = (self.is_descending(), after.map(|place| place.decision));
        let decisions = next_decisions(descending, after, newest, step);
        let (origin, reason) = self.origin_and_reason();
        let fate = origin.map(|origin| (origin, reason));
        let rows = store.list_within(decisions.clone(), limits, fate, descending, limit).await?;
        let (first, last) = (decisions.start, decisions.end - 1);
        let (reached, is_end) = match rows.last().filter(|_| rows.len() == limit as usize) {
            Some(row) => (row.decision, false),
            None if descending => (first, first <= 1),
            None => (last, last >= newest),
        };
        let begin = if descending { last } else { first };
        let searched = if decisions.is_empty() { 0 } else { begin.abs_diff(reached) as usize + 1 };
        let next = (!is_end).then_some(ListCursor { priority: 0, value: 0.0, decision: reached });
        Ok(FoundRows { rows, first: Some(begin), searched, next })
    }

    /// Where the rows behind a row begin.
    pub fn cursor_of(&self, row: &ListedCandidate) -> ListCursor {
        let value = match self.order {
            TableOrder::Decision | TableOrder::Column(_) => None,
            TableOrder::Gamma => row.gamma,
            TableOrder::RelativeVolume => row.relative_volume,
            TableOrder::Queue => Some(row.value.unwrap_or(NO_LABEL_VALUE)),
        };
        let priority = row.priority.unwrap_or_default();
        ListCursor { priority, value: value.unwrap_or_default(), decision: row.decision }
    }

    /// Whether rows are read in the order of the decisions.
    fn is_by_decision(&self) -> bool {
        matches!(self.order, TableOrder::Decision | TableOrder::Column(_))
    }

    /// By a column, the newest are sorted.
    fn is_descending(&self) -> bool {
        !self.ascending || matches!(self.order, TableOrder::Column(_))
    }

    /// The origin and the reason of the decline that a fate stands for.
    fn origin_and_reason(&self) -> (Option<&str>, Option<&str>) {
        match self.fate.as_deref() {
            None => (None, None),
            Some("control") => (Some("control"), None),
            Some("accepted") => (Some("biased"), None),
            Some(reason) => (Some("biased"), Some(reason)),
        }
    }

    /// The only walk whose candidates can match.
    fn only_walk(&self) -> Option<u32> {
        self.filter.as_ref().and_then(StructureFilter::only_walk)
    }
}

/// Number of decisions in which as many candidates as are searched at a time are expected, of those on `of_fate` candidates.
fn search_step(newest: i64, of_fate: Option<u64>) -> i64 {
    let expected = |number: u64| SEARCHED_CANDIDATES.saturating_mul(newest.unsigned_abs()) / number.max(1);
    let step = of_fate.map_or(SEARCHED_CANDIDATES, expected).max(SEARCHED_CANDIDATES);
    step.min(newest.unsigned_abs()).max(1).cast_signed()
}

/// At most `number` decisions up to the newest, behind one of them or from the first in this order on.
fn next_decisions(descending: bool, after: Option<i64>, newest: i64, number: i64) -> Range<i64> {
    match (descending, after) {
        (true, after) => {
            let end = after.unwrap_or(newest + 1).clamp(1, newest + 1);
            (end - number).max(1)..end
        }
        (false, after) => {
            let begin = after.unwrap_or(0).clamp(0, newest) + 1;
            begin..(begin + number).min(newest + 1)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_decision_is_searched_once_in_order() {
        for (descending, newest, number) in [
            (true, 7, 1),
            (false, 7, 1),
            (true, 7, 2),
            (false, 7, 2),
            (true, 14, 7),
            (false, 14, 7),
            (false, 0, 2),
        ] {
            let (mut found, mut after) = (Vec::new(), None);
            loop {
                let mut range: Vec<_> = next_decisions(descending, after, newest, number).collect();
                if descending {
                    range.reverse();
                }
                assert!(range.len() <= number as usize);
                let Some(last) = range.last() else { break };
                after = Some(*last);
                found.extend(range);
            }
            let mut expected: Vec<_> = (1..=newest).collect();
            if descending {
                expected.reverse();
            }
            assert_eq!(found, expected, "{descending} {newest} {number}");
        }
        for after in [i64::MIN, -1, 8, i64::MAX] {
            for descending in [false, true] {
                let range = next_decisions(descending, Some(after), 7, 2);
                assert!(range.start >= 1 && range.end <= 8, "{range:?}");
            }
        }
    }

    #[test]
    fn rare_fates_are_searched_in_larger_steps() {
        for (newest, of_fate, step) in [
            (0, None, 1),
            (70, None, 70),
            (70, Some(0), 70),
            (1_000_000, None, 100_000),
            (1_000_000, Some(1_000_000), 100_000),
            (1_000_000, Some(500_000), 200_000),
            (1_000_000, Some(1000), 1_000_000),
            (i64::MAX, Some(0), i64::MAX),
        ] {
            assert_eq!(search_step(newest, of_fate), step, "{newest} {of_fate:?}");
        }
    }
}
