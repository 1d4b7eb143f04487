//! What happens to agents, for display and the log.

use super::message::Agent;

/// An event of an agent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AgentEvent {
    /// It has joined.
    Joined(Agent),
    /// Its heartbeat is missing: the link is down, or the agent is dead.
    Unresponsive(Agent),
    /// Its heartbeat is back.
    Recovered(Agent),
    /// Its heartbeat was missing for too long: others get its assignments.
    Lost(Agent),
    /// It has left.
    Left(Agent),
    /// A message was rejected, with the reason.
    MessageRejected(String),
}
