//! Commits: everything that the selector decided is written in one transaction.

mod rows;

use std::hash::{BuildHasher, RandomState};
use std::ops::Range;
use std::time::{Duration, Instant};

use self::rows::{
    CANDIDATE, CANDIDATE_COUNT, CANDIDATE_DATA, COMPONENT, CommitRows, DECISION, STRUCTURE, VALUE, WALK,
    WALK_CONDITIONS,
};
use super::new_jobs::insert_jobs;
use super::{assignments, protocols, trajectory, walk_trace};
use crate::Store;
use crate::database::{Transaction, execute_rows, query};
use crate::encoding::integer;
use crate::error::{Result, StoreError};
use crate::postgres::server::SERVER_RECONNECT_TIMEOUT;
use crate::records::Commit;

const RETRY_INTERVAL: Duration = Duration::from_secs(1);

const INSERT_DECISIONS: &str = "INSERT INTO decision ({columns}) SELECT * FROM {rows}";

/// An existing structure is not changed but locked: whether it has a label must not change until its job is
/// written.
const INSERT_STRUCTURES: &str = "INSERT INTO structure ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (hash) DO UPDATE SET atoms = excluded.atoms";

const INSERT_CANDIDATES: &str = "INSERT INTO candidate ({columns}, structure)
    SELECT new.*, (SELECT number FROM structure WHERE hash = new.content AND new.fate = 'accepted')
    FROM {rows} WHERE TRUE ON CONFLICT (id) DO NOTHING";

const INSERT_CANDIDATE_DATA: &str = "INSERT INTO candidate_data ({columns}) SELECT * FROM {rows}";

const UPSERT_COMPONENTS: &str = "INSERT INTO component ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (element, slot) DO UPDATE SET bytes = excluded.bytes, checksum = excluded.checksum";

const UPSERT_WALKS: &str = "INSERT INTO walk ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (walk) DO UPDATE SET {excluded}";

/// A walk that was interrupted in its first assignment has them already.
const INSERT_WALK_CONDITIONS: &str = "INSERT INTO walk_conditions ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (walk) DO NOTHING";

const COUNT_CANDIDATES: &str = "INSERT INTO candidate_count ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (origin, fate) DO UPDATE SET number = candidate_count.number + excluded.number";

const UPSERT_VALUES: &str = "INSERT INTO value ({columns}) SELECT * FROM {rows} WHERE TRUE
    ON CONFLICT (name) DO UPDATE SET value = excluded.value, checksum = excluded.checksum";

impl Store {
    /// Writes all decisions of a commit in one transaction, which is on disk when this returns. Returns the
    /// consecutive sequence numbers of the decisions. An accepted candidate gets a label job under the protocol in
    /// force, if there is one.
    ///
    /// Waits for a server that cannot be reached. If the reply to a commit was lost, looks up whether the commit
    /// was made: no commit is made twice.
    ///
    /// # Errors
    /// [`StoreError::DuplicateCandidate`] and [`StoreError::Inconsistent`] are errors of the caller.
    /// [`StoreError::LockLost`] if another process leads the campaign, see [`Store::fenced_by`]. After any error
    /// nothing is written.
    pub async fn commit(&self, commit: &Commit) -> Result<Range<i64>> {
        let mark = RandomState::new().hash_one("mark").cast_signed();
        let (started, mut again) = (Instant::now(), false);
        loop {
            match self.commit_once(commit, mark, again).await {
                Err(StoreError::Unreachable(_)) if started.elapsed() < SERVER_RECONNECT_TIMEOUT => {
                    again = true
                }
                done => return done,
            }
            tokio::time::sleep(RETRY_INTERVAL).await;
        }
    }

    /// Tries once; `again` is set if an earlier try may have succeeded.
    async fn commit_once(&self, commit: &Commit, mark: i64, again: bool) -> Result<Range<i64>> {
        // Copies everything before the transaction begins, so that no other writer waits for the copying.
        let mut rows = CommitRows::from_commit(commit)?;
        let (mut transaction, made) = self.database.begin_commit(mark, again).await?;
        let last = query("SELECT coalesce(max(sequence), 0) FROM decision");
        let last: i64 = last.fetch_one(&mut transaction).await?;
        let decisions = integer("number of decisions", commit.decisions.len() as u64)?;
        if made {
            return Ok(last - decisions + 1..last + 1);
        }
        let protocol =
            if rows.jobs.is_empty() { None } else { protocols::in_force(&mut transaction).await? };
        rows.number_from(last + 1, protocol);
        write(&mut transaction, commit, rows, last).await?;
        transaction.commit().await?;
        Ok(last + 1..last + 1 + decisions)
    }
}

/// `last` is the sequence number of the previous decision.
async fn write(transaction: &mut Transaction, commit: &Commit, rows: CommitRows, last: i64) -> Result<()> {
    execute_rows(transaction, INSERT_DECISIONS, &DECISION, rows.decisions).await?;
    execute_rows(transaction, INSERT_STRUCTURES, &STRUCTURE, rows.structures).await?;
    let written = execute_rows(transaction, INSERT_CANDIDATES, &CANDIDATE, rows.candidates).await?;
    if written < commit.candidates.len() as u64 {
        return Err(duplicate(transaction, commit, last).await?);
    }
    execute_rows(transaction, COUNT_CANDIDATES, &CANDIDATE_COUNT, rows.candidate_counts).await?;
    execute_rows(transaction, INSERT_CANDIDATE_DATA, &CANDIDATE_DATA, rows.candidate_data).await?;
    insert_jobs(transaction, rows.jobs).await?;
    if commit.restart_mixture {
        query("DELETE FROM component").execute(&mut *transaction).await?;
    }
    execute_rows(transaction, UPSERT_COMPONENTS, &COMPONENT, rows.components).await?;
    execute_rows(transaction, UPSERT_WALKS, &WALK, rows.walks).await?;
    execute_rows(transaction, INSERT_WALK_CONDITIONS, &WALK_CONDITIONS, rows.walk_conditions).await?;
    execute_rows(transaction, UPSERT_VALUES, &VALUE, rows.values).await?;
    assignments::append(transaction, commit).await?;
    trajectory::append(transaction, rows.trajectories).await?;
    walk_trace::append(transaction, &commit.traces).await
}

/// Finds the candidate that was committed before.
async fn duplicate(transaction: &mut Transaction, commit: &Commit, last: i64) -> Result<StoreError> {
    for id in commit.candidates.iter().map(|candidate| candidate.block.view().id().to_string()) {
        let before = query("SELECT id FROM candidate WHERE id = $1 AND decision <= $2").bind(&id).bind(last);
        if let Some(id) = before.fetch_optional::<String>(&mut *transaction).await? {
            return Ok(StoreError::DuplicateCandidate(id));
        }
    }
    Ok(StoreError::Inconsistent("candidates were not written".into()))
}
