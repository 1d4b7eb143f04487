//! What can go wrong with the shared mixture.

use std::io;
use std::path::PathBuf;

use calm::{ComponentError, MixtureError};

/// Why the shared mixture could not be made, published to or read.
#[derive(Debug, thiserror::Error)]
pub enum SharedMixtureError {
    /// The operating system refused.
    #[error("{}: cannot {doing}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What was attempted.
        doing: &'static str,
        /// The answer.
        source: io::Error,
    },
    /// The file system of shared memory is full.
    #[error(
        "{}: {needed} bytes of shared memory are needed and {free} are free; stop what else uses {}, or mount it larger",
        path.display(), path.parent().unwrap_or(path).display()
    )]
    Full {
        /// The file.
        path: PathBuf,
        /// Bytes that had to be reserved.
        needed: u64,
        /// Bytes that the file system has.
        free: u64,
    },
    /// Some other file.
    #[error("{}: not a shared mixture (its first bytes are {found:02x?})", path.display())]
    Magic {
        /// The file.
        path: PathBuf,
        /// Its first bytes.
        found: [u8; 8],
    },
    /// Written by another version of the program.
    #[error(
        "{}: shared mixture of format {found}, this program reads format {expected}; start all processes from one build",
        path.display()
    )]
    Format {
        /// The file.
        path: PathBuf,
        /// Its format.
        found: u32,
        /// That of this program.
        expected: u32,
    },
    /// Contents that contradict each other.
    #[error("{}: damaged shared mixture: {what}; the orchestrator makes a new one at its next start", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// More components, features or readers than can be addressed.
    #[error(
        "a mixture of {elements} elements and {dimension} features for {readers} readers cannot be shared: its size overflows"
    )]
    TooLarge {
        /// Elements.
        elements: usize,
        /// Features, D.
        dimension: usize,
        /// Readers.
        readers: u32,
    },
    /// A version that has not the components of the first.
    #[error(
        "version {version} has other elements, components or features than the shared mixture was made for"
    )]
    Shape {
        /// The version.
        version: u64,
    },
    /// More versions alive than there is room for.
    #[error(
        "version {version} cannot be published: {living} versions of the mixture are still in use in this process, no more fit; \
         this is a leak, since a walker needs one"
    )]
    TooManyVersions {
        /// The version.
        version: u64,
        /// How many are alive.
        living: usize,
    },
    /// A reader beyond those that the file has slots for.
    #[error("no slot for reader {reader}: the shared mixture was made for {readers}, counted from 0")]
    NoSlot {
        /// The reader.
        reader: u32,
        /// Number of slots.
        readers: u32,
    },
    /// Two readers of one number.
    #[error(
        "reader {reader} is open already, by process {process}; if that process is dead it must be released first"
    )]
    SlotTaken {
        /// The reader.
        reader: u32,
        /// Process id of the one that has the slot.
        process: u64,
    },
    /// A version that nobody keeps any more, or that was never published.
    #[error(
        "version {version} of the mixture is not in shared memory (the newest is {newest}); ask for another turn"
    )]
    VersionNotFound {
        /// The version.
        version: u64,
        /// The newest.
        newest: u64,
    },
    /// A block whose numbers do not make a component.
    #[error(transparent)]
    Component(#[from] ComponentError),
    /// Components that do not make a mixture.
    #[error(transparent)]
    Mixture(#[from] MixtureError),
}
