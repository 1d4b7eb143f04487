//! Timeouts and limits.

use std::time::Duration;

/// Timeouts and limits of a supervisor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// A child without heartbeat for this time is considered hung and killed.
    pub heartbeat_timeout: Duration,
    /// Delay before the restart after the first failure; doubles with each consecutive failure.
    pub initial_backoff: Duration,
    /// Maximum delay before a restart.
    pub max_backoff: Duration,
    /// Maximum number of consecutive restarts without a delivery; the child fails after that.
    pub max_restarts: u32,
    /// Time between asking a process to exit and killing it. Detached processes are left running instead.
    pub grace_period: Duration,
    /// Whether the children work for the campaign and not for the parent: they may continue without it, and exiting
    /// while there is work is a failure, whatever the exit code.
    pub detached: bool,
}

impl Default for Limits {
    fn default() -> Self {
        let seconds = Duration::from_secs;
        Self {
            heartbeat_timeout: seconds(120),
            initial_backoff: seconds(1),
            max_backoff: seconds(60),
            max_restarts: 5,
            grace_period: seconds(30),
            detached: false,
        }
    }
}
