//! The two sides of a connection.

/// Side of a connection.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum ConnectionSide {
    Orchestrator,
    Agent,
}
