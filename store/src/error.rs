//! What can go wrong with a store, and what to do about it.

use std::io;
use std::path::PathBuf;

use wire::{BlockError, ContentHash};

use crate::JobState;
use crate::numbers::NumbersError;

/// What the functions of this crate return.
pub type Result<T> = std::result::Result<T, StoreError>;

/// Why the store did not do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// Nothing there.
    #[error("there is no campaign in {directory}: it has no {file}; name the directory of a campaign, or begin one there", directory = directory.display(), file = crate::DATABASE)]
    Missing {
        /// The directory looked at.
        directory: PathBuf,
    },
    /// Something there already.
    #[error("{path} exists already: a campaign is begun in a directory without one", path = path.display())]
    Exists {
        /// The database.
        path: PathBuf,
    },
    /// No directory, or one where nothing may be written.
    #[error("cannot work in the directory {directory} ({source}): it must exist, and reading and writing there must be allowed", directory = directory.display())]
    Directory {
        /// The directory.
        directory: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// A file of the campaign cannot be read or written.
    #[error("cannot use {path} ({source})", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The database is not the file any more that was opened.
    #[error("{path} was deleted, moved or replaced while it was in use, and what is written now would be lost: put it back, or stop what works on it", path = path.display())]
    Removed {
        /// The database.
        path: PathBuf,
    },
    /// A directory that several hosts see.
    #[error("{directory} is on a network file system ({kind}), where SQLite loses data: put the campaign on a disk of this machine", directory = directory.display())]
    NetworkFileSystem {
        /// The directory.
        directory: PathBuf,
        /// Name of the file system.
        kind: String,
    },
    /// Another process runs the campaign.
    #[error("the campaign in {directory} is being run by {holder}: only one process may run a campaign; wait for it, or stop it", directory = directory.display())]
    Locked {
        /// The directory.
        directory: PathBuf,
        /// Who holds the lock, with its process number.
        holder: String,
    },
    /// Not a file of SQLite.
    #[error("{path} is no SQLite database: it begins with '{found}' and not with 'SQLite format 3'; restore it from a copy, or begin a campaign in another directory", path = path.display())]
    NotADatabase {
        /// The file.
        path: PathBuf,
        /// Its first bytes.
        found: String,
    },
    /// Somebody else's database.
    #[error("{path} is a database of another program (application id {found:#x}, this program's is {expected:#x}): name the directory of a campaign", path = path.display())]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Its application id.
        found: i64,
        /// That of this program.
        expected: i64,
    },
    /// A database of another version of this program.
    #[error("{path} has a schema of version {found}; this program reads version {reads}: use the program that wrote it, or a newer one", path = path.display())]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: i64,
        /// The version that this program reads.
        reads: i64,
    },
    /// The tables could not be made or brought up to date.
    #[error("the schema of the database could not be brought up to date: {0}")]
    Schema(sqlx::migrate::MigrateError),
    /// A writing function of a store opened only to be read, or of a file that is protected.
    #[error(
        "nothing can be written: the database was opened only to be read, or its file is write-protected"
    )]
    ReadOnly,
    /// No space left.
    #[error(
        "the disk is full: nothing was written, and what was committed before is safe; make space and start again"
    )]
    DiskFull,
    /// Another connection holds the database for longer than the time limit.
    #[error("the database is busy: another program holds it (a backup, an open transaction?); try again")]
    Busy,
    /// Content that this program cannot have written.
    #[error("damaged database: {what}: {reason}; restore it from a copy")]
    Damaged {
        /// What was read.
        what: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A commit that contradicts itself or what is stored: an error of the caller.
    #[error("inconsistent commit: {0}")]
    Inconsistent(String),
    /// The candidate is there already: an error of the caller, who must look before.
    #[error("candidate {0} was committed before")]
    DuplicateCandidate(String),
    /// No such job.
    #[error("no label job belongs to '{id}'; {}", neighbours(near))]
    UnknownJob {
        /// What was asked for.
        id: String,
        /// Candidates whose names begin alike.
        near: Vec<String>,
    },
    /// A prefix of several.
    #[error("'{id}' could be {}: give more of it", list(matches))]
    AmbiguousJob {
        /// What was asked for.
        id: String,
        /// Some of the candidates that it could be.
        matches: Vec<String>,
    },
    /// The job is not in a state where that makes sense.
    #[error("cannot {action} {candidate}: its label job is {state}, and only {allowed} jobs can be {past}", past = past(action))]
    WrongState {
        /// `drop`, `retry`, `prioritise`.
        action: &'static str,
        /// The candidate.
        candidate: String,
        /// State of its job.
        state: JobState,
        /// The states in which it could be done.
        allowed: &'static str,
    },
    /// Not a protocol of this campaign.
    #[error("the campaign has no label protocol {0}: add it first")]
    UnknownProtocol(String),
    /// Two protocols of one name.
    #[error(
        "the campaign has another label protocol '{0}' with other settings: give the new one another name"
    )]
    ProtocolName(String),
    /// A label with impossible numbers.
    #[error("not a valid label: {0}")]
    InvalidLabel(String),
    /// Nothing to supersede.
    #[error("structure {0} has no label that could be superseded")]
    NoLabel(ContentHash),
    /// Anything else that the database says.
    #[error("database: {0}")]
    Database(sqlx::Error),
}

impl StoreError {
    /// Whether the same call may succeed later without anyone changing the campaign: the disk is full, or the
    /// database busy.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::DiskFull | Self::Busy)
    }

    pub(crate) fn damaged(what: impl ToString, reason: impl ToString) -> Self {
        Self::Damaged { what: what.to_string(), reason: reason.to_string() }
    }
}

/// No space for the database.
const FULL: i32 = 13;
/// No space for the index of the write-ahead log.
const IOERR_SHMSIZE: i32 = 4874;

impl From<sqlx::Error> for StoreError {
    fn from(error: sqlx::Error) -> Self {
        // The low byte of SQLite's extended result codes, https://www.sqlite.org/rescode.html
        let code = match &error {
            sqlx::Error::Database(database) => database.code().and_then(|code| code.parse::<i32>().ok()),
            sqlx::Error::PoolTimedOut => return Self::Busy,
            sqlx::Error::ColumnDecode { .. } | sqlx::Error::Decode(_) => {
                return Self::damaged("a row", error);
            }
            _ => None,
        };
        match code.map(|code| if code == IOERR_SHMSIZE { FULL } else { code & 0xff }) {
            Some(5 | 6) => Self::Busy,
            Some(8) => Self::ReadOnly,
            Some(11 | 26) => Self::damaged(crate::DATABASE, error),
            Some(FULL) => Self::DiskFull,
            _ => Self::Database(error),
        }
    }
}

impl From<BlockError> for StoreError {
    fn from(error: BlockError) -> Self {
        Self::damaged("a candidate", error)
    }
}

impl From<NumbersError> for StoreError {
    fn from(error: NumbersError) -> Self {
        Self::damaged("an array of numbers", error)
    }
}

fn list(names: &[String]) -> String {
    names.join(", ")
}

fn neighbours(names: &[String]) -> String {
    if names.is_empty() { "the queue is empty".into() } else { format!("near it are {}", list(names)) }
}

fn past(action: &str) -> &'static str {
    match action {
        "drop" => "dropped",
        "retry" => "tried again",
        _ => "given another priority",
    }
}
