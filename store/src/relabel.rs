//! Labels that are made anew.

use serde_json::Value;
use wire::ContentHash;

use crate::records::{JobState, Protocol};

/// A structure that has its label, and may get another.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Relabellable {
    /// Its hash.
    pub content: ContentHash,
    /// Number of the decision about its candidate.
    pub decision: i64,
    /// Name of the protocol of its label.
    pub protocol: String,
    /// State of its job by the protocol for which was asked, if it has one.
    pub job: Option<JobState>,
    /// Index of the seed structure.
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
    /// Also those that have their label by the protocol in force.
    pub again: bool,
    /// Why, for those who look at the labels later.
    pub reason: &'a str,
    /// A protocol that is to be in force from now on.
    pub protocol: Option<NewProtocol<'a>>,
}

/// A protocol that takes the place of the one in force, and what goes with it.
#[derive(Clone, Debug)]
pub struct NewProtocol<'a> {
    /// The protocol.
    pub protocol: &'a Protocol,
    /// The configuration by which the campaign runs from now on, JSON.
    pub configuration: &'a str,
    /// What makes it another, JSON objects for the operations log.
    pub changes: &'a [Value],
    /// What the leader leaves for others ([`crate::Store::set_metadata`]): names and texts.
    pub notes: &'a [(&'a str, String)],
}

/// What came of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RelabelCounts {
    /// Structures that are labelled again.
    pub again: u64,
    /// Structures without a label that went over to another protocol.
    pub moved: u64,
}
