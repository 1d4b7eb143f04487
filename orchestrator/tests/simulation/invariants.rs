//! What must hold after every event, and at the end.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::LazyLock;

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{ConnectOptions, SqliteConnection};
use wire::messages::Assignment;

use super::dealing::SentMixtures;
use super::walker::WalkerKey;
use super::world::World;

/// What the world knows and the store must not forget.
#[derive(Default)]
pub struct Known {
    /// Number of decisions in commits that were acknowledged.
    pub decisions: i64,
    /// Accepted candidates of acknowledged commits.
    pub accepted: BTreeSet<String>,
    /// Assignments that were sent.
    pub sent: SentMixtures,
    /// Offers that arrived: the process and the number.
    pub offers: BTreeSet<(WalkerKey, u64)>,
    /// The answer to [`GROWING`].
    numbers: Vec<i64>,
}

/// Questions whose answer is 0, and what it means if not.
const MUST_BE_NONE: [(&str, &str); 13] = [
    ("decisions have gaps", "SELECT coalesce(max(sequence), 0) - count(*) FROM decision"),
    (
        "the version of the mixture decreases in the decision log",
        "SELECT count(*) FROM decision AS a JOIN decision AS b ON b.sequence = a.sequence + 1
         WHERE b.mixture_version < a.mixture_version",
    ),
    (
        "structures were accepted twice",
        "SELECT count(*) - count(DISTINCT content) FROM candidate WHERE fate = 'accepted' AND origin = 'biased'",
    ),
    (
        "candidates stand twice",
        "SELECT count(*) FROM (SELECT 1 FROM candidate GROUP BY walk, segment, step, content HAVING count(*) > 1)",
    ),
    (
        "decisions on candidates stand twice",
        "SELECT count(*) FROM (SELECT 1 FROM decision WHERE candidate IS NOT NULL GROUP BY candidate HAVING count(*) > 1)",
    ),
    (
        "ends of walks stand twice",
        "SELECT count(*) FROM (SELECT 1 FROM decision WHERE kind IN ('ended', 'resumed') GROUP BY walk
         HAVING sum(kind = 'ended') > 1 + sum(kind = 'resumed'))",
    ),
    (
        "accepted candidates have no job",
        "SELECT count(*) FROM candidate WHERE fate = 'accepted'
         AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = candidate.structure)",
    ),
    (
        "structures have two labels",
        "SELECT count(*) FROM (SELECT 1 FROM label WHERE status = 'label' GROUP BY structure, protocol HAVING count(*) > 1)",
    ),
    (
        "jobs are labelled without a label",
        "SELECT count(*) FROM job WHERE state = 'labelled' AND NOT EXISTS (
            SELECT 1 FROM label WHERE label.structure = job.structure AND status = 'label')",
    ),
    (
        "jobs wait although they have a label",
        "SELECT count(*) FROM job WHERE state IN ('queued', 'leased', 'failed') AND relabel IS NULL AND EXISTS (
            SELECT 1 FROM label WHERE label.structure = job.structure AND status = 'label')",
    ),
    (
        "losses of nodes count as attempts",
        "SELECT count(*) FROM attempt WHERE outcome = 'failed' AND class = 'node_failure'",
    ),
    (
        "leases and open attempts do not match",
        "SELECT count(*) FROM job WHERE (state = 'leased') <> (
            (SELECT count(*) FROM attempt WHERE job = job.number AND outcome IS NULL) = 1)
         OR (SELECT count(*) FROM attempt WHERE job = job.number AND outcome IS NULL) > 1",
    ),
    (
        "walks count other structures than they have",
        "SELECT count(*) FROM walk WHERE origin = 'biased' AND accepted <> (
            SELECT count(*) FROM candidate WHERE candidate.walk = walk.walk AND fate = 'accepted')",
    ),
];

/// Numbers that never become less: of decisions, labels, accepted candidates, assignments and attempts.
const GROWING: &str = "SELECT
    (SELECT count(*) FROM decision) || ',' || (SELECT count(*) FROM label) || ',' ||
    (SELECT count(*) FROM candidate WHERE fate = 'accepted') || ',' ||
    coalesce((SELECT group_concat(assignments) FROM (SELECT assignments FROM walk ORDER BY walk)), '') || ',' ||
    (SELECT count(*) FROM attempt)";

/// Both as one question.
static QUESTIONS: LazyLock<String> = LazyLock::new(|| {
    let all = MUST_BE_NONE.map(|(_, question)| format!("({question})"));
    format!("SELECT {}, ({GROWING})", all.join(" || ',' || "))
});

/// A connection to the database of a campaign, besides those of the store.
pub async fn connect(directory: &Path) -> SqliteConnection {
    SqliteConnectOptions::new().filename(directory.join(store::DATABASE)).connect().await.unwrap()
}

impl World {
    /// Checks the store after a write.
    pub fn check_store(&mut self) {
        if self.violation.is_some() {
            return;
        }
        if self.store.fence_broken {
            return self.fail("an orchestrator that was replaced has written".to_owned());
        }
        let (answers, numbers): (String, String) = self.ask(&QUESTIONS);
        let broken = answers.split(',').zip(MUST_BE_NONE).find(|(count, _)| *count != "0");
        if let Some((count, (what, _))) = broken {
            return self.fail(format!("{what} ({count})"));
        }
        if self.scenario.refits.is_some() {
            self.check_versions();
        }
        let numbers: Vec<i64> = numbers.split(',').filter_map(|number| number.parse().ok()).collect();
        // Walks begin only once, so the numbers have fixed places.
        let before = std::mem::replace(&mut self.known.numbers, numbers.clone());
        if before.len() == numbers.len()
            && before.iter().zip(&numbers).any(|(before, number)| number < before)
        {
            return self.fail(format!(
                "decisions, labels, assignments or attempts are gone: {before:?}, then {numbers:?}"
            ));
        }
        if numbers[0] < self.known.decisions || numbers[2] < self.known.accepted.len() as i64 {
            self.fail("an acknowledged commit is not in the store".to_owned());
        }
    }

    /// Labels exceed their budget by no more than what was under way when it was used up.
    fn check_budget(&mut self) {
        let Some(budget) = self.scenario.label_budget else { return };
        let (labels,): (i64,) = self.ask("SELECT count(*) FROM label WHERE status = 'label'");
        let limit = budget + u64::from(self.scenario.labellers);
        if labels.cast_unsigned() > limit {
            self.fail(format!("there are {labels} labels, with a budget of {budget}"));
        }
    }

    pub(super) fn ask<T>(&mut self, sql: &str) -> T
    where
        T: for<'r> sqlx::FromRow<'r, sqlx::sqlite::SqliteRow> + Send + Unpin,
    {
        let sql = sqlx::AssertSqlSafe(sql.to_owned());
        self.store.runtime.block_on(sqlx::query_as(sql).fetch_one(&mut self.direct)).unwrap()
    }

    /// An assignment that is sent continues from what is in the store.
    pub fn check_assignment(&mut self, assignment: &Assignment) {
        let walk = assignment.walk;
        let (stored,): (i64,) =
            self.ask(&format!("SELECT coalesce((SELECT assignments FROM walk WHERE walk = {walk}), -1)"));
        if stored != assignment.number.cast_signed() {
            self.fail(format!(
                "assignment {} of walk {walk} is sent, and the store has it at {stored}",
                assignment.number
            ));
        }
    }

    /// Checks a campaign that is over: nothing waits, and nothing that was accepted is lost.
    pub fn check_end(&mut self) {
        self.check_store();
        let (waiting,): (i64,) = self.ask("SELECT count(*) FROM job WHERE state IN ('queued', 'leased')");
        let (walks,): (i64,) = self.ask("SELECT count(*) FROM walk WHERE state IN ('waiting', 'running')");
        let is_used_up = self.scenario.label_budget.is_some();
        self.check_budget();
        if self.scenario.refits.is_some() {
            self.check_refits_at_end();
        }
        if waiting > 0 && !is_used_up || walks > 0 {
            self.fail(format!("the campaign has ended with {waiting} unfinished jobs and {walks} walks"));
        }
        let missing: Vec<String> = self
            .known
            .accepted
            .clone()
            .into_iter()
            .filter(|id| {
                let found: (i64,) = self.ask(&format!("SELECT count(*) FROM candidate WHERE id = '{id}'"));
                found.0 == 0
            })
            .collect();
        if !missing.is_empty() {
            self.fail(format!("accepted candidates are lost: {missing:?}"));
        }
    }
}
