//! Why a calculation gives no label.

use std::fmt;

/// Class of a failure; it determines the next attempt ([`crate::adjustments`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FailureClass {
    /// An error or a signal without further information ended the program.
    Crashed,
    /// The memory did not suffice.
    OutOfMemory,
    /// It exceeded its time limit.
    TimeLimit,
    /// The electronic steps did not converge.
    NotConverged,
    /// The structure cannot be calculated; another attempt would fail too.
    BadInput,
    /// The node was lost.
    NodeFailure,
    /// The program reports success, but its numbers are wrong.
    Implausible,
    /// Another program, or another version, than the protocol's ran. The fault is in the host, not in the
    /// structure.
    OtherProgram,
}

/// A failure with its message.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{class}: {message}")]
pub struct Failure {
    /// Its class.
    pub class: FailureClass,
    /// What happened, in one line.
    pub message: String,
}

impl FailureClass {
    /// All classes.
    pub const ALL: [Self; 8] = [
        Self::Crashed,
        Self::OutOfMemory,
        Self::TimeLimit,
        Self::NotConverged,
        Self::BadInput,
        Self::NodeFailure,
        Self::Implausible,
        Self::OtherProgram,
    ];

    /// Name in the store.
    pub fn name(self) -> &'static str {
        match self {
            Self::Crashed => "crashed",
            Self::OutOfMemory => "out_of_memory",
            Self::TimeLimit => "time_limit",
            Self::NotConverged => "not_converged",
            Self::BadInput => "bad_input",
            Self::NodeFailure => "node_failure",
            Self::Implausible => "implausible",
            Self::OtherProgram => "other_program",
        }
    }

    /// The class with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|class| class.name() == name)
    }

    /// A failure of this class with a message.
    pub fn with_message(self, message: impl Into<String>) -> Failure {
        Failure { class: self, message: message.into() }
    }
}

impl fmt::Display for FailureClass {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Crashed => "crashed",
            Self::OutOfMemory => "out of memory",
            Self::TimeLimit => "time limit",
            Self::NotConverged => "not converged",
            Self::BadInput => "bad input",
            Self::NodeFailure => "node failure",
            Self::Implausible => "implausible result",
            Self::OtherProgram => "another program",
        })
    }
}
