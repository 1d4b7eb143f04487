//! The mixture once per host, in memory shared by all processes of a campaign.
//!
//! A file, only for the user, holds immutable *blocks*, one for each component and each time it changed, and for every
//! living version a *row*: the number of the block of each component. The orchestrator writes ([`SharedMixture`]),
//! walkers read in place ([`MixtureReader`]): what they get is a [`calm::Mixture`] like any other, whose components are
//! lent by the blocks. A new version costs its changed components and a row.
//!
//! ```text
//! header, shape │ newest │ slot of each reader │ version words │ rows │ extent 0 │ extent 1 …
//!                          owner, pin            one a row              holds, blocks
//! ```
//!
//! Who keeps what:
//! * A **version** lives while it is the newest, or anybody in the writer's process has the `Arc<Mixture>` that was
//!   published: so a version promised to a walker is there when the walker asks for it.
//! * A **pin** protects a row for the microseconds in which a reader copies it. [`protocol`] says why this is enough.
//! * A **hold** is a count, one for each reader and block: how many components of this reader are lent by the block. It is
//!   raised under the pin and lowered when the last reference to the component goes.
//! * A **block** is used anew when no living version refers to it and no reader holds it. If none is free the file
//!   grows by an extent, so a slow reader costs memory but never stops a campaign.
//!
//! Memory is reserved before it is written: a full file system is an error, not a signal. The trust is that of the
//! user: whoever may write the file may spoil it. A damaged file gives errors and never an access beyond its end.

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

pub use error::SharedMixtureError;
pub use reader::MixtureReader;
pub use writer::SharedMixture;
