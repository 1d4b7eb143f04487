//! A campaign that trains its potential, while the server crashes.

use super::server::{Campaign, control};
use crate::common::campaign::Small;
use crate::common::hosts::uninterrupted_outcome;
use crate::common::processes::wait_for_process;

/// Versions, decisions and mixture are those of a campaign in a file whose database never goes away.
#[test]
fn a_server_that_crashes_during_a_refit_changes_nothing() {
    let small = Small::with_two_versions();
    let expected = uninterrupted_outcome(&small);
    let mut campaign = Campaign::new(&small, "refits", 0, "");
    campaign.hosts.listens = false;
    let mut orchestrator = campaign.hosts.start_orchestrator();
    wait_for_process(campaign.home(), "refitter");
    control("crash");
    let ended = orchestrator.0.wait().unwrap();
    assert_eq!(ended.code(), Some(0), "{}", campaign.hosts.orchestrator_stderr());
    assert_eq!(campaign.outcome(), expected);
}
