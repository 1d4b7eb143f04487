//! What can go wrong with a store, and what to do about it.

use std::io;
use std::path::PathBuf;

use sqlx::postgres::PgDatabaseError;
use wire::{BlockError, WalkId};

use crate::JobState;
use crate::candidate_history::CandidateRef;
use crate::numbers::NumbersError;

/// What the functions of this crate return.
pub type Result<T> = std::result::Result<T, StoreError>;

/// Why the store did not do what was asked.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// Nothing there.
    #[error(
        "there is no campaign in {location}: it has no {lacks}; name the place of a campaign, or begin one there"
    )]
    Missing {
        /// The directory or server looked at.
        location: String,
        /// What would be there.
        lacks: &'static str,
    },
    /// Something there already.
    #[error("{path} exists already: a campaign is begun in a directory without one", path = path.display())]
    Exists {
        /// The database.
        path: PathBuf,
    },
    /// A backup must not overwrite anything.
    #[error("{path} exists already: a backup is a new directory; name another one, or remove it", path = path.display())]
    BackupExists {
        /// Where the backup was to be.
        path: PathBuf,
    },
    /// Too little space to write the database anew.
    #[error(
        "{directory} has {} MB free, and writing the database anew takes {} MB there: make space, or let SQLITE_TMPDIR name a directory on another disk",
        found / 1_000_000,
        needed.div_ceil(1_000_000),
        directory = directory.display()
    )]
    InsufficientSpace {
        /// The directory on the disk.
        directory: PathBuf,
        /// Bytes that are free.
        found: u64,
        /// Bytes that are needed.
        needed: u64,
    },
    /// Another campaign there already.
    #[error(
        "campaign {wanted} cannot begin in {location}, which holds campaign {found}: a schema holds one campaign; name another one with ?schema=… in the URL"
    )]
    Occupied {
        /// URL of the server.
        location: String,
        /// Id of the campaign that is there.
        found: String,
        /// Id of the one that was to be begun.
        wanted: String,
    },
    /// Not the URL of a server.
    #[error("'{url}' cannot be used: {reason}")]
    Url {
        /// The URL without its password.
        url: String,
        /// What is wrong with it.
        reason: String,
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
    #[error(
        "the campaign in {location} is being run by {holder}: only one process may run a campaign; wait for it, or stop it"
    )]
    Locked {
        /// The directory or server.
        location: String,
        /// Who holds the lock, with its process number.
        holder: String,
    },
    /// Another process runs the campaign that this one ran.
    #[error(
        "the campaign in {location} was taken over by {holder} while this process had lost its connection: it writes nothing more"
    )]
    LockLost {
        /// The server.
        location: String,
        /// Who holds the lock now.
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
    /// Somebody else's tables.
    #[error(
        "the schema in {location} has a table '{found}' and is not of this program: name another one with ?schema=… in the URL"
    )]
    ForeignSchema {
        /// URL of the server.
        location: String,
        /// A table in it.
        found: String,
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
    /// The server cannot be reached, or the connection to it broke.
    #[error(
        "the database server does not answer ({0}): it may be restarting; see that it runs and can be reached, and try again"
    )]
    Unreachable(sqlx::Error),
    /// The server is there, but what it says about itself or what it is told about us is not believed.
    #[error(
        "no protected connection to the database server ({0}): with sslmode=verify-full its certificate must have the name by which the URL calls it, and sslrootcert=FILE the authority that signed it; where the server asks for one, sslcert=FILE and sslkey=FILE are our own"
    )]
    Protection(sqlx::Error),
    /// Content that this program cannot have written.
    #[error("damaged database: {what}: {reason}; restore the campaign from a backup")]
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
    /// No such candidate.
    #[error("no candidate is called '{id}'; {}", candidates(range.as_ref()))]
    UnknownCandidate {
        /// What was asked for.
        id: String,
        /// The first and the last candidate.
        range: Option<(CandidateRef, CandidateRef)>,
    },
    /// No such imported structure.
    #[error(
        "no imported structure is called '{id}'; {}",
        if *imported == 0 { "the campaign has none".into() } else { format!("they are import-1 to import-{imported}") }
    )]
    UnknownImport {
        /// What was asked for.
        id: String,
        /// Number of the last one.
        imported: u64,
    },
    /// No such walk.
    #[error(
        "the campaign has no walk {walk}; {}",
        if *walks == 0 { "none has begun yet".into() } else { format!("they are 0 to {}", walks - 1) }
    )]
    UnknownWalk {
        /// What was asked for.
        walk: WalkId,
        /// Walks that have begun.
        walks: u64,
    },
    /// It makes no more steps.
    #[error("walk {walk} has ended ({state}): only those that have more steps to make can be paused")]
    EndedWalk {
        /// The walk.
        walk: WalkId,
        /// How it ended.
        state: String,
    },
    /// The job is not in a state where that makes sense.
    #[error("cannot {action} {candidate}: its label job is {state}, and only {allowed} jobs can be {past}{}", exclude_instead(action, *state), past = past(action))]
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
    /// A structure has no label that could be excluded, or included again.
    #[error("{id} has no label to exclude: {why}")]
    NoLabel {
        /// The candidate or import.
        id: String,
        /// Why it has none.
        why: String,
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
    /// Anything else that the database says.
    #[error("database: {0}")]
    Database(sqlx::Error),
}

impl StoreError {
    /// Whether the same call may succeed later without anyone changing the campaign: the disk is full, the database
    /// busy, or its server away.
    pub fn is_transient(&self) -> bool {
        matches!(self, Self::DiskFull | Self::Busy | Self::Unreachable(_))
    }

    /// The database holds what it cannot hold.
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
            // TLS calls what it does not believe invalid data; nothing else does.
            sqlx::Error::Io(source) if source.kind() == io::ErrorKind::InvalidData => Self::Protection(error),
            sqlx::Error::Tls(_) => Self::Protection(error),
            // SQLite has no connections that break.
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
        11 | 26 => StoreError::damaged(crate::DATABASE, error),
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
        // Too many connections; it shuts down, has crashed, starts, or let the connection go.
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
    if names.is_empty() { "the queue is empty".into() } else { format!("near it are {}", list(names)) }
}

fn candidates(range: Option<&(CandidateRef, CandidateRef)>) -> String {
    let Some((first, last)) = range else { return "the campaign has none yet".into() };
    format!(
        "give the number of the decision about it, {} to {} (some of these are about walks), or the beginning of its name, as \
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

/// What takes a label out of the data set that is there already.
fn exclude_instead(action: &str, state: JobState) -> &'static str {
    match (action, state) {
        ("drop", JobState::Labelled) => "; calmwalk exclude takes its label out of the data set",
        _ => "",
    }
}
