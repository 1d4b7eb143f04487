//! The state of a child, for its observers.

use std::time::Duration;

use super::exit_reason::ExitReason;

/// State of a child.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChildState {
    /// Started, without a heartbeat so far.
    Starting,
    /// Running.
    Running,
    /// Waiting for a restart.
    BackingOff {
        /// Remaining time.
        left: Duration,
    },
    /// Asked to exit, or killed, and still running.
    Stopping,
    /// Exited normally; it is not restarted.
    Exited,
    /// Failed too often; it is not restarted.
    Failed,
}

impl std::fmt::Display for ChildState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Starting => f.write_str("starting"),
            Self::Running => f.write_str("running"),
            Self::BackingOff { left } => write!(f, "backing off for {} s", left.as_secs_f64().ceil()),
            Self::Stopping => f.write_str("stopping"),
            Self::Exited => f.write_str("exited"),
            Self::Failed => f.write_str("failed"),
        }
    }
}

/// Status of a child.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChildStatus {
    /// Number of the child.
    pub number: u32,
    /// Start count; 0 for an adopted process.
    pub incarnation: u32,
    /// State.
    pub state: ChildState,
    /// Number of restarts after a failure.
    pub restarts: u32,
    /// The last failure.
    pub last_failure: Option<ExitReason>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn states_are_displayed() {
        let backing_off = ChildState::BackingOff { left: Duration::from_millis(1_200) };
        let shown = [
            (ChildState::Starting, "starting"),
            (ChildState::Running, "running"),
            (backing_off, "backing off for 2 s"),
            (ChildState::Stopping, "stopping"),
            (ChildState::Exited, "exited"),
            (ChildState::Failed, "failed"),
        ];
        for (state, text) in shown {
            assert_eq!(state.to_string(), text);
        }
    }
}
