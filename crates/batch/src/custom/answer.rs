//! What the commands of a custom batch system say about jobs.

use super::settings::CustomScheduler;
use crate::job_id::JobId;

/// What a command printed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CommandOutput {
    /// Whether it ended well.
    pub success: bool,
    /// Its standard output.
    pub stdout: String,
    /// Its standard error.
    pub stderr: String,
}

/// The state of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolledState {
    /// It waits.
    Pending,
    /// It has a node, or its state has an unknown word.
    Running,
    /// It has ended, well or in any way.
    Completed,
    /// It has ended with an error.
    Failed,
    /// It was cancelled.
    Cancelled,
    /// The batch system does not know it (any more).
    Vanished,
}

impl PolledState {
    /// The state in the notation of `squeue`, for views of jobs of any batch system.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pending => "PENDING",
            Self::Running => "RUNNING",
            Self::Completed => "COMPLETED",
            Self::Failed => "FAILED",
            Self::Cancelled => "CANCELLED",
            Self::Vanished => "UNKNOWN",
        }
    }

    /// Whether the job waits or runs.
    pub fn is_alive(self) -> bool {
        matches!(self, Self::Pending | Self::Running)
    }
}

impl CommandOutput {
    pub(super) fn says_any(&self, texts: &[String]) -> bool {
        texts.iter().any(|text| self.stdout.contains(text) || self.stderr.contains(text))
    }
}

impl CustomScheduler {
    /// The line in the output of `submit` that says that no further job is accepted for now.
    pub fn full_queue<'a>(&self, output: &'a CommandOutput) -> Option<&'a str> {
        let said = [&output.stderr, &output.stdout].into_iter().flat_map(|text| text.lines());
        let is_full = |line: &&str| self.queue_full.iter().any(|text| line.contains(text));
        said.into_iter().find(is_full).map(str::trim)
    }

    /// The id of the submitted job in the output of `submit`.
    pub fn submitted_id(&self, output: &CommandOutput) -> Option<JobId> {
        let (_, rest) = output.stdout.split_once(self.id_after.as_str())?;
        JobId::at_start_of(rest)
    }

    /// The state of a job in the output of `poll`; `None` if that says nothing about the job.
    pub fn polled_state(&self, output: &CommandOutput) -> Option<PolledState> {
        let rest = output.stdout.split_once(self.state_after.as_str()).map(|(_, rest)| rest);
        let word = rest.and_then(|rest| rest.split_whitespace().next()).filter(|_| output.success);
        if let Some(state) = word.and_then(|word| self.known_state(word)) {
            return Some(state);
        }
        if output.says_any(&self.vanished) {
            return Some(PolledState::Vanished);
        }
        // An unknown state is that of a living job.
        word.map(|_| PolledState::Running)
    }

    fn known_state(&self, word: &str) -> Option<PolledState> {
        let lists = [
            (&self.states.pending, PolledState::Pending),
            (&self.states.running, PolledState::Running),
            (&self.states.completed, PolledState::Completed),
            (&self.states.failed, PolledState::Failed),
            (&self.states.cancelled, PolledState::Cancelled),
        ];
        let found = lists.iter().find(|(words, _)| words.iter().any(|known| known == word));
        found.map(|(_, state)| *state)
    }
}
