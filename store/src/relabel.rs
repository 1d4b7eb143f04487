//! Requests to make labels again.

use serde_json::Value;
use wire::ContentHash;

use crate::records::{JobState, Protocol};

/// A structure with a label that may get another one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Relabellable {
    /// Its hash.
    pub content: ContentHash,
    /// Sequence number of the decision on its candidate; above all decisions for an imported structure.
    pub decision: i64,
    /// Name of the protocol of its label.
    pub protocol: String,
    /// State of its job under the requested protocol, if it has one.
    pub job: Option<JobState>,
    /// Index of the seed structure; [`u32::MAX`] for imported structures.
    pub seed_structure: u32,
    /// Formula.
    pub formula: String,
    /// Number of atoms.
    pub atoms: u32,
}

/// What is to be labelled again.
#[derive(Clone, Debug)]
pub struct RelabelRequest<'a> {
    /// Which structures.
    pub structures: &'a [ContentHash],
    /// Also structures whose label was made under the protocol in force.
    pub include_current: bool,
    /// The reason, stored with the superseded labels.
    pub reason: &'a str,
    /// A new protocol to bring into force.
    pub protocol: Option<NewProtocol<'a>>,
}

/// A new protocol, with the changes that come with it.
#[derive(Clone, Debug)]
pub struct NewProtocol<'a> {
    /// The protocol.
    pub protocol: &'a Protocol,
    /// The configuration from now on, JSON.
    pub configuration: &'a str,
    /// The changed settings, as JSON objects for the operations log.
    pub changes: &'a [Value],
    /// Metadata of the campaign to set with it ([`crate::Store::set_metadata`]): names and values.
    pub notes: &'a [(&'a str, String)],
}

/// The effect of a request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RelabelCounts {
    /// Structures that will get another label.
    pub relabelling: u64,
    /// Structures without a label whose jobs moved to the new protocol.
    pub moved: u64,
}
