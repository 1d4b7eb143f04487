//! Replaying a campaign's log gives exactly the same decisions with the same rules, and different ones with others.

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;

use atoms::{MinDistanceRule, Uniform};
use calm::forgetting::ForgettingAlarm;
use calm::rules::{MaximumGrade, MaximumGradeUpdate};
use calm::{CollectionRule, Mixture, UpdateRule};
use orchestrator::selector::{
    AcceptedAtoms, CampaignMode, MixtureHistory, OnForgetting, Replay, ReplayedDecision, SelectorSettings,
    SelectorSnapshot, TrainingFrames, UpdateProtocol, VERSION,
};
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use proptest::test_runner::TestRunner;
use store::records::{CandidateRecord, Commit, ComponentRecord, Fate, LoggedDecision};
use wire::ContentHash;

use crate::common::eventful::{Campaign, acts, any_settings, scripts};
use crate::common::scripted::{Event, Script};
use crate::common::{
    SHORTEST, decided, grader, kinds, mixture, mixture_of, next_assignment, offer, positive, seed_structure,
    settings, structure, try_restore, with_version,
};

/// The decisions of a campaign as restored from a store, each with its candidate.
fn log<'a>(campaign: &'a Campaign<'_>) -> Vec<(LoggedDecision, Option<&'a CandidateRecord>)> {
    logged(&campaign.commits)
}

/// The same of commits.
fn logged(commits: &[Commit]) -> Vec<(LoggedDecision, Option<&CandidateRecord>)> {
    let candidates = commits.iter().flat_map(|commit| &commit.candidates);
    let candidates: BTreeMap<_, _> = candidates.map(|c| (c.block.view().id().to_string(), c)).collect();
    let logged = |(decision, sequence): (&store::records::Decision, i64)| {
        let candidate = decision.candidate.map(|id| id.to_string());
        let record = candidate.as_ref().map(|id| candidates[id]);
        let decision = LoggedDecision {
            sequence,
            round: decision.round,
            kind: decision.kind.to_owned(),
            walk: decision.walk.map(|walk| walk.0),
            candidate,
            mixture_version: decision.mixture_version,
            detail: serde_json::from_str(&decision.detail.to_string()).unwrap(),
        };
        (decision, record)
    };
    commits.iter().flat_map(|commit| &commit.decisions).zip(1..).map(logged).collect()
}

fn open(campaign: &Campaign<'_>, settings: &SelectorSettings, seeds: usize, set: &[&str]) -> Replay {
    let set: HashSet<String> = set.iter().map(|key| (*key).to_owned()).collect();
    let seeds = (0..seeds).map(seed_structure).collect();
    let imported = campaign.store.imported.clone();
    Replay::new(settings.clone(), set, seeds, grader(), mixture(), None, imported).unwrap()
}

/// The original mixture of the version that a decision switches to.
fn original_of(decision: &LoggedDecision) -> Arc<Mixture> {
    mixture_of(decision.detail["version"].as_u64().unwrap() as u32)
}

/// Replays each decision of the log.
fn follow(
    replay: &mut Replay,
    log: &[(LoggedDecision, Option<&CandidateRecord>)],
) -> Vec<Option<ReplayedDecision>> {
    let next = |(decision, candidate): &(LoggedDecision, Option<&CandidateRecord>)| {
        let examine = |record: &&CandidateRecord| {
            replay.regrader().regrade_block(record.block.clone(), replay.mixture()).unwrap()
        };
        let examined = candidate.as_ref().map(examine);
        if decision.kind == VERSION {
            return replay.take_up_version(decision, grader(), original_of(decision), None).unwrap();
        }
        replay.apply(decision, examined).unwrap()
    };
    log.iter().map(next).collect()
}

/// Replays a campaign with its own rules and checks that all decisions are equal.
fn check_exact(campaign: &Campaign<'_>, settings: &SelectorSettings, seeds: usize) {
    let log = log(campaign);
    let mut replay = open(campaign, settings, seeds, &[]);
    let replayed = follow(&mut replay, &log);
    for ((recorded, candidate), now) in log.iter().zip(replayed) {
        let now = now.unwrap_or_else(|| panic!("nothing comes of {recorded:?}"));
        let ReplayedDecision { decision, candidate: graded } = now;
        let found =
            (decision.kind, decision.walk.map(|walk| walk.0), decision.mixture_version, decision.round);
        assert_eq!(found, (recorded.kind.as_str(), recorded.walk, recorded.mixture_version, recorded.round));
        assert_eq!(decision.candidate.map(|id| id.to_string()), recorded.candidate);
        assert_eq!(decision.detail.to_string(), recorded.detail.to_string(), "{recorded:?}");
        let (before, now) = (candidate.map(|c| (&c.selector, &c.original, c.fate)), graded.as_ref());
        assert_eq!(before, now.map(|c| (&c.selector, &c.original, c.fate)));
    }
    let components = campaign.store.components.iter();
    let components: Vec<_> = components
        .map(|(&(element, slot), bytes)| ComponentRecord { element, slot, bytes: bytes.clone() })
        .collect();
    let version = campaign.selector.mixture().version();
    assert_eq!(
        (replay.mixture().version(), replay.first_different_component(version, &components).unwrap()),
        (version, None)
    );
    assert_eq!(replay.cut_short(), 0);
    check_history(&log, settings, &replay);
}

/// Follows the mixture by the decisions that change it, and checks that its updates and its end are those of the replay.
fn check_history(
    log: &[(LoggedDecision, Option<&CandidateRecord>)],
    settings: &SelectorSettings,
    replay: &Replay,
) {
    let mut history = MixtureHistory::new(settings.search.clone(), mixture());
    for (recorded, candidate) in log {
        let update = match candidate.filter(|_| history.is_update(recorded)) {
            Some(candidate) => {
                let view = candidate.block.view();
                let elements = grader().element_indices(&view.structure()).unwrap();
                let atoms = AcceptedAtoms { elements: &elements, features: view.features };
                history.apply(recorded, Some(atoms)).unwrap()
            }
            None if recorded.kind == VERSION => {
                let original = original_of(recorded).at_version(recorded.mixture_version);
                history = MixtureHistory::new(settings.search.clone(), Arc::new(original));
                None
            }
            None => history.apply(recorded, None).unwrap(),
        };
        let expected = recorded.detail.get("update").map(|update| update.to_string());
        assert_eq!(update.map(|update| update.to_string()), expected, "{recorded:?}");
    }
    assert_eq!(history.mixture(), replay.mixture());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn every_decision_is_reproduced(
        settings in any_settings(), live in any::<bool>(), scripts in scripts(), walkers in 1..7_usize, acts in acts(),
    ) {
        let mode = if live { CampaignMode::Live } else { CampaignMode::Reproducible };
        let settings = SelectorSettings { mode, ..settings };
        let mut campaign = Campaign::begin(&settings, &scripts, walkers);
        acts.into_iter().for_each(|act| campaign.act(act));
        check_exact(&campaign.finish(false), &settings, scripts.len());
    }

    /// The rules change twice, and structures that walks will meet are imported.
    #[test]
    fn replays_include_changed_rules_and_imports(
        settings in any_settings(), live in any::<bool>(), scripts in scripts(), walkers in 1..7_usize,
        parts in prop::array::uniform3(acts()), limits in prop::array::uniform2((1..6_u32, prop::option::of(1..12_u32))),
        imports in prop::collection::vec(0..12_u64, 0..6),
    ) {
        let mode = if live { CampaignMode::Live } else { CampaignMode::Reproducible };
        let settings = SelectorSettings { mode, ..settings };
        let [second, third] =
            limits.map(|(max_per_walk, total)| SelectorSettings { max_per_walk, max_structures: total, ..settings.clone() });
        let [first, middle, last] = parts;
        let mut campaign = Campaign::begin(&settings, &scripts, walkers);
        first.into_iter().for_each(|act| campaign.act(act));
        let hash = |number| ContentHash::from_structure(&structure(number, SHORTEST));
        campaign.store.imported = imports.into_iter().map(hash).collect();
        campaign.go_on(&second);
        middle.into_iter().for_each(|act| campaign.act(act));
        campaign.go_on(&third);
        last.into_iter().for_each(|act| campaign.act(act));
        check_exact(&campaign.finish(false), &settings, scripts.len());
    }

    /// The log switches to two versions of the potential, to the second after walks made room for it; or it was refused.
    #[test]
    fn replays_include_versions_of_the_potential(
        settings in any_settings(), live in any::<bool>(), scripts in scripts(), walkers in 1..7_usize,
        parts in prop::array::uniform3(acts()), refit_at in 1..6_u32, refused in any::<bool>(),
    ) {
        let mode = if live { CampaignMode::Live } else { CampaignMode::Reproducible };
        let settings = SelectorSettings { mode, ..settings };
        let second = SelectorSettings { refit_at: Some(refit_at), ..with_version(&settings, 1) };
        let third = if refused { with_version(&settings, 1) } else { with_version(&settings, 3) };
        let [first, middle, last] = parts;
        let mut campaign = Campaign::begin(&settings, &scripts, walkers);
        first.into_iter().for_each(|act| campaign.act(act));
        campaign.go_on(&second);
        middle.into_iter().for_each(|act| campaign.act(act));
        campaign.go_on(&third);
        last.into_iter().for_each(|act| campaign.act(act));
        check_exact(&campaign.finish(false), &settings, scripts.len());
    }

    /// If the mixture is never updated, the threshold alone decides which of the offered structures are new.
    #[test]
    fn a_stricter_rule_accepts_structures_above_its_threshold(
        settings in any_settings(), scripts in scripts(), threshold in 1.5..9.0,
    ) {
        let settings = SelectorSettings { update: UpdateProtocol::Never, max_per_walk: 100, max_per_seed_structure: None, max_structures: None, ..settings };
        let campaign = Campaign::begin(&settings, &scripts, 1).finish(false);
        let log = log(&campaign);
        let collection = CollectionRule::MaximumGrade(MaximumGrade { threshold: positive(threshold) });
        let strict = SelectorSettings { collection, ..settings.clone() };
        let replayed = follow(&mut open(&campaign, &strict, scripts.len(), &["collect.criterion"]), &log);
        for ((recorded, candidate), now) in log.iter().zip(replayed) {
            let (Some(candidate), true) = (candidate, recorded.kind != "control") else { continue };
            let above = candidate.selector.gamma.iter().any(|gamma| *gamma > threshold);
            let was_accepted = candidate.fate == Fate::Accepted;
            let now = now.unwrap().candidate.unwrap();
            prop_assert_eq!(&now.selector, &candidate.selector);
            // A structure that is no longer in the data set cannot have duplicates, so some declined ones are now
            // accepted.
            if was_accepted {
                prop_assert_eq!(now.fate == Fate::Accepted, above);
            } else if now.fate == Fate::Accepted {
                prop_assert!(above);
            }
        }
    }
}

/// A walk that offers new structures in its first steps.
fn offers(numbers: impl IntoIterator<Item = u64>) -> Script {
    let structure = |number| Event::Structure { number, z: [0.0, 3.0, 0.0], close: false };
    numbers.into_iter().map(structure).chain((0..20).map(|_| Event::Nothing)).collect()
}

/// The mixture is never updated, so that all structures are new to it.
fn never(max_per_walk: u32) -> SelectorSettings {
    SelectorSettings { update: UpdateProtocol::Never, max_per_walk, ..settings(CampaignMode::Reproducible) }
}

/// Kind of each decision of a replay; "–" for those that are not made.
fn kinds_of(replayed: &[Option<ReplayedDecision>]) -> Vec<&'static str> {
    replayed.iter().map(|now| now.as_ref().map_or("–", |now| now.decision.kind)).collect()
}

#[test]
fn nothing_is_decided_about_a_walk_that_other_rules_have_ended() {
    let lax = never(3);
    let scripts = [offers(1..4)];
    let campaign = Campaign::begin(&lax, &scripts, 1).finish(false);
    let log = log(&campaign);
    let strict = SelectorSettings { max_per_walk: 1, ..lax.clone() };
    let mut replay = open(&campaign, &strict, 1, &["collect.max_per_walk"]);
    let mut made = Vec::new();
    for next in &log {
        let is_reached = replay.is_reached(&next.0).unwrap();
        let now = follow(&mut replay, std::slice::from_ref(next));
        assert!(next.1.is_none() || is_reached == now[0].is_some(), "{next:?}");
        made.extend(now);
    }
    assert_eq!(kinds_of(&made), ["begun", "accepted", "–", "–", "–"]);
    assert_eq!(replay.cut_short(), 0);
}

#[test]
fn walks_that_a_limit_has_ended_and_others_would_not_are_counted() {
    let budget = SelectorSettings { max_structures: Some(1), ..never(3) };
    let of_budget = [offers([1]), offers([])];
    let (of_quota, completed) = ([offers([1])], [offers([])]);
    // The second seed structure has two walks. The first walk would have gone on as well.
    let cases = [(budget, &of_budget[..], 3), (never(1), &of_quota[..], 1), (never(1), &completed[..], 0)];
    for (limited, scripts, cut_short) in cases {
        let campaign = Campaign::begin(&limited, scripts, 1).finish(false);
        let log = log(&campaign);
        let mut replay = open(&campaign, &never(9), scripts.len(), &["collect.max_per_walk"]);
        let ends = kinds_of(&follow(&mut replay, &log)).iter().filter(|kind| **kind == "ended").count();
        assert_eq!((replay.cut_short(), ends), (cut_short, campaign.store.walks.len()), "{log:?}");
    }
}

/// The log changes other rules, but not those that were set; there are no control walks.
#[test]
fn what_was_set_stays_and_control_walks_are_left_out() {
    let few = SelectorSettings { control: true, ..never(1) };
    let more = SelectorSettings { max_per_walk: 3, ..few.clone() };
    let scripts = [offers(1..3)];
    let mut campaign = Campaign::begin(&few, &scripts, 1).finish(false);
    campaign.go_on(&more);
    let campaign = campaign.finish(false);
    let log = log(&campaign);
    let kinds: Vec<_> = log.iter().map(|(recorded, _)| recorded.kind.as_str()).collect();
    assert_eq!(kinds[..7], ["begun", "accepted", "ended", "begun", "control", "ended", "configuration"]);
    assert_eq!(kinds[7..9], ["resumed", "accepted"]);
    let replayed = follow(&mut open(&campaign, &few, 1, &["collect.max_per_walk"]), &log);
    let made = kinds_of(&replayed);
    assert_eq!(made[..7], ["begun", "accepted", "ended", "–", "–", "–", "configuration"]);
    assert!(made[7..].iter().all(|kind| *kind == "–"), "{made:?}");
}

/// An alarm about the last structure of a walk, with and without a switch to additive updates.
#[test]
fn the_end_of_a_walk_is_found_beside_a_switch_to_additive_updates() {
    let far = |number: u64| [0.0, 1.5 * 2_f64.powi(number as i32), 0.0];
    let event = |number| Event::Structure { number, z: far(number), close: false };
    let scripts = [(1..9).map(event).collect::<Script>()];
    let rules = |on_forgetting, max_per_walk| {
        let limit = ForgettingAlarm { mean_square_growth: positive(1.5), ..ForgettingAlarm::default() };
        let reproducible = settings(CampaignMode::Reproducible);
        let mut rules =
            SelectorSettings { on_forgetting, max_per_walk, forgetting_alarm: limit, ..reproducible };
        rules.search.stop = UpdateRule::MaximumGrade(MaximumGradeUpdate { target: positive(2.9) });
        rules
    };
    let long = rules(OnForgetting::Additive, 50);
    let whole = Campaign::begin(&long, &scripts, 1).finish(false);
    let until_alarm = log(&whole).iter().position(|(recorded, _)| recorded.kind == "forgetting").unwrap() - 1;
    for (then, now) in
        [(OnForgetting::Additive, OnForgetting::Warn), (OnForgetting::Warn, OnForgetting::Additive)]
    {
        let [made_with, other] = [then, now].map(|rule| rules(rule, until_alarm as u32));
        let campaign = Campaign::begin(&made_with, &scripts, 1).finish(false);
        let log = log(&campaign);
        let replayed = follow(&mut open(&campaign, &other, 1, &["calm.on_forgetting"]), &log);
        let mut expected: Vec<_> = log.iter().map(|(recorded, _)| recorded.kind.as_str()).collect();
        assert_eq!(expected.last(), Some(&"ended"));
        assert_eq!(expected.contains(&"forgetting"), then == OnForgetting::Additive);
        expected.iter_mut().filter(|kind| **kind == "forgetting").for_each(|kind| *kind = "–");
        assert_eq!(kinds_of(&replayed), expected);
    }
}

#[test]
fn the_first_component_in_which_a_mixture_differs_is_found() {
    let settings = settings(CampaignMode::Reproducible);
    // Its atoms belong to different components.
    let scripts = [vec![Event::Structure { number: 1, z: [20.0, 3.0, 0.0], close: false }]];
    let campaign = Campaign::begin(&settings, &scripts, 1).finish(false);
    let mut replay = open(&campaign, &settings, 1, &[]);
    follow(&mut replay, &log(&campaign));
    let mut components = Vec::new();
    for differs in [Some((0, 0)), Some((0, 1)), None] {
        assert_eq!(replay.first_different_component(1, &components).unwrap(), differs);
        if let Some((element, slot)) = differs.map(|(element, slot)| (element as u32, slot as u32)) {
            let bytes = campaign.store.components[&(element, slot)].clone();
            components.push(ComponentRecord { element, slot, bytes });
        }
    }
}

/// Versions without this rule have labelled control frames whatever their distances.
#[test]
fn control_frames_that_were_labelled_although_too_close_are_left_out_in_a_replay() {
    let lax = MinDistanceRule::Uniform(Uniform { min_distance: 0.1, fraction: 0.1 });
    let never = UpdateProtocol::Never;
    let strict = SelectorSettings { control: true, update: never, ..settings(CampaignMode::Reproducible) };
    let before = SelectorSettings { min_distances: lax, ..strict.clone() };
    let event = |number: u64| match number {
        5..8 => Event::Structure { number, z: [0.0, 3.0 * number as f64, 0.0], close: false },
        _ => Event::Nothing,
    };
    let scripts = [(0..30).map(event).collect()];
    let campaign = Campaign::begin(&before, &scripts, 1).finish(false);
    let log = log(&campaign);
    let replayed = follow(&mut open(&campaign, &strict, 1, &[]), &log);
    let mut changed = 0;
    for ((recorded, _), now) in log.iter().zip(replayed) {
        let now = now.unwrap().decision;
        if recorded.kind != now.kind {
            assert_eq!((recorded.kind.as_str(), now.kind), ("control", "left_out"));
            changed += 1;
        }
    }
    assert_eq!(changed, 1, "{log:?}");
}

/// Versions without this rule have accepted structures whatever their grades. Walks begin with the bound in the log, or without one.
#[test]
fn grades_beyond_the_bound_are_declined_in_a_replay_where_they_were() {
    let bounded =
        SelectorSettings { max_per_walk: 9, max_grade: Some(4.0), ..settings(CampaignMode::Reproducible) };
    let before = SelectorSettings { max_grade: None, ..bounded.clone() };
    let event = |number: u64| match number {
        5..8 => Event::Structure { number, z: [0.0, 3.0 * number as f64, 0.0], close: false },
        _ => Event::Nothing,
    };
    let scripts = [(0..30).map(event).collect()];
    for (made_with, is_bounded) in [(&before, false), (&bounded, true)] {
        let campaign = Campaign::begin(made_with, &scripts, 1).finish(false);
        let log = log(&campaign);
        let is_too_large =
            |decision: &LoggedDecision| decision.detail.to_string().contains("grade_too_large");
        assert_eq!(log.iter().any(|(recorded, _)| is_too_large(recorded)), is_bounded, "{log:?}");
        let replayed = follow(&mut open(&campaign, &bounded, 1, &[]), &log);
        for ((recorded, _), now) in log.iter().zip(replayed) {
            let now = now.unwrap().decision;
            let expected = (recorded.kind.as_str(), recorded.detail.to_string());
            assert_eq!((now.kind, now.detail.to_string()), expected);
        }
    }
}

/// An update under which a training atom has no grade is left out again.
#[test]
fn updates_that_were_left_out_are_left_out_in_a_replay() {
    let live = settings(CampaignMode::Live);
    let training = TrainingFrames::new(&[0], &[0.0, 0.0, 1.3e154], &mixture()).unwrap();
    let mut selector = try_restore(&live, 1, Some(training.clone()), SelectorSnapshot::default()).unwrap();
    let mut commits = vec![selector.start_walks()];
    for (number, z) in [(1, [0.0, 3.0, 0.0]), (2, [0.0, 0.0, 3.0])] {
        let assignment = next_assignment(&mut selector);
        let report = offer(&selector, &assignment, number, structure(number, SHORTEST), z);
        commits.push(decided(&mut selector, report));
    }
    assert_eq!(commits.iter().flat_map(kinds).collect::<Vec<_>>(), ["begun", "left_out", "accepted"]);
    let (none, seeds) = (HashSet::new(), vec![seed_structure(0)]);
    let mut replay = Replay::new(live, none, seeds, grader(), mixture(), Some(training), Vec::new()).unwrap();
    let log = logged(&commits);
    for ((recorded, _), now) in log.iter().zip(follow(&mut replay, &log)) {
        let now = now.unwrap().decision;
        assert_eq!(
            (now.kind, &now.detail.to_string()),
            (recorded.kind.as_str(), &recorded.detail.to_string())
        );
    }
    assert_eq!(replay.mixture(), selector.mixture());
}

/// The campaigns above cover what they should: rules change in the middle of them, and imports are met.
#[test]
fn the_campaigns_cover_the_intended_cases() {
    let mut runner = TestRunner::deterministic();
    let mut seen = HashSet::new();
    for _ in 0..60 {
        let settings = any_settings().new_tree(&mut runner).unwrap().current();
        let settings =
            SelectorSettings { mode: CampaignMode::Live, update: UpdateProtocol::Cumulative, ..settings };
        let scripts: Vec<Script> = scripts().new_tree(&mut runner).unwrap().current();
        let more = SelectorSettings {
            max_per_walk: settings.max_per_walk + 3,
            max_structures: None,
            ..settings.clone()
        };
        let mut campaign = Campaign::begin(&settings, &scripts, 2);
        for act in acts().new_tree(&mut runner).unwrap().current() {
            campaign.act(act);
        }
        let mut campaign = campaign.finish(false);
        campaign.store.imported =
            (0..12).map(|n| ContentHash::from_structure(&structure(n, SHORTEST))).collect();
        campaign.go_on(&more);
        let campaign = campaign.finish(false);
        check_exact(&campaign, &settings, scripts.len());
        seen.extend(campaign.commits.iter().flat_map(kinds));
        let decisions = campaign.commits.iter().flat_map(|commit| &commit.decisions);
        seen.extend(decisions.filter_map(|decision| decision.detail["end"].as_str().map(str::to_owned)));
    }
    for kind in [
        "configuration",
        "imported",
        "resumed",
        "segment",
        "declined backlog",
        "declined budget",
        "declined covered",
        "declined duplicate",
        "declined too_close",
        "declined unlikely_to_complete",
        "nothing_new",
    ] {
        assert!(seen.contains(kind), "no {kind} in {seen:?}");
    }
}
