//! The store behind a layer of faults. All SQL is real; the layer decides whether a call reaches it, and whether its answer
//! arrives. It adds what only a server does: it fences a replaced orchestrator, and a commit has a mark by which it is
//! looked up after its answer was lost.

use std::collections::BTreeMap;
use std::io;

use store::records::{Commit, Lease};
use store::{CompleteOutcome, FailOutcome, Store, StoreError};
use tokio::runtime::Runtime;
use wire::WalkId;

use super::fault::{ClientKind, Moment, Time};
use super::planted::PlantedBug;

/// What became of a commit.
pub enum CommitTry {
    Written,
    /// The server cannot be reached, or its answer was lost: the store tries again.
    Again,
    Failed(StoreError),
}

/// The store, and what is wrong with it.
pub struct FaultyStore {
    pub store: Store,
    pub runtime: Runtime,
    server: bool,
    bug: Option<PlantedBug>,
    pub away_until: Time,
    pub full_until: Time,
    /// Faults of coming writes.
    pub next_writes: Vec<(ClientKind, Moment)>,
    /// The newest run that holds the lock.
    pub generation: u64,
    /// Runs whose last commit was made, although its answer was lost.
    made: BTreeMap<u64, bool>,
    /// Number of writes that changed something.
    pub changes: u64,
    /// Whether the last write that failed was made all the same.
    failed_but_made: bool,
    /// What the story tells.
    pub remarks: Vec<String>,
    /// A replaced orchestrator has written.
    pub fence_broken: bool,
}

/// The answer to a write.
pub trait WriteAnswer {
    /// Whether something may have changed that invariants are about.
    fn has_changed(&self) -> bool {
        true
    }
}

impl WriteAnswer for usize {
    fn has_changed(&self) -> bool {
        *self > 0
    }
}

impl WriteAnswer for Option<Lease> {
    fn has_changed(&self) -> bool {
        self.is_some()
    }
}

/// Records of processes are no matter of invariants.
impl WriteAnswer for () {
    fn has_changed(&self) -> bool {
        false
    }
}

impl WriteAnswer for std::ops::Range<i64> {}
impl WriteAnswer for bool {}
impl WriteAnswer for String {}
impl WriteAnswer for Vec<WalkId> {}
impl WriteAnswer for CompleteOutcome {}
impl WriteAnswer for FailOutcome {}

fn unreachable(what: &str) -> StoreError {
    StoreError::Unreachable(sqlx::Error::Io(io::Error::new(io::ErrorKind::ConnectionReset, what.to_owned())))
}

impl FaultyStore {
    pub fn new(store: Store, runtime: Runtime, server: bool, bug: Option<PlantedBug>) -> Self {
        Self {
            store,
            runtime,
            server,
            bug,
            away_until: 0,
            full_until: 0,
            next_writes: Vec::new(),
            generation: 0,
            made: BTreeMap::new(),
            changes: 0,
            failed_but_made: false,
            remarks: Vec::new(),
            fence_broken: false,
        }
    }

    /// The error of a database that does not do what it is asked: a server is not there, a file is locked.
    fn refusal(&self) -> StoreError {
        if self.server { unreachable("connection reset") } else { StoreError::Busy }
    }

    /// Reads.
    pub fn read<T>(
        &mut self,
        now: Time,
        read: impl AsyncFnOnce(&Store) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        if now < self.away_until {
            return Err(self.refusal());
        }
        self.runtime.block_on(read(&self.store))
    }

    /// Writes.
    pub fn write<T: WriteAnswer>(
        &mut self,
        now: Time,
        client: ClientKind,
        what: &str,
        write: impl AsyncFnOnce(&Store) -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        self.failed_but_made = false;
        if now < self.away_until {
            return Err(self.refusal());
        }
        if now < self.full_until {
            return Err(StoreError::DiskFull);
        }
        match self.next_fault(client) {
            Some(Moment::BeforeCommit) => {
                self.remarks.push(format!("the database refuses: {what}"));
                Err(self.refusal())
            }
            fault => {
                let written = self.runtime.block_on(write(&self.store));
                self.changes += u64::from(written.as_ref().is_ok_and(WriteAnswer::has_changed));
                if fault.is_none() {
                    return written;
                }
                self.remarks.push(format!("the answer of the database is lost: {what}"));
                self.failed_but_made = written.is_ok();
                Err(self.refusal())
            }
        }
    }

    fn next_fault(&mut self, client: ClientKind) -> Option<Moment> {
        let place = self.next_writes.iter().position(|(of, _)| *of == client)?;
        Some(self.next_writes.remove(place).1)
    }

    /// Whether a run with this generation has been replaced.
    pub fn is_replaced(&self, generation: u64) -> bool {
        generation < self.generation
    }

    /// Tries to write a commit of a run, as [`Store::commit`] does.
    pub fn commit(&mut self, now: Time, session: u64, commit: &Commit) -> CommitTry {
        if self.server && now < self.away_until {
            return CommitTry::Again;
        }
        if self.is_replaced(session) {
            if self.bug != Some(PlantedBug::FenceForgotten) && self.bug != Some(PlantedBug::LockIgnored) {
                let (location, holder) = ("the server".to_owned(), format!("run {}", self.generation));
                return CommitTry::Failed(StoreError::LockLost { location, holder });
            }
            self.fence_broken = true;
        }
        let is_made = self.made.remove(&session).unwrap_or_default();
        if is_made && self.bug != Some(PlantedBug::CommitRepeated) {
            self.remarks.push("the commit is found by its mark: it was made".to_owned());
            return CommitTry::Written;
        }
        match self.write(now, ClientKind::Orchestrator, "a commit", async |store| store.commit(commit).await)
        {
            Ok(_) => CommitTry::Written,
            // A file on a full disk fails, and so does a server that says so.
            Err(StoreError::Unreachable(_)) if self.server => {
                self.made.insert(session, self.failed_but_made);
                CommitTry::Again
            }
            Err(_) if self.bug == Some(PlantedBug::FailedCommitBelieved) => CommitTry::Written,
            Err(error) => CommitTry::Failed(error),
        }
    }
}
