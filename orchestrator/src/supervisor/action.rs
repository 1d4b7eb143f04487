//! What the supervisor asks for.

/// What to do with a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SupervisorAction {
    /// Start it. It counts as started from now on; if the start fails, it has exited with [`super::ExitReason::StartFailed`].
    Start {
        /// Number of the child.
        number: u32,
        /// Start count of this child, from 1.
        incarnation: u32,
    },
    /// Ask it to exit (SIGTERM).
    Terminate {
        /// Number of the child.
        number: u32,
    },
    /// Kill it (SIGKILL).
    Kill {
        /// Number of the child.
        number: u32,
    },
}
