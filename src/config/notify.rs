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
    /// The command and its arguments. Default: none; calmwalk sends no notifications.
    #[schemars(length(min = 1))]
    pub command: Option<Vec<String>>,
    /// Events for which calmwalk runs the command.
    pub on: Vec<NotifyEvent>,
    /// Time without a new candidate or label after which calmwalk reports that the campaign has stalled.
    pub stall_timeout: Duration,
    /// calmwalk runs the command each time that this many more labels have failed.
    pub failed_labels: NonZeroU32,
    /// Time after which calmwalk kills the command.
    pub time_limit: Duration,
}

/// An event of a campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum NotifyEvent {
    /// The campaign is finished.
    End,
    /// `calmwalk run` failed.
    Failure,
    /// There was no new candidate or label for `stall_timeout`.
    Stall,
    /// A budget is exhausted.
    Budget,
    /// As many labels failed as `failed_labels` says.
    FailedLabels,
    /// The forgetting alarm of the mixture is raised or over.
    Forgetting,
    /// Several walks in succession ended early.
    FailingWalks,
    /// A version of the potential was registered.
    Version,
    /// A version of the potential was refused.
    RefusedVersion,
}

impl NotifyEvent {
    /// All events.
    pub const ALL: [Self; 9] = [
        Self::End,
        Self::Failure,
        Self::Stall,
        Self::Budget,
        Self::FailedLabels,
        Self::Forgetting,
        Self::FailingWalks,
        Self::Version,
        Self::RefusedVersion,
    ];

    /// Name in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::End => "end",
            Self::Failure => "failure",
            Self::Stall => "stall",
            Self::Budget => "budget",
            Self::FailedLabels => "failed_labels",
            Self::Forgetting => "forgetting",
            Self::FailingWalks => "failing_walks",
            Self::Version => "version",
            Self::RefusedVersion => "refused_version",
        }
    }
}

impl NotifySection {
    /// Resolves a command that is a path relative to the directory of the configuration.
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
