//! Pages of the candidate table. Each query reads an index from the first row of the page, so its cost does not
//! depend on the number of rows; those of a state read the jobs that have it, those within limits a range of decisions.

use std::ops::Range;

use super::label_row::LabelRow;
use super::label_values::decode_factors;
use crate::Store;
use crate::checksum::{CANDIDATE, DECISION, Names, joined};
use crate::database::{FromRow, SqlRow, query};
use crate::error::Result;
use crate::listing::{ListCursor, ListLimits, ListOrder, ListedCandidate};
use crate::records::{JobState, Label};

impl FromRow for ListedCandidate {
    fn from_row(row: &SqlRow) -> Result<Self> {
        CANDIDATE.verify(row, Names::Joined)?;
        DECISION.verify(row, Names::Joined)?;
        let reason: Option<String> = row.get("candidate__reason")?;
        let has_label = row.get::<Option<String>>("status")?.is_some();
        let label =
            has_label.then(|| LabelRow::from_row(row)?.into_record()).transpose()?.map(|found| found.label);
        Ok(Self {
            decision: row.get("candidate__decision")?,
            id: row.get("candidate__id")?,
            origin: row.get("candidate__origin")?,
            fate: reason.map_or_else(|| row.get("candidate__fate"), Ok)?,
            walk: row.get("candidate__walk")?,
            segment: row.get("candidate__segment")?,
            step: row.get("candidate__step")?,
            seed_structure: row.get("seed_name")?,
            mixture_version: row.get("decision__mixture_version")?,
            atoms: row.get("candidate__atoms")?,
            formula: row.get("candidate__formula")?,
            temperature: row.get("candidate__temperature")?,
            relative_volume: row.get("candidate__relative_volume")?,
            walker_gamma: row.get("candidate__walker_gamma")?,
            selector_gamma: row.get("candidate__selector_gamma")?,
            gamma: row.get("candidate__original_gamma")?,
            gamma_nbr: row.get("candidate__original_gamma_nbr")?,
            job_state: row.get("job_state")?,
            priority: row.get("priority")?,
            attempts: row.get("attempts")?,
            value: row.get("job_value")?,
            value_factors: decode_factors(row.get::<Option<String>>("value_factors")?.as_deref())?,
            potential_energy: row.get("candidate__energy")?,
            energy: label.as_ref().map(|label| label.energy),
            max_force: label.as_ref().map(Label::max_force),
            retry_adjustments: label.map(|label| label.details.retry_adjustments),
        })
    }
}

macro_rules! lines {
    ($($rest:expr),*) => {
        concat!(
            "SELECT ",
            joined!(candidate),
            ", ",
            joined!(decision),
            ", coalesce(name, '') AS seed_name, job.state AS job_state, priority, attempts, job.value AS job_value,
            value_factors, label.* ",
            $($rest),*
        )
    };
}

/// What belongs to the candidates of a page.
macro_rules! joins {
    () => {
        " LEFT JOIN job ON job.number = (SELECT max(newest.number) FROM job AS newest
                                        WHERE newest.structure = candidate.structure)
        LEFT JOIN label ON label.structure = candidate.structure AND label.protocol = job.protocol
            AND status = 'label'
        CROSS JOIN decision ON sequence = candidate.decision
        LEFT JOIN seed_structure ON seed_structure.seed = candidate.seed_structure"
    };
}

macro_rules! page {
    ($which:literal, $order:literal, $limit:literal) => {
        lines!("FROM candidate", joins!(), " WHERE ", $which, " ORDER BY ", $order, " LIMIT ", $limit)
    };
}

pub(crate) const NEWEST: &str = page!("candidate.decision < $1", "candidate.decision DESC", "$2");
pub(crate) const OLDEST: &str = page!("candidate.decision > $1", "candidate.decision", "$2");

pub(crate) const NEWEST_OF_FATE: &str = page!(
    "candidate.decision < $1 AND origin = $2 AND fate = $3 AND candidate.reason IS NOT DISTINCT FROM $4",
    "candidate.decision DESC",
    "$5"
);
pub(crate) const OLDEST_OF_FATE: &str = page!(
    "candidate.decision > $1 AND origin = $2 AND fate = $3 AND candidate.reason IS NOT DISTINCT FROM $4",
    "candidate.decision",
    "$5"
);

// In both directions, the order has the finite values.
pub(crate) const LARGEST_GAMMA: &str = page!(
    "(original_gamma, candidate.decision) < ($1, $2)",
    "original_gamma DESC, candidate.decision DESC",
    "$3"
);
pub(crate) const SMALLEST_GAMMA: &str = page!(
    "(original_gamma, candidate.decision) > ($1, $2) AND original_gamma <= 1.7976931348623157e308",
    "original_gamma, candidate.decision",
    "$3"
);

pub(crate) const LARGEST_VOLUME: &str = page!(
    "(relative_volume, candidate.decision) < ($1, $2)",
    "relative_volume DESC, candidate.decision DESC",
    "$3"
);
pub(crate) const SMALLEST_VOLUME: &str = page!(
    "(relative_volume, candidate.decision) > ($1, $2) AND relative_volume <= 1.7976931348623157e308",
    "relative_volume, candidate.decision",
    "$3"
);

/// Candidates of a walk, ordered by name.
pub(crate) const OF_WALK: &str = page!("id >= $1 AND id < $1 || '~'", "id", "$2");

/// The index of names gives the decisions of a walk. With a plus, SQLite does not search the decisions of all walks for them.
macro_rules! decided_of_walk {
    ($compare:literal, $way:literal) => {
        lines!(
            "FROM (SELECT decision AS place FROM candidate WHERE id >= $1 AND id < $1 || '~' AND +decision ",
            $compare,
            " $2 ORDER BY +decision",
            $way,
            " LIMIT $3) AS page CROSS JOIN candidate ON candidate.decision = place",
            joins!(),
            " ORDER BY candidate.decision",
            $way
        )
    };
}

pub(crate) const NEWEST_OF_WALK: &str = decided_of_walk!("<", " DESC");
pub(crate) const OLDEST_OF_WALK: &str = decided_of_walk!(">", "");

/// Candidates whose newest job has the state `$1`, found in two ways. An origin of NULL stands for both.
pub(crate) struct OfState {
    /// Searches the first candidates of the order.
    pub near: &'static str,
    /// The jobs of the state lead to their candidates: all of them are read.
    pub all: &'static str,
}

macro_rules! of_state {
    ($which:literal, $order:literal) => {
        OfState {
            near: lines!(
                "FROM (SELECT decision AS place
                    FROM (SELECT decision, structure, origin, original_gamma, relative_volume FROM candidate WHERE ",
                $which,
                " ORDER BY ",
                $order,
                " LIMIT 4000) AS candidate
                    WHERE ($2 IS NULL OR origin = $2)
                    AND EXISTS (SELECT 1 FROM job WHERE job.structure = candidate.structure AND job.state = $1
                                AND NOT EXISTS (SELECT 1 FROM job AS newer
                                                WHERE newer.structure = job.structure AND newer.number > job.number))
                    ORDER BY ",
                $order,
                " LIMIT $3) AS page CROSS JOIN candidate ON candidate.decision = place",
                joins!(),
                " ORDER BY ",
                $order
            ),
            all: lines!(
                "FROM (SELECT candidate.decision AS place FROM job
                    CROSS JOIN candidate ON candidate.structure = job.structure
                    WHERE job.state = $1 AND ($2 IS NULL OR origin = $2)
                    AND NOT EXISTS (SELECT 1 FROM job AS newer
                                    WHERE newer.structure = job.structure AND newer.number > job.number)
                    AND ",
                $which,
                " ORDER BY ",
                $order,
                " LIMIT $3) AS page CROSS JOIN candidate ON candidate.decision = place",
                joins!(),
                " ORDER BY ",
                $order
            ),
        }
    };
}

pub(crate) const NEWEST_OF_STATE: OfState = of_state!("candidate.decision < $4", "candidate.decision DESC");
pub(crate) const OLDEST_OF_STATE: OfState = of_state!("candidate.decision > $4", "candidate.decision");
pub(crate) const LARGEST_GAMMA_OF_STATE: OfState = of_state!(
    "(original_gamma, candidate.decision) < ($5, $4)",
    "original_gamma DESC, candidate.decision DESC"
);
pub(crate) const SMALLEST_GAMMA_OF_STATE: OfState = of_state!(
    "(original_gamma, candidate.decision) > ($5, $4) AND original_gamma <= 1.7976931348623157e308",
    "original_gamma, candidate.decision"
);
pub(crate) const LARGEST_VOLUME_OF_STATE: OfState = of_state!(
    "(relative_volume, candidate.decision) < ($5, $4)",
    "relative_volume DESC, candidate.decision DESC"
);
pub(crate) const SMALLEST_VOLUME_OF_STATE: OfState = of_state!(
    "(relative_volume, candidate.decision) > ($5, $4) AND relative_volume <= 1.7976931348623157e308",
    "relative_volume, candidate.decision"
);

/// With more jobs than this, fewer rows are read where [`OfState::near`] searches, which often fills a short page.
const MANY_JOBS: u32 = 4000;
const SHORT_PAGE: u32 = 200;

/// A range of the table is read for the decisions, or of the index of fates; only the rows of the page with what belongs to them.
macro_rules! within {
    ($fate:literal, $way:literal) => {
        lines!(
            "FROM (SELECT decision AS place FROM candidate WHERE decision >= $1 AND decision < $2
                AND ($4 IS NULL OR original_gamma >= $4) AND ($5 IS NULL OR original_gamma <= $5)
                AND ($6 IS NULL OR relative_volume >= $6) AND ($7 IS NULL OR relative_volume <= $7)",
            $fate,
            " ORDER BY decision",
            $way,
            " LIMIT $3) AS page CROSS JOIN candidate ON candidate.decision = place",
            joins!(),
            " ORDER BY candidate.decision",
            $way
        )
    };
}

macro_rules! within_fate {
    ($way:literal) => {
        within!(" AND origin = $8 AND fate = $9 AND reason IS NOT DISTINCT FROM $10", $way)
    };
}

pub(crate) const NEWEST_WITHIN: &str = within!("", " DESC");
pub(crate) const OLDEST_WITHIN: &str = within!("", "");
pub(crate) const NEWEST_WITHIN_FATE: &str = within_fate!(" DESC");
pub(crate) const OLDEST_WITHIN_FATE: &str = within_fate!("");

const MORE_JOBS_THAN: &str =
    "SELECT count(*) > $2 FROM (SELECT 1 AS one FROM job WHERE state = $1 LIMIT $2 + 1) AS found";

/// The index gives the jobs; only those of the page are read. Jobs of imported structures, whose numbers are above all
/// decisions, are left out.
pub(crate) const QUEUE: &str = lines!(
    "FROM (SELECT number AS place FROM job WHERE state = $1 AND priority <= $2
              AND (priority < $2 OR coalesce(value, -1) < $3 OR (coalesce(value, -1) = $3 AND decision > $4))
              AND decision < 1099511627776 ORDER BY priority DESC, value DESC NULLS LAST, decision LIMIT $5) AS page
        CROSS JOIN job ON job.number = place
        CROSS JOIN candidate ON candidate.decision = job.decision
        CROSS JOIN decision ON sequence = candidate.decision
        LEFT JOIN label ON label.structure = candidate.structure AND label.protocol = job.protocol
            AND status = 'label'
        LEFT JOIN seed_structure ON seed_structure.seed = candidate.seed_structure
        ORDER BY job.priority DESC, job.value DESC NULLS LAST, job.decision"
);

impl Store {
    /// At most `limit` candidates after a cursor (`None`: from the first), in descending order if `descending`.
    pub async fn list_candidates(
        &self,
        order: ListOrder,
        descending: bool,
        after: Option<ListCursor>,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>> {
        let ListCursor { value, decision, .. } = after.unwrap_or(first(descending));
        let query = match (order, descending) {
            (ListOrder::Decision, true) => query(NEWEST),
            (ListOrder::Decision, false) => query(OLDEST),
            (ListOrder::Gamma, true) => query(LARGEST_GAMMA).bind(value),
            (ListOrder::Gamma, false) => query(SMALLEST_GAMMA).bind(value),
            (ListOrder::Volume, true) => query(LARGEST_VOLUME).bind(value),
            (ListOrder::Volume, false) => query(SMALLEST_VOLUME).bind(value),
        };
        query.bind(decision).bind(limit).fetch_all(&self.database).await
    }

    /// The same in decision order, for one origin and fate. `reason` belongs to `declined`.
    pub async fn list_fate(
        &self,
        origin: &str,
        reason: Option<&str>,
        descending: bool,
        after: Option<i64>,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>> {
        let fate = if reason.is_some() { "declined" } else { "accepted" };
        let query = query(if descending { NEWEST_OF_FATE } else { OLDEST_OF_FATE });
        let query = query.bind(after.unwrap_or(first(descending).decision)).bind(origin).bind(fate);
        query.bind(reason).bind(limit).fetch_all(&self.database).await
    }

    /// Candidates whose jobs have a state, in the order in which they would be leased: by priority, then by value, then in
    /// decision order.
    pub async fn list_queue(
        &self,
        state: JobState,
        after: Option<ListCursor>,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>> {
        let ListCursor { priority, value, decision } =
            after.unwrap_or(ListCursor { decision: 0, ..first(true) });
        let query = query(QUEUE).bind(state.name()).bind(priority).bind(value).bind(decision);
        query.bind(limit).fetch_all(&self.database).await
    }

    /// At most `limit` of the candidates of these decisions that are within limits, in decision order. `fate`: origin and reason as
    /// for [`Self::list_fate`]; `None` for any.
    pub async fn list_within(
        &self,
        decisions: Range<i64>,
        limits: ListLimits,
        fate: Option<(&str, Option<&str>)>,
        descending: bool,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>> {
        let sql = match (fate.is_some(), descending) {
            (false, true) => NEWEST_WITHIN,
            (false, false) => OLDEST_WITHIN,
            (true, true) => NEWEST_WITHIN_FATE,
            (true, false) => OLDEST_WITHIN_FATE,
        };
        let query = query(sql).bind(decisions.start).bind(decisions.end).bind(limit);
        let values = limits.gamma.into_iter().chain(limits.relative_volume);
        let query = values.fold(query, |query, value| query.bind(value));
        let query = match fate {
            Some((origin, reason)) => {
                let fate = if reason.is_some() { "declined" } else { "accepted" };
                query.bind(origin).bind(fate).bind(reason)
            }
            None => query,
        };
        query.fetch_all(&self.database).await
    }

    /// The newest decision on a candidate; 0 without one.
    pub async fn newest_candidate(&self) -> Result<i64> {
        query("SELECT coalesce(max(decision), 0) FROM candidate").fetch_one(&self.database).await
    }

    /// At most `limit` candidates whose newest label job has a state, of one origin or (`None`) both, as
    /// [`Self::list_candidates`]. Reads all jobs of that state, unless there are many and a short page is found near the cursor.
    pub async fn list_state(
        &self,
        state: JobState,
        origin: Option<&str>,
        (order, descending): (ListOrder, bool),
        after: Option<ListCursor>,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>> {
        let ListCursor { value, decision, .. } = after.unwrap_or(first(descending));
        let sql = match (order, descending) {
            (ListOrder::Decision, true) => NEWEST_OF_STATE,
            (ListOrder::Decision, false) => OLDEST_OF_STATE,
            (ListOrder::Gamma, true) => LARGEST_GAMMA_OF_STATE,
            (ListOrder::Gamma, false) => SMALLEST_GAMMA_OF_STATE,
            (ListOrder::Volume, true) => LARGEST_VOLUME_OF_STATE,
            (ListOrder::Volume, false) => SMALLEST_VOLUME_OF_STATE,
        };
        let rows = async |sql| {
            let query = query(sql).bind(state.name()).bind(origin).bind(limit).bind(decision);
            let query = if order == ListOrder::Decision { query } else { query.bind(value) };
            query.fetch_all(&self.database).await
        };
        if limit <= SHORT_PAGE && self.has_more_jobs(state, MANY_JOBS).await? {
            let near: Vec<_> = rows(sql.near).await?;
            if near.len() == limit as usize {
                return Ok(near);
            }
        }
        rows(sql.all).await
    }

    /// Whether more than `number` label jobs have a state. Counts no further.
    pub async fn has_more_jobs(&self, state: JobState, number: u32) -> Result<bool> {
        query(MORE_JOBS_THAN).bind(state.name()).bind(number).fetch_one(&self.database).await
    }

    /// Candidates of a walk, ordered by step. Returns only some if the walk has more than `limit`.
    pub async fn list_walk(&self, walk: u32, limit: u32) -> Result<Vec<ListedCandidate>> {
        let query = query(OF_WALK).bind(self.names_of_walk(walk).await?).bind(limit);
        let mut found: Vec<ListedCandidate> = query.fetch_all(&self.database).await?;
        found.sort_by_key(|candidate| (candidate.segment, candidate.step, candidate.decision));
        Ok(found)
    }

    /// At most `limit` candidates of a walk in decision order, as [`Self::list_fate`].
    pub async fn list_decided_of_walk(
        &self,
        walk: u32,
        descending: bool,
        after: Option<i64>,
        limit: u32,
    ) -> Result<Vec<ListedCandidate>> {
        let query = query(if descending { NEWEST_OF_WALK } else { OLDEST_OF_WALK });
        let query =
            query.bind(self.names_of_walk(walk).await?).bind(after.unwrap_or(first(descending).decision));
        query.bind(limit).fetch_all(&self.database).await
    }

    /// What the names of a walk's candidates begin with.
    async fn names_of_walk(&self, walk: u32) -> Result<String> {
        let campaign = self.campaign_value("id").await?;
        Ok(format!("{}-{walk}.", campaign.get(..8).unwrap_or_default()))
    }
}

/// Before everything.
fn first(descending: bool) -> ListCursor {
    match descending {
        true => ListCursor { priority: i32::MAX, value: f64::MAX, decision: i64::MAX },
        false => ListCursor { priority: i32::MIN, value: f64::MIN, decision: 0 },
    }
}
