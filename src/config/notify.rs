//! `[notify]`

use std::num::NonZeroU32;
use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::defaults;
use crate::duration::Duration;

/// The user's command that calmwalk runs at events of a campaign.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct NotifySection {
    /// The command and its arguments. Default: none, and no notification is sent.
    #[schemars(length(min = 1))]
    pub command: Option<Vec<String>>,
    /// Events for which the command is run.
    pub on: Vec<NotifyEvent>,
    /// Time without a new candidate or label after which a campaign has stalled.
    pub stall_timeout: Duration,
    /// Number of failed labels after which the command is run, and again after as many more.
    pub failed_labels: NonZeroU32,
    /// Time after which the command is killed.
    pub time_limit: Duration,
}

/// What may happen to a campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum NotifyEvent {
    /// It is finished.
    End,
    /// `calmwalk run` cannot go on with it.
    Failure,
    /// Nothing is found and nothing labelled.
    Stall,
    /// A budget is used up.
    Budget,
    /// Labels failed.
    FailedLabels,
    /// The mixture forgets its training data, or does so no longer.
    Forgetting,
    /// Walk after walk ends early.
    FailingWalks,
}

impl NotifyEvent {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::End,
        Self::Failure,
        Self::Stall,
        Self::Budget,
        Self::FailedLabels,
        Self::Forgetting,
        Self::FailingWalks,
    ];

    /// As the configuration has it.
    pub fn name(self) -> &'static str {
        match self {
            Self::End => "end",
            Self::Failure => "failure",
            Self::Stall => "stall",
            Self::Budget => "budget",
            Self::FailedLabels => "failed_labels",
            Self::Forgetting => "forgetting",
            Self::FailingWalks => "failing_walks",
        }
    }
}

impl NotifySection {
    /// A command that is given as a path is one relative to the configuration.
    pub(super) fn resolve_paths(&mut self, directory: &Path) {
        if let Some(program) = self.command.iter_mut().flatten().next().filter(|name| name.contains('/')) {
            *program = directory.join(&*program).to_string_lossy().into_owned();
        }
    }
}

impl Default for NotifySection {
    fn default() -> Self {
        Self {
            command: None,
            on: NotifyEvent::ALL.into(),
            stall_timeout: Duration::from_seconds(7200),
            failed_labels: defaults::nonzero(10),
            time_limit: Duration::from_seconds(60),
        }
    }
}
