//! What the reader, the state and the loop say to each other.

use monitor::Snapshot;
use store::{JobState, QueueEntry, RecentDecision};

use crate::cli::queue::QueueCommand;
use crate::cli::walks::WalksCommand;
use crate::exit_status::ExitStatus;

/// Number of newest decisions kept, for charts and filters.
pub const WINDOW: usize = 2000;

/// Which label jobs are shown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum JobView {
    /// Leased, then queued jobs.
    #[default]
    Waiting,
    /// Failed jobs.
    Failed,
    /// Jobs dropped by the user.
    Dropped,
    /// Jobs with a label.
    Labelled,
}

impl JobView {
    /// The states of the jobs in a view.
    pub fn states(self) -> &'static [JobState] {
        match self {
            Self::Waiting => &[JobState::Leased, JobState::Queued],
            Self::Failed => &[JobState::Failed],
            Self::Dropped => &[JobState::Dropped],
            Self::Labelled => &[JobState::Labelled],
        }
    }
}

/// The result of a poll.
#[derive(Debug)]
pub struct Reading {
    /// The campaign, as in `calmwalk status`.
    pub snapshot: Snapshot,
    /// The requested view of jobs.
    pub view: JobView,
    /// The first jobs of the view, in the order in which labellers take them.
    pub jobs: Vec<QueueEntry>,
    /// Decisions since the last poll, newest first.
    pub decisions: Vec<RecentDecision>,
}

/// An action outside the state.
#[derive(Clone, Debug, PartialEq)]
pub enum WatchRequest {
    /// Exit.
    Quit(ExitStatus),
    /// Poll at once, because another view was selected.
    Refresh,
    /// Read the history of a candidate.
    Explain(String),
    /// Read the history of the campaign.
    History,
    /// Change label jobs.
    Queue(QueueCommand),
    /// Pause or resume walks.
    Walks(WalksCommand),
}

/// The result of a request, as text.
#[derive(Debug, PartialEq)]
pub enum Completed {
    /// The title of a text, such as the id of a candidate, and the text or an error.
    Text(String, Result<String, String>),
    /// What was changed, or an error.
    Change(Result<String, String>),
}
