//! Processes of a campaign, and the leases of dead ones.

use serde_json::json;

use super::attempt_end::{AttemptEnd, end_without_label};
use super::logs::insert_operation;
use crate::Store;
use crate::database::{Query, Transaction, query};
use crate::error::Result;
use crate::processes::ProcessRecord;

pub(crate) const LEASED: &str = "SELECT number, holder FROM job WHERE state = 'leased'";

const PROCESSES: &str = "SELECT * FROM process WHERE $1 IS NULL OR kind = $1 ORDER BY started, id";

/// The same on a server, which knows how long each process has been silent.
const PROCESSES_WITH_SILENCE: &str = "SELECT process.*, server_clock() - heard AS silence FROM process
    WHERE $1 IS NULL OR kind = $1 ORDER BY started, id";

impl Store {
    /// Processes of a kind, or all, ordered by start.
    pub async fn processes(&self, kind: Option<&str>) -> Result<Vec<ProcessRecord>> {
        select_kind(kind, self.database.has_clock()).fetch_all(&self.database).await
    }

    /// See [`Self::upsert_processes`].
    pub async fn upsert_process(&self, process: &ProcessRecord) -> Result<()> {
        self.upsert_processes(std::slice::from_ref(process)).await
    }

    /// Registers these processes or updates their records. Each replaces dead processes of its kind and number. A
    /// predecessor that is alive keeps its record, since its leases count only as long as it has one.
    pub async fn upsert_processes(&self, processes: &[ProcessRecord]) -> Result<()> {
        let mut transaction = self.database.begin().await?;
        let known = all(&mut transaction).await?;
        for process in processes {
            let place = |record: &ProcessRecord| (record.kind.clone(), record.number);
            let others =
                known.iter().filter(|other| other.id != process.id && place(other) == place(process));
            for other in others.filter(|other| other.is_dead()) {
                remove(&mut transaction, &other.id).await?;
            }
            insert(&mut transaction, process).await?;
        }
        transaction.commit().await
    }

    /// Removes a process that ended in order. With an orchestrator, its walkers are removed as well.
    pub async fn remove_process(&self, id: &str) -> Result<()> {
        let mut transaction = self.database.begin().await?;
        let sql = "DELETE FROM process WHERE kind = 'walker'
                   AND EXISTS (SELECT 1 FROM process WHERE id = $1 AND kind = 'orchestrator')";
        query(sql).bind(id).execute(&mut transaction).await?;
        remove(&mut transaction, id).await?;
        transaction.commit().await
    }

    /// Whether a refit is running: one of a run, or one that the user runs by hand.
    pub async fn is_refit_running(&self) -> Result<bool> {
        let refits = self.processes(Some(ProcessRecord::REFITTER)).await?;
        Ok(refits.iter().any(|found| !found.is_dead()))
    }

    /// Removes the records of refits that have ended on this host without doing so.
    pub async fn remove_dead_refits(&self) -> Result<()> {
        for found in self.processes(Some(ProcessRecord::REFITTER)).await? {
            if found.is_local() && found.is_dead() {
                self.remove_process(&found.id).await?;
            }
        }
        Ok(())
    }

    /// Releases leases whose holders are dead or not registered: a process is registered before it leases anything,
    /// and only a dead one loses its record. Does not count as failed attempts. Returns their number.
    pub async fn release_leases_of_dead_processes(&self, now: i64) -> Result<usize> {
        let mut transaction = self.database.begin().await?;
        let leased = leased(&mut transaction).await?;
        let mut living = all(&mut transaction).await?;
        living.retain(|process| !process.is_dead());
        let released = release_all_except(&living, leased, &mut transaction, now).await?;
        transaction.commit().await?;
        Ok(released)
    }

    /// Reclaims leases at the start of a run. The caller holds the [`crate::CampaignLock`] and is not registered
    /// yet, so no registered process works for the campaign, except labellers that are alive. Removes the records
    /// of all others and releases their leases, see [`Self::release_leases_of_dead_processes`]. Returns the number
    /// of leases released.
    pub async fn reclaim_leases(&self, now: i64) -> Result<usize> {
        let mut transaction = self.database.begin_as_leader().await?;
        let leased = leased(&mut transaction).await?;
        let lives_on =
            |process: &ProcessRecord| process.kind == ProcessRecord::LABELLER && !process.is_dead();
        let (living, gone): (Vec<_>, Vec<_>) = all(&mut transaction).await?.into_iter().partition(lives_on);
        for process in &gone {
            remove(&mut transaction, &process.id).await?;
        }
        let leases = release_all_except(&living, leased, &mut transaction, now).await?;
        let lost = gone.iter().filter(|process| process.kind != ProcessRecord::WALKER);
        let lost: Vec<_> = lost.map(|process| process.id.as_str()).collect();
        if leases > 0 || !lost.is_empty() {
            let detail = json!({ "processes": lost, "leases": leases });
            insert_operation(&mut transaction, now, "lost", &detail).await?;
        }
        transaction.commit().await?;
        Ok(leases)
    }
}

/// Every process.
pub(crate) async fn all(transaction: &mut Transaction) -> Result<Vec<ProcessRecord>> {
    select_kind(None, transaction.has_clock()).fetch_all(transaction).await
}

fn select_kind(kind: Option<&str>, has_clock: bool) -> Query {
    query(if has_clock { PROCESSES_WITH_SILENCE } else { PROCESSES }).bind(kind)
}

async fn insert(transaction: &mut Transaction, process: &ProcessRecord) -> Result<()> {
    let sql = "INSERT INTO process
        (id, kind, number, pid, start_time, host, started, last_seen, state, restarts, setup, remark)
        VALUES ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10, $11, $12)
        ON CONFLICT (id) DO UPDATE SET kind = $2, number = $3, pid = $4, start_time = $5, host = $6, started = $7,
            last_seen = $8, state = $9, restarts = $10, setup = $11, remark = $12";
    let query = query(sql).bind(&process.id).bind(&process.kind).bind(process.number);
    let query = query.bind(process.pid).bind(&process.start_time).bind(&process.host);
    let query = query.bind(process.started).bind(process.last_seen).bind(&process.state);
    let query = query.bind(process.restarts).bind(process.setup.as_deref()).bind(&process.remark);
    query.execute(&mut *transaction).await?;
    Ok(())
}

async fn remove(transaction: &mut Transaction, id: &str) -> Result<()> {
    query("DELETE FROM process WHERE id = $1").bind(id).execute(&mut *transaction).await?;
    Ok(())
}

/// Reads leases before processes: a holder is registered before it leases anything.
async fn leased(transaction: &mut Transaction) -> Result<Vec<(i64, String)>> {
    query(LEASED).locked().fetch_all(transaction).await
}

async fn release_all_except(
    living: &[ProcessRecord],
    leased: Vec<(i64, String)>,
    transaction: &mut Transaction,
    now: i64,
) -> Result<usize> {
    let now = transaction.time(now).await?;
    let is_lost = |holder: &str| !living.iter().any(|process| process.is_holder(holder));
    let lost: Vec<_> = leased.iter().filter(|(_, holder)| is_lost(holder)).collect();
    for (job, _) in &lost {
        end_without_label(transaction, *job, AttemptEnd::Lost("lost"), now).await?;
    }
    Ok(lost.len())
}
