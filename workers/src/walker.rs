//! A walker: asks for a turn, works on it, delivers what came of it.

use wire::transport::Transport;

use crate::walk::{WalkContext, advance};

/// Works until there is nothing more to do or the walker is asked to stop.
pub fn run(context: &WalkContext, transport: &mut impl Transport) {
    let mut report = None;
    while let Some(work) = transport.exchange(report.take()) {
        let walk = work.assignment.walk;
        let stopping = || transport.stopping();
        let watch = |progress| transport.progress(walk, progress);
        report = Some(advance(context, &work.assignment, work.mixture, stopping, watch));
    }
}
