//! Rule 6: decision log, mixture and data set are the same bytes for any number of walkers, any order of their reports,
//! any interruption, any loss, and any crash after any commit.

use std::collections::BTreeSet;

use orchestrator::selector::{CampaignMode, SelectorSettings, UpdateProtocol};
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use proptest::test_runner::TestRunner;
use store::records::Fate;
use wire::Origin;
use wire::messages::DeclineReason;

use crate::common::eventful::{Campaign, acts, any_settings, biased_walks, scripts};
use crate::common::scripted::Script;
use crate::common::{SHORTEST, grader, kinds};

/// One walker and no incidents.
fn calm_run<'a>(settings: &'a SelectorSettings, scripts: &'a [Script]) -> Campaign<'a> {
    Campaign::begin(settings, scripts, 1).finish(false)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn incidents_do_not_change_results(
        settings in any_settings(), scripts in scripts(), walkers in 1..7_usize, acts in acts(),
    ) {
        let mut eventful = Campaign::begin(&settings, &scripts, walkers);
        for act in acts {
            eventful.act(act);
        }
        let eventful = eventful.finish(false);
        prop_assert_eq!(eventful.content(), calm_run(&settings, &scripts).content());
    }

    #[test]
    fn a_crash_after_every_commit_changes_nothing(
        settings in any_settings(), scripts in scripts(), walkers in 1..7_usize,
    ) {
        let crashing = Campaign::begin(&settings, &scripts, walkers).finish(true);
        prop_assert_eq!(crashing.content(), calm_run(&settings, &scripts).content());
    }

    /// Live mode depends on the order of reports, but not on crashes while no walker is busy.
    #[test]
    fn a_live_campaign_survives_crashes(settings in any_settings(), scripts in scripts()) {
        let settings = SelectorSettings { mode: CampaignMode::Live, ..settings };
        let crashing = Campaign::begin(&settings, &scripts, 1).finish(true);
        prop_assert_eq!(crashing.content(), calm_run(&settings, &scripts).content());
    }

    /// Properties that hold for every campaign, whatever the events.
    #[test]
    fn budgets_versions_and_rounds_hold(
        settings in any_settings(), live in any::<bool>(), scripts in scripts(), walkers in 1..7_usize, acts in acts(),
    ) {
        let mode = if live { CampaignMode::Live } else { CampaignMode::Reproducible };
        let settings = SelectorSettings { mode, ..settings };
        let mut campaign = Campaign::begin(&settings, &scripts, walkers);
        for act in acts {
            campaign.act(act);
        }
        let campaign = campaign.finish(false);
        let count = |kind: &str| campaign.store.decisions.iter().filter(|d| d.kind == kind).count();
        let biased = || campaign.store.walks.values().filter(|walk| walk.origin == Origin::Biased);
        let accepted: Vec<u32> = biased().map(|walk| walk.accepted).collect();
        prop_assert_eq!(accepted.len(), biased_walks(scripts.len()));
        let of_seed = |seed: usize| biased().filter(move |walk| walk.seed_structure as usize == seed);
        for seed in 0..scripts.len() {
            let accepted: u32 = of_seed(seed).map(|walk| walk.accepted).sum();
            prop_assert!(settings.max_per_seed_structure.is_none_or(|most| accepted <= most));
            let repeats: Vec<u32> = of_seed(seed).map(|walk| walk.conditions.repeat).collect();
            prop_assert_eq!(repeats, (0..1 + seed as u32 % 2).collect::<Vec<_>>(), "walks in order");
        }
        prop_assert!(accepted.iter().all(|accepted| *accepted <= settings.max_per_walk));
        prop_assert_eq!(accepted.iter().sum::<u32>() as usize, count("accepted"));
        prop_assert_eq!(campaign.store.known.len(), count("accepted"));
        prop_assert!(settings.max_structures.is_none_or(|total| count("accepted") <= total as usize));
        prop_assert_eq!(campaign.store.walks.len(), count("begun"));
        prop_assert_eq!(campaign.store.walks.len(), count("ended"));
        let versions = campaign.store.decisions.iter().map(|decision| (decision.round, decision.mixture_version));
        prop_assert!(versions.is_sorted(), "rounds and versions only go up");
        let steps = match settings.update {
            UpdateProtocol::Never => 0,
            UpdateProtocol::Cumulative => count("accepted"),
            // Walks of a seed structure share the mixture, if they follow one another.
            UpdateProtocol::PerSeedStructure | UpdateProtocol::PerWalk if live => return Ok(()),
            UpdateProtocol::PerSeedStructure => count("accepted") + scripts.len(),
            UpdateProtocol::PerWalk => count("accepted") + biased_walks(scripts.len()),
        };
        prop_assert_eq!(campaign.selector.mixture().version(), steps as u64, "one version an update");
    }

    /// Each step at which a control walk shall provide a frame has a frame that the guard permits, or is left out, or comes
    /// after the end of the walk.
    #[test]
    fn control_frames_are_matched_by_step_or_left_out(
        settings in any_settings(), live in any::<bool>(), scripts in scripts(), walkers in 1..7_usize, acts in acts(),
    ) {
        let mode = if live { CampaignMode::Live } else { CampaignMode::Reproducible };
        let settings = SelectorSettings { mode, control: true, ..settings };
        let mut campaign = Campaign::begin(&settings, &scripts, walkers);
        acts.into_iter().for_each(|act| campaign.act(act));
        let campaign = campaign.finish(false);
        for candidate in campaign.commits.iter().flat_map(|commit| &commit.candidates) {
            let shortest = grader().bonds(&candidate.block.view().structure()).unwrap().shortest.shortest();
            let permitted = shortest >= 0.75 * SHORTEST;
            prop_assert!(permitted || candidate.fate == Fate::Declined(DeclineReason::TooClose), "{} Å", shortest);
        }
        for walk in campaign.store.walks.values().filter(|walk| walk.origin == Origin::Control) {
            let of_walk = |kind: &'static str| {
                let decisions = campaign.store.decisions.iter().filter(|decision| decision.walk == Some(walk.walk));
                decisions.filter(move |decision| decision.kind == kind)
            };
            let wanted = &of_walk("begun").next().unwrap().detail["wanted"];
            let wanted = wanted.as_array().unwrap().iter().map(|step| step.as_u64().unwrap());
            let frames = of_walk("control").map(|decision| decision.candidate.unwrap().step);
            let left_out = of_walk("left_out").map(|decision| decision.detail["step"].as_u64().unwrap());
            let mut found: Vec<u64> = frames.chain(left_out).collect();
            found.sort_unstable();
            let until = if walk.state == "quota_reached" { u64::MAX } else { walk.progress.step };
            prop_assert_eq!(found, wanted.filter(|step| *step <= until).collect::<Vec<_>>());
            prop_assert_eq!(walk.accepted as usize, of_walk("control").count());
        }
    }
}

/// The campaigns above cover what they should: every kind of decision and every reason occurs.
#[test]
fn the_scripts_reach_every_kind_of_decision() {
    let mut runner = TestRunner::deterministic();
    let (mut seen, mut close_frames) = (BTreeSet::new(), false);
    for _ in 0..100 {
        let settings = any_settings().new_tree(&mut runner).unwrap().current();
        let scripts = scripts().new_tree(&mut runner).unwrap().current();
        let campaign = calm_run(&settings, &scripts);
        seen.extend(campaign.commits.iter().flat_map(kinds));
        let left_out =
            campaign.store.decisions.iter().filter_map(|decision| decision.detail["error"].as_str());
        close_frames |= left_out.into_iter().any(|error| error.contains("closer than the limit"));
    }
    assert!(close_frames, "no control frame with atoms too close");
    let expected = [
        "accepted",
        "begun",
        "control",
        "declined budget",
        "declined covered",
        "declined duplicate",
        "declined too_close",
        "ended",
        "forgetting",
        "left_out",
        "segment",
    ];
    assert_eq!(seen.iter().map(String::as_str).collect::<Vec<_>>(), expected);
}
