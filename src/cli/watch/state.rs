//! What there is to draw, and how it changes; knows neither terminal nor store.

use std::collections::VecDeque;

use store::{Job, RecentDecision};

use super::Done;
use super::charts::Charts;
use super::entries;
use super::keys::Request;
use super::pane::Pane;
use super::reader::Seen;
use crate::cli::status::Snapshot;
use crate::exit_status::Failure;

/// Decisions that are kept, the newest: charts and filters are about these.
pub const WINDOW: usize = 2000;

/// Places of the panes.
pub const WALKS: usize = 0;
/// See [`WALKS`].
pub const QUEUE: usize = 1;
/// See [`WALKS`].
pub const DECISIONS: usize = 2;

/// Which label jobs are shown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Jobs {
    /// In work, then those that wait.
    #[default]
    Waiting,
    /// Given up.
    Failed,
    /// Taken out by hand.
    Dropped,
    /// Done.
    Labelled,
}

/// What has the keys.
#[derive(Debug, Default)]
pub enum Mode {
    /// The panes.
    #[default]
    Panes,
    /// A text over all the screen.
    Text(Text),
    /// A line that is being written.
    Ask(Ask),
    /// A question with yes or no.
    Confirm(String, Request),
}

/// A text that can be scrolled.
#[derive(Debug, Default)]
pub struct Text {
    /// What it is.
    pub title: String,
    /// Its lines; `None` while it is read.
    pub text: Option<String>,
    /// First line that is seen.
    pub top: usize,
    /// Lines that are seen.
    pub rows: usize,
}

/// A line that is being written.
#[derive(Debug)]
pub struct Ask {
    /// For what.
    pub what: Wanted,
    /// What was written so far.
    pub text: String,
}

/// What a line is written for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Wanted {
    /// A condition for the pane.
    Filter,
    /// A priority for the candidate.
    Priority(String),
}

/// What is said in a line, until the next key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Message {
    /// That something was done.
    Done(String),
    /// That something could not be done.
    Failed(String),
}

/// Everything that is drawn.
pub struct State {
    /// As `calmwalk status` shows it.
    pub snapshot: Snapshot,
    /// See [`Jobs`].
    pub which: Jobs,
    /// Walks, queue, decisions.
    pub panes: [Pane; 3],
    /// The pane that has the keys.
    pub focus: usize,
    /// What has the keys.
    pub mode: Mode,
    /// What there is to say.
    pub message: Option<Message>,
    /// Why the last look failed, if it did.
    pub blind: Option<String>,
    /// Of the decisions.
    pub charts: Charts,
    jobs: Vec<Job>,
    /// Newest first.
    decisions: VecDeque<RecentDecision>,
}

impl State {
    /// After the first look.
    pub fn new(seen: Seen) -> Self {
        let Seen { snapshot, which, jobs, decisions } = seen;
        let mut state = Self {
            snapshot,
            which,
            panes: Default::default(),
            focus: WALKS,
            mode: Mode::default(),
            message: None,
            blind: None,
            charts: Charts::default(),
            jobs,
            decisions: decisions.into(),
        };
        state.arrange();
        state
    }

    /// Takes in what was seen, or why nothing was: what was seen before stays.
    pub fn take_in(&mut self, seen: Result<Seen, Failure>) {
        let Seen { snapshot, which, jobs, decisions } = match seen {
            Ok(seen) => seen,
            Err(failure) => {
                self.blind = Some(failure.to_string());
                return;
            }
        };
        self.blind = None;
        self.snapshot = snapshot;
        // Others may be wanted by now.
        if which == self.which {
            self.jobs = jobs;
        }
        for decision in decisions.into_iter().rev() {
            self.decisions.push_front(decision);
        }
        self.decisions.truncate(WINDOW);
        self.arrange();
    }

    /// Takes in what came of a request.
    pub fn done(&mut self, done: Done) {
        match done {
            Done::Story(id, story) => {
                if let Mode::Text(text) = &mut self.mode
                    && text.text.is_none()
                    && text.title == id
                {
                    text.text = Some(story.unwrap_or_else(|why| why));
                }
            }
            Done::Change(Ok(done)) => self.message = Some(Message::Done(done)),
            Done::Change(Err(why)) => self.message = Some(Message::Failed(why)),
        }
    }

    /// Shows the next kind of jobs, as soon as they are read.
    pub fn next_jobs(&mut self) {
        self.which = self.which.next();
        self.jobs.clear();
        self.arrange();
    }

    /// Fills the panes with what there is.
    pub fn arrange(&mut self) {
        let store::Status { walks, led, .. } = self.snapshot.standing();
        let [of_walks, of_queue, of_decisions] = &mut self.panes;
        of_walks.show(entries::of_walks(walks, *led, of_walks.filter.as_ref()), walks.len());
        of_queue.show(entries::of_jobs(&self.jobs, of_queue.filter.as_ref()), self.jobs.len());
        let decisions = entries::of_decisions(self.decisions.iter(), of_decisions.filter.as_ref());
        of_decisions.show(decisions, self.decisions.len());
        self.charts = Charts::of(self.decisions.iter());
    }

    /// The pane that has the keys.
    pub fn pane(&mut self) -> &mut Pane {
        &mut self.panes[self.focus]
    }

    /// The job of the chosen line of the queue.
    pub fn job(&self) -> Option<&Job> {
        let key = &self.panes[QUEUE].chosen()?.key;
        self.jobs.iter().find(|job| job.job.to_string() == *key)
    }

    /// The number of the chosen walk.
    pub fn walk(&self) -> Option<u32> {
        self.panes[WALKS].chosen()?.key.parse().ok()
    }
}

impl Jobs {
    /// The next kind.
    pub fn next(self) -> Self {
        match self {
            Self::Waiting => Self::Failed,
            Self::Failed => Self::Dropped,
            Self::Dropped => Self::Labelled,
            Self::Labelled => Self::Waiting,
        }
    }

    /// What they are called.
    pub fn name(self) -> &'static str {
        match self {
            Self::Waiting => "queue",
            Self::Failed => "failed labels",
            Self::Dropped => "dropped",
            Self::Labelled => "labelled",
        }
    }
}
