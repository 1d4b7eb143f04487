//! Logging of commits.

use std::time::Duration;

use store::records::Commit;
use tracing::{debug, info};

/// Logs a commit with its decisions, and the time it took. Accepted candidates and events of walks have a higher level
/// than declined candidates, which are frequent.
pub fn committed(commit: &Commit, time: Duration) {
    for decision in &commit.decisions {
        let (kind, walk) = (decision.kind, decision.walk.map(|walk| walk.0));
        let candidate = decision.candidate.map(|id| id.to_string());
        let version = decision.mixture_version;
        match kind {
            "declined" | "control" => debug!(kind, walk, candidate, mixture_version = version, "decided"),
            _ => info!(kind, walk, candidate, mixture_version = version, "decided"),
        }
    }
    let (decisions, candidates) = (commit.decisions.len(), commit.candidates.len());
    debug!(decisions, candidates, walks = commit.walks.len(), seconds = time.as_secs_f64(), "committed");
}
