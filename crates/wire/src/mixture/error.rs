//! Errors of the shared mixture.

use std::io;
use std::path::PathBuf;

use calm::{ComponentError, MixtureError};

/// Why the shared mixture cannot be created, published or read.
#[derive(Debug, thiserror::Error)]
pub enum SharedMixtureError {
    /// An error of the operating system.
    #[error("{}: cannot {doing}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The operation.
        doing: &'static str,
        /// The error.
        source: io::Error,
    },
    /// Not enough shared memory.
    #[error(
        "{}: {needed} bytes of shared memory are needed, but only {free} are free; free space on {}, or enlarge it",
        path.display(), path.parent().unwrap_or(path).display()
    )]
    Full {
        /// The file.
        path: PathBuf,
        /// Required, bytes.
        needed: u64,
        /// Free, bytes.
        free: u64,
    },
    /// Another kind of file.
    #[error("{}: not a shared mixture (its first bytes are {found:02x?})", path.display())]
    Magic {
        /// The file.
        path: PathBuf,
        /// Its first bytes.
        found: [u8; 8],
    },
    /// Another format version.
    #[error(
        "{}: shared mixture of format {found}, expected format {expected}; use the same version of calmwalk in all processes",
        path.display()
    )]
    Format {
        /// The file.
        path: PathBuf,
        /// Its format.
        found: u32,
        /// The format of this program.
        expected: u32,
    },
    /// Inconsistent contents.
    #[error("{}: damaged shared mixture: {what}; the orchestrator creates a new one when it starts", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A size overflows.
    #[error(
        "cannot share a mixture of {elements} elements and {dimension} features with {readers} readers: its size overflows"
    )]
    TooLarge {
        /// Elements.
        elements: usize,
        /// Features, D.
        dimension: usize,
        /// Readers.
        readers: u32,
    },
    /// A version of another shape.
    #[error("version {version} does not match the elements, components or features of the shared mixture")]
    Shape {
        /// The version.
        version: u64,
    },
    /// Too many live versions.
    #[error(
        "cannot publish version {version}: {living} versions of the mixture are still in use in this process, which is the limit; \
         this is a leak, since each walker needs only one"
    )]
    TooManyVersions {
        /// The version.
        version: u64,
        /// Number of live versions.
        living: usize,
    },
    /// A reader number without a slot.
    #[error("no reader index {reader}: the shared mixture has {readers} reader indices, counted from 0")]
    NoSlot {
        /// The reader.
        reader: u32,
        /// Number of slots.
        readers: u32,
    },
    /// The slot is in use.
    #[error(
        "reader {reader} is already open in process {process}; if that process is dead, release its reader index first"
    )]
    SlotTaken {
        /// The reader.
        reader: u32,
        /// Process id of the owner.
        process: u64,
    },
    /// The version was never published, or has been removed.
    #[error(
        "version {version} of the mixture is not in shared memory (the newest is {newest}); request another assignment"
    )]
    VersionNotFound {
        /// The version.
        version: u64,
        /// The newest version.
        newest: u64,
    },
    /// A block that is not a valid component.
    #[error(transparent)]
    Component(#[from] ComponentError),
    /// Components that do not form a mixture.
    #[error(transparent)]
    Mixture(#[from] MixtureError),
}
