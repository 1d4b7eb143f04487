//! The state that is drawn, and how it changes; independent of terminal and store.

use std::collections::VecDeque;

use monitor::Snapshot;
use store::{QueueEntry, RecentDecision, WalkVersions};

use super::charts::Charts;
use super::entries;
use super::messages::{Completed, JobView, Reading, WINDOW, WatchRequest};
use super::pane::Pane;
use crate::exit_status::CommandError;

/// Index of the pane of walks.
pub const WALKS: usize = 0;
/// Index of the pane of label jobs.
pub const QUEUE: usize = 1;
/// Index of the pane of decisions.
pub const DECISIONS: usize = 2;

/// What receives the keys.
#[derive(Debug, Default)]
pub enum InputMode {
    /// The panes.
    #[default]
    Panes,
    /// A full-screen text.
    Text(TextView),
    /// A line of input.
    Prompt(Prompt),
    /// A yes-no question, and the request to send on yes.
    Confirm(String, WatchRequest),
}

/// A scrollable text.
#[derive(Debug, Default)]
pub struct TextView {
    /// Title.
    pub title: String,
    /// Content; `None` until it is read.
    pub text: Option<String>,
    /// First visible line.
    pub top: usize,
    /// Number of visible lines.
    pub rows: usize,
}

/// A line of input.
#[derive(Debug)]
pub struct Prompt {
    /// What the input is for.
    pub kind: PromptKind,
    /// The input so far.
    pub text: String,
}

/// What a line of input is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PromptKind {
    /// A filter of the pane.
    Filter,
    /// A new priority of the candidate.
    Priority(String),
}

/// A message, shown until the next key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StatusMessage {
    /// The result of a request.
    Success(String),
    /// Why a request failed.
    Error(String),
}

/// Everything that is drawn.
pub struct WatchState {
    /// The campaign, as in `calmwalk status`.
    pub snapshot: Snapshot,
    /// Which label jobs are shown.
    pub view: JobView,
    /// Walks, queue, decisions.
    pub panes: [Pane; 3],
    /// The pane that receives the keys.
    pub focus: usize,
    /// What receives the keys.
    pub mode: InputMode,
    /// The current message.
    pub message: Option<StatusMessage>,
    /// Why the last poll failed, if it did.
    pub read_error: Option<String>,
    /// Charts of the decisions.
    pub charts: Charts,
    jobs: Vec<QueueEntry>,
    /// Newest first.
    decisions: VecDeque<RecentDecision>,
}

impl WatchState {
    /// The state after the first poll.
    pub fn new(reading: Reading) -> Self {
        let Reading { snapshot, view, jobs, decisions } = reading;
        let mut state = Self {
            snapshot,
            view,
            panes: Default::default(),
            focus: WALKS,
            mode: InputMode::default(),
            message: None,
            read_error: None,
            charts: Charts::default(),
            jobs,
            decisions: decisions.into(),
        };
        state.update_panes();
        state
    }

    /// Applies the result of a poll. On an error, the former state stays.
    pub fn apply(&mut self, reading: Result<Reading, CommandError>) {
        let Reading { snapshot, view, jobs, decisions } = match reading {
            Ok(reading) => reading,
            Err(failure) => {
                self.read_error = Some(failure.to_string());
                return;
            }
        };
        self.read_error = None;
        self.snapshot = snapshot;
        // The user may have selected another view meanwhile.
        if view == self.view {
            self.jobs = jobs;
        }
        for decision in decisions.into_iter().rev() {
            self.decisions.push_front(decision);
        }
        self.decisions.truncate(WINDOW);
        self.update_panes();
    }

    /// Applies the result of a request.
    pub fn complete(&mut self, completed: Completed) {
        match completed {
            Completed::Text(id, history) => {
                if let InputMode::Text(text) = &mut self.mode
                    && text.text.is_none()
                    && text.title == id
                {
                    text.text = Some(history.unwrap_or_else(|error| error));
                }
            }
            Completed::Change(Ok(message)) => self.message = Some(StatusMessage::Success(message)),
            Completed::Change(Err(error)) => self.message = Some(StatusMessage::Error(error)),
        }
    }

    /// Switches to the next view of jobs; they appear with the next poll.
    pub fn next_view(&mut self) {
        self.view = self.view.next();
        self.jobs.clear();
        self.update_panes();
    }

    /// Updates the panes and charts.
    pub fn update_panes(&mut self) {
        let store::CampaignStatus { walks, run_active, .. } = &self.snapshot.status;
        let [of_walks, of_queue, of_decisions] = &mut self.panes;
        of_walks
            .set_entries(entries::walk_entries(walks, *run_active, of_walks.filter.as_ref()), walks.len());
        let running = &self.snapshot.labels.running;
        let jobs = entries::job_entries(&self.jobs, walks, running, of_queue.filter.as_ref());
        of_queue.set_entries(jobs, self.jobs.len());
        let decisions = entries::decision_entries(self.decisions.iter(), walks, of_decisions.filter.as_ref());
        of_decisions.set_entries(decisions, self.decisions.len());
        let version = |walk: &store::WalkStatus| walk.conditions.as_ref().map_or(0, |found| found.version);
        let versions = WalkVersions::from_walks(walks.iter().map(|walk| (walk.walk, version(walk))));
        let is_newest = |decision: &&RecentDecision| {
            decision.walk.is_none_or(|walk| versions.version_of(walk) == versions.newest())
        };
        // γ of different versions of the potential cannot be compared.
        self.charts = Charts::from_decisions(self.decisions.iter().filter(is_newest));
    }

    /// The pane that receives the keys.
    pub fn pane(&mut self) -> &mut Pane {
        &mut self.panes[self.focus]
    }

    /// The selected label job.
    pub fn job(&self) -> Option<&QueueEntry> {
        let key = &self.panes[QUEUE].selected()?.key;
        self.jobs.iter().find(|job| job.job.to_string() == *key)
    }

    /// The number of the selected walk.
    pub fn walk(&self) -> Option<u32> {
        self.panes[WALKS].selected()?.key.parse().ok()
    }
}

impl JobView {
    /// The next view.
    pub fn next(self) -> Self {
        match self {
            Self::Waiting => Self::Failed,
            Self::Failed => Self::Dropped,
            Self::Dropped => Self::Labelled,
            Self::Labelled => Self::Waiting,
        }
    }

    /// The title of the view.
    pub fn name(self) -> &'static str {
        match self {
            Self::Waiting => "queue",
            Self::Failed => "failed labels",
            Self::Dropped => "dropped",
            Self::Labelled => "labelled",
        }
    }
}
