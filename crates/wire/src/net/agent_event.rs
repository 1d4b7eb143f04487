//! What happens to agents, for display and the log.

use super::message::AgentInfo;

/// An event of an agent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AgentEvent {
    /// It has joined.
    Joined(AgentInfo),
    /// Its heartbeat is missing: the link is down, or the agent is dead.
    Unresponsive(AgentInfo),
    /// Its heartbeat is back.
    Recovered(AgentInfo),
    /// Its heartbeat was missing for too long: others get its assignments.
    Lost(AgentInfo),
    /// It has left.
    Left(AgentInfo),
    /// A message was rejected, with the reason.
    MessageRejected(String),
}
