//! Why a calculation is no label.

use std::fmt;

/// Kind of a failure: what is tried next depends on it ([`crate::adjustments`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FailureClass {
    /// The program ended by an error or a signal that says nothing more.
    Crashed,
    /// It needed more memory than there was.
    OutOfMemory,
    /// It was not done in time.
    TimeLimit,
    /// The electronic steps did not converge.
    NotConverged,
    /// The structure cannot be calculated as it is: another attempt would fail alike.
    BadInput,
    /// The machine that it ran on is gone.
    LostNode,
    /// It says that all is well, but its numbers cannot be believed.
    Implausible,
    /// What was run is not the program of the protocol, or another version of it. That is a fault of where it ran, and not of
    /// the structure.
    OtherProgram,
}

/// A failure with what is known of it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{class}: {message}")]
pub struct Failure {
    /// Its kind.
    pub class: FailureClass,
    /// What happened, for people: a line.
    pub message: String,
}

impl FailureClass {
    /// All of them.
    pub const ALL: [Self; 8] = [
        Self::Crashed,
        Self::OutOfMemory,
        Self::TimeLimit,
        Self::NotConverged,
        Self::BadInput,
        Self::LostNode,
        Self::Implausible,
        Self::OtherProgram,
    ];

    /// Short name, as the store keeps it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Crashed => "crashed",
            Self::OutOfMemory => "out_of_memory",
            Self::TimeLimit => "time_limit",
            Self::NotConverged => "not_converged",
            Self::BadInput => "bad_input",
            Self::LostNode => "lost_node",
            Self::Implausible => "implausible",
            Self::OtherProgram => "other_program",
        }
    }

    /// The class of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|class| class.name() == name)
    }

    /// A failure of this class.
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
            Self::LostNode => "lost node",
            Self::Implausible => "implausible result",
            Self::OtherProgram => "another program",
        })
    }
}
