//! The mixture in shared memory: one copy per host for all processes of a campaign.
//!
//! A file, accessible only to the user, contains immutable *blocks*, one for each version of each component, and for
//! every live version a *row* with the block number of each component. The orchestrator writes ([`SharedMixture`]),
//! walkers read in place ([`MixtureReader`]) and get an ordinary [`calm::Mixture`] whose components borrow their
//! numbers from the blocks. A new version costs its changed components and a row.
//!
//! ```text
//! header, shape │ newest │ slot of each reader │ version words │ rows │ extent 0 │ extent 1 …
//!                          owner, pin            one per row            refcounts, blocks
//! ```
//!
//! Lifetimes:
//! * A **version** lives while it is the newest, or while the writer's process holds the `Arc<Mixture>` that was
//!   published. A version assigned to a walker therefore exists when the walker pins it.
//! * The **original** mixture, by which no update is counted, is there as long as the file: walkers grade with it, too.
//! * A **pin** protects a row for the microseconds in which a reader copies it. [`pinning`] explains why this is
//!   sufficient.
//! * A **reference count** per reader and block counts the components of this reader that use the block. It is
//!   incremented under the pin, and decremented when the last reference to the component is dropped.
//! * A **block** is reused when no live version refers to it and all its reference counts are zero. If no block is
//!   free, the file grows by an extent, so a slow reader costs memory but never blocks a campaign.
//!
//! Memory is reserved before it is written, so a full file system is an error and not a signal. Any process of the user
//! that can write the file is trusted. A damaged file causes errors, but never an access beyond its end.

mod allocator;
#[allow(unsafe_code)]
mod block_reader;
mod error;
mod index;
mod layout;
#[allow(unsafe_code)]
mod memory;
mod pinning;
mod reader;
mod writer;

use pinning::NONE;

/// The number under which the original mixture is published, whichever version it is. No version has it.
pub const ORIGINAL: u64 = NONE - 1;

pub use error::SharedMixtureError;
pub use reader::MixtureReader;
pub use writer::SharedMixture;
