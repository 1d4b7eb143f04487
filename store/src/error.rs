//! Errors of the store, each with what to do about it.

use std::io;
use std::path::PathBuf;

use sqlx::postgres::PgDatabaseError;
use wire::{BlockError, WalkId};

use crate::JobState;
use crate::file_names::DATABASE;
use crate::numbers::NumbersError;
use crate::records::CandidateRef;

/// The result type of this crate.
pub type Result<T> = std::result::Result<T, StoreError>;

/// An error of the store.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// There is no campaign.
    #[error(
        "there is no campaign in {location}: it has no {lacks}; give the location of a campaign, or create one there"
    )]
    Missing {
        /// The directory or server that was searched.
        location: String,
        /// What is missing there.
        lacks: &'static str,
    },
    /// There is a campaign already.
    #[error("{path} exists already: create the campaign in another directory", path = path.display())]
    Exists {
        /// The database.
        path: PathBuf,
    },
    /// A backup never overwrites anything.
    #[error("{path} exists already: give the backup a new directory, or remove this one", path = path.display())]
    BackupExists {
        /// The target of the backup.
        path: PathBuf,
    },
    /// Too little space to rewrite the database.
    #[error(
        "{directory} has {} MB free, and rewriting the database needs {} MB there: free space, or set SQLITE_TMPDIR to a directory on another disk",
        found / 1_000_000,
        needed.div_ceil(1_000_000),
        directory = directory.display()
    )]
    InsufficientSpace {
        /// A directory on the disk.
        directory: PathBuf,
        /// Free bytes.
        found: u64,
        /// Required bytes.
        needed: u64,
    },
    /// The schema holds another campaign.
    #[error(
        "cannot create campaign {wanted} in {location}, which holds campaign {found}: a schema holds one campaign; choose another schema with ?schema=… in the URL"
    )]
    Occupied {
        /// URL of the server.
        location: String,
        /// Id of the existing campaign.
        found: String,
        /// Id of the new campaign.
        wanted: String,
    },
    /// Not a valid URL of a server.
    #[error("'{url}' cannot be used: {reason}")]
    Url {
        /// The URL without its password.
        url: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The directory does not exist or is not writable.
    #[error("cannot use the directory {directory} ({source}): it must exist and be readable and writable", directory = directory.display())]
    Directory {
        /// The directory.
        directory: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A file of the campaign cannot be read or written.
    #[error("cannot use {path} ({source})", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// The opened database file was deleted, moved or replaced.
    #[error("{path} was deleted, moved or replaced while it was in use, and further changes would be lost: restore it, or stop the processes that use it", path = path.display())]
    Removed {
        /// The database.
        path: PathBuf,
    },
    /// SQLite cannot work on a network file system.
    #[error("{directory} is on a network file system ({kind}), where SQLite loses data: put the campaign on a disk of this machine", directory = directory.display())]
    NetworkFileSystem {
        /// The directory.
        directory: PathBuf,
        /// Name of the file system.
        kind: String,
    },
    /// Another process runs the campaign.
    #[error(
        "the campaign in {location} is being run by {holder}: only one process may run a campaign; wait for it, or stop it"
    )]
    Locked {
        /// The directory or server.
        location: String,
        /// The holder of the lock, with its process id.
        holder: String,
    },
    /// Another process took the lock while this one had lost its connection.
    #[error(
        "the campaign in {location} was taken over by {holder} while this process had lost its connection: this process stops writing"
    )]
    LockLost {
        /// The server.
        location: String,
        /// The holder of the lock now.
        holder: String,
    },
    /// Not an SQLite file.
    #[error("{path} is not an SQLite database: it begins with '{found}', expected 'SQLite format 3'; restore it from a backup, or create a campaign in another directory", path = path.display())]
    NotADatabase {
        /// The file.
        path: PathBuf,
        /// Its first bytes.
        found: String,
    },
    /// A database of another program.
    #[error("{path} is a database of another program (application id {found:#x}, expected {expected:#x}): give the directory of a campaign", path = path.display())]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Its application id.
        found: i64,
        /// That of this program.
        expected: i64,
    },
    /// Tables of another program.
    #[error(
        "the schema in {location} has a table '{found}' of another program: choose another schema with ?schema=… in the URL"
    )]
    ForeignSchema {
        /// URL of the server.
        location: String,
        /// A table in it.
        found: String,
    },
    /// A database of an unsupported version.
    #[error("{path} has schema version {found}, and this program reads up to version {reads}: use the program that wrote it, or a newer one", path = path.display())]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: i64,
        /// The newest version that this program reads.
        reads: i64,
    },
    /// The tables could not be created or migrated.
    #[error("cannot migrate the schema of the database: {0}")]
    Schema(sqlx::migrate::MigrateError),
    /// The store was opened read-only, or its file is write-protected.
    #[error("nothing can be written: the database was opened read-only, or its file is write-protected")]
    ReadOnly,
    /// The disk is full.
    #[error(
        "the disk is full: nothing was written, and earlier commits are safe; free space and start again"
    )]
    DiskFull,
    /// Another connection held the database until the timeout.
    #[error("the database is busy: another program holds it (a backup, an open transaction?); try again")]
    Busy,
    /// The server cannot be reached, or the connection to it broke.
    #[error(
        "the database server does not answer ({0}): it may be restarting; check that it runs and can be reached, and try again"
    )]
    Unreachable(sqlx::Error),
    /// The server responds, but the authentication of either side failed.
    #[error(
        "no protected connection to the database server ({0}): with sslmode=verify-full its certificate must contain the host name in the URL, and sslrootcert=FILE must be the authority that signed it; if the server requires a client certificate, give sslcert=FILE and sslkey=FILE"
    )]
    Protection(sqlx::Error),
    /// Content that this program cannot have written.
    #[error("damaged database: {what}: {reason}; restore the campaign from a backup")]
    Damaged {
        /// What was read.
        what: String,
        /// The fault.
        reason: String,
    },
    /// A commit that contradicts itself or the stored data: a programming error of the caller.
    #[error("inconsistent commit: {0}")]
    Inconsistent(String),
    /// The candidate exists already: a programming error of the caller, who must check before.
    #[error("candidate {0} is committed already")]
    DuplicateCandidate(String),
    /// The number of a new version of the potential is not the next one: another process may have added a version.
    #[error("version {number} of the potential was not stored: the next number is {next}")]
    VersionNumber {
        /// The given number.
        number: u32,
        /// The number that the next version must have.
        next: u32,
    },
    /// No such job.
    #[error("no label job belongs to '{id}'; {}", neighbours(near))]
    UnknownJob {
        /// The given name.
        id: String,
        /// Candidates with similar names.
        near: Vec<String>,
    },
    /// The name is a prefix of several candidates.
    #[error("'{id}' matches {}: give a longer prefix", list(matches))]
    AmbiguousJob {
        /// The given name.
        id: String,
        /// Some of the matching candidates.
        matches: Vec<String>,
    },
    /// No such candidate.
    #[error("no candidate matches '{id}'; {}", candidates(range.as_ref()))]
    UnknownCandidate {
        /// The given name.
        id: String,
        /// The first and the last candidate.
        range: Option<(CandidateRef, CandidateRef)>,
    },
    /// No such imported structure.
    #[error(
        "no imported structure matches '{id}'; {}",
        if *imported == 0 { "the campaign has none".into() } else { format!("they are import-1 to import-{imported}") }
    )]
    UnknownImport {
        /// The given name.
        id: String,
        /// Number of imported structures.
        imported: u64,
    },
    /// No such walk.
    #[error(
        "the campaign has no walk {walk}; {}",
        if *walks == 0 { "no walk has started yet".into() } else { format!("they are 0 to {}", walks - 1) }
    )]
    UnknownWalk {
        /// The given walk.
        walk: WalkId,
        /// Number of walks that have started.
        walks: u64,
    },
    /// The walk has ended.
    #[error("walk {walk} has ended ({state}): only running walks can be paused")]
    EndedWalk {
        /// The walk.
        walk: WalkId,
        /// How it ended.
        state: String,
    },
    /// The state of the job does not permit the change.
    #[error("cannot {action} {candidate}: its label job is {state}, and only {allowed} jobs can be {past}{}", exclude_instead(action, *state), past = past(action))]
    WrongState {
        /// `drop`, `retry`, `prioritise`.
        action: &'static str,
        /// The candidate.
        candidate: String,
        /// State of its job.
        state: JobState,
        /// The states that permit it.
        allowed: &'static str,
    },
    /// The structure has no label to change.
    #[error("{id} has no label: {why}")]
    NoLabel {
        /// The candidate or import.
        id: String,
        /// Why it has none.
        why: String,
    },
    /// Not a protocol of this campaign.
    #[error("the campaign has no label protocol {0}: add it first")]
    UnknownProtocol(String),
    /// Another protocol has the same name.
    #[error(
        "the campaign has another label protocol '{0}' with other settings: give the new one another name"
    )]
    ProtocolName(String),
    /// A label with invalid numbers.
    #[error("not a valid label: {0}")]
    InvalidLabel(String),
    /// Any other error of the database.
    #[error("database: {0}")]
    Database(sqlx::Error),
}

impl StoreError {
    /// Whether the same call may succeed later without a change of the campaign: the disk is full, the database
    /// busy, or its server unreachable.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::DiskFull | Self::Busy | Self::Unreachable(_))
    }

    /// An error for content that is invalid or damaged.
    pub fn damaged(what: impl ToString, reason: impl ToString) -> Self {
        Self::Damaged { what: what.to_string(), reason: reason.to_string() }
    }
}

/// No space for the database.
const FULL: i32 = 13;
/// No space for the index of the write-ahead log.
const IOERR_SHMSIZE: i32 = 4874;

impl From<sqlx::Error> for StoreError {
    fn from(error: sqlx::Error) -> Self {
        match &error {
            sqlx::Error::Database(database) => {
                let code = database.code().unwrap_or_default().into_owned();
                if database.try_downcast_ref::<PgDatabaseError>().is_some() {
                    from_postgres(&code, error)
                } else {
                    from_sqlite(code.parse().unwrap_or_default(), error)
                }
            }
            sqlx::Error::PoolTimedOut => Self::Busy,
            // TLS reports untrusted peers as invalid data; nothing else does.
            sqlx::Error::Io(source) if source.kind() == io::ErrorKind::InvalidData => Self::Protection(error),
            sqlx::Error::Tls(_) => Self::Protection(error),
            // Only a server has connections that break.
            sqlx::Error::Io(_) => Self::Unreachable(error),
            sqlx::Error::ColumnDecode { .. } | sqlx::Error::Decode(_) => Self::damaged("a row", error),
            _ => Self::Database(error),
        }
    }
}

/// The low byte of SQLite's extended result codes, https://www.sqlite.org/rescode.html
fn from_sqlite(code: i32, error: sqlx::Error) -> StoreError {
    match if code == IOERR_SHMSIZE { FULL } else { code & 0xff } {
        5 | 6 => StoreError::Busy,
        8 => StoreError::ReadOnly,
        11 | 26 => StoreError::damaged(DATABASE, error),
        FULL => StoreError::DiskFull,
        _ => StoreError::Database(error),
    }
}

/// https://www.postgresql.org/docs/current/errcodes-appendix.html
fn from_postgres(code: &str, error: sqlx::Error) -> StoreError {
    match code {
        // Serialisation failure, deadlock, lock not available.
        "40001" | "40P01" | "55P03" => StoreError::Busy,
        "25006" => StoreError::ReadOnly,
        "53100" => StoreError::DiskFull,
        // Too many connections; the server shuts down, has crashed, is starting, or closed the connection.
        "53300" | "57P01" | "57P02" | "57P03" | "57P05" => StoreError::Unreachable(error),
        code if code.starts_with("08") => StoreError::Unreachable(error),
        "XX001" | "XX002" => StoreError::damaged("the server's files", error),
        _ => StoreError::Database(error),
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
    if names.is_empty() { "the queue is empty".into() } else { format!("similar names: {}", list(names)) }
}

fn candidates(range: Option<&(CandidateRef, CandidateRef)>) -> String {
    let Some((first, last)) = range else { return "the campaign has none yet".into() };
    format!(
        "give the number of its decision, {} to {} (some of these concern walks), or a prefix of its name, such as \
         {} (the first) or {} (the last)",
        first.decision, last.decision, first.candidate, last.candidate
    )
}

fn past(action: &str) -> &'static str {
    match action {
        "drop" => "dropped",
        "retry" => "tried again",
        _ => "given another priority",
    }
}

/// Hint for removing an existing label from the data set.
fn exclude_instead(action: &str, state: JobState) -> &'static str {
    match (action, state) {
        ("drop", JobState::Labelled) => "; use calmwalk exclude to take its label out of the data set",
        _ => "",
    }
}
