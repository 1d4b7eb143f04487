//! Campaigns of scripted walks with arbitrary events.

use std::sync::Arc;

use orchestrator::selector::{
    CampaignMode, OnForgetting, Scheduling, SeedStructurePlan, Selector, SelectorSettings, SelectorSnapshot,
    UpdateProtocol,
};
use proptest::collection::vec;
use proptest::prelude::*;
use store::records::Commit;
use wire::WalkConditions;
use wire::messages::Outcome;
use wire::transport::WorkItem;

use super::memory::MemoryStore;
use super::scripted::{Event, Script, advance};
use super::{CAMPAIGN, completes_up_to, grader, mixture_of, seed_structure, settings};

/// Number of label jobs above which a live campaign raises its threshold.
const QUEUE_LIMIT: u64 = 5;

fn open(settings: &SelectorSettings, seeds: usize, snapshot: SelectorSnapshot) -> Selector {
    let seeds = (0..seeds)
        .map(|number| SeedStructurePlan { walks: walks_of(number), ..seed_structure(number) })
        .collect();
    let original = mixture_of(settings.version.version);
    let selector = Selector::restore(settings.clone(), CAMPAIGN, seeds, grader(), original, None, snapshot);
    let mut selector = selector.unwrap();
    if settings.mode == CampaignMode::Live {
        selector.raise_threshold_above(QUEUE_LIMIT);
        selector.decline_unlikely(0.5);
        selector.set_completion_model(completes_up_to(7.0));
    }
    selector
}

/// Every other seed structure has two walks.
fn walks_of(seed: usize) -> Vec<WalkConditions> {
    let walk = |repeat| WalkConditions { repeat, ..WalkConditions::default() };
    (0..1 + seed as u32 % 2).map(walk).collect()
}

/// Number of biased walks of so many seed structures.
pub fn biased_walks(seeds: usize) -> usize {
    (0..seeds).map(|seed| walks_of(seed).len()).sum()
}

/// The next event of a campaign.
#[derive(Clone, Copy, Debug)]
pub enum Act {
    /// An idle walker asks for an assignment.
    Ask,
    /// A busy walker (chosen by the index) delivers its report.
    Deliver(prop::sample::Index),
    /// A busy walker is interrupted after this number of steps.
    Interrupt(prop::sample::Index, u64),
    /// A busy walker is lost.
    Lose(prop::sample::Index),
    /// This number of structures waits for labels.
    Queue(u64),
    /// All processes die, and the campaign is restarted.
    Crash,
}

pub fn acts() -> impl Strategy<Value = Vec<Act>> {
    let index = any::<prop::sample::Index>;
    vec(
        prop_oneof![
            8 => Just(Act::Ask),
            6 => index().prop_map(Act::Deliver),
            3 => (index(), 0..12_u64).prop_map(|(index, steps)| Act::Interrupt(index, steps)),
            1 => index().prop_map(Act::Lose),
            2 => (0..2 * QUEUE_LIMIT + 3).prop_map(Act::Queue),
            1 => Just(Act::Crash),
        ],
        0..150,
    )
}

fn event() -> impl Strategy<Value = Event> {
    // Few numbers and directions, so that duplicates and covered structures are frequent.
    let structure = (0..12_u64, 0..3_usize, 1.0..9.0, prop::bool::weighted(0.1)).prop_map(
        |(number, direction, far, close)| {
            let mut z = [0.0; 3];
            z[direction] = far;
            Event::Structure { number, z, close }
        },
    );
    prop_oneof![
        12 => Just(Event::Nothing),
        8 => structure,
        2 => Just(Event::Return),
        1 => Just(Event::BlowUp),
        1 => Just(Event::Ungradable),
    ]
}

pub fn scripts() -> impl Strategy<Value = Vec<Script>> {
    vec(vec(event(), 5..60), 1..6)
}

pub fn any_settings() -> impl Strategy<Value = SelectorSettings> {
    let update = prop::sample::select(vec![
        UpdateProtocol::Cumulative,
        UpdateProtocol::PerSeedStructure,
        UpdateProtocol::PerWalk,
        UpdateProtocol::Never,
    ]);
    let limits = (
        1..6_u32,
        prop::option::of(1..8_u32),
        prop::option::of(1..12_u32),
        prop::option::weighted(0.3, 1..60_u64),
    );
    let on_forgetting = prop::sample::select(vec![OnForgetting::Warn, OnForgetting::Additive]);
    (1..5_usize, update, limits, any::<bool>(), 0..300_u64, on_forgetting).prop_map(
        |(walks, update, limits, control, declined_feature_bytes, on_forgetting)| {
            let (max_per_walk, max_per_seed_structure, total, max_steps_without_structure) = limits;
            SelectorSettings {
                walks_per_round: match update {
                    UpdateProtocol::PerSeedStructure | UpdateProtocol::PerWalk => 1,
                    UpdateProtocol::Cumulative | UpdateProtocol::Never => walks,
                },
                update,
                max_per_walk,
                max_per_seed_structure,
                max_structures: total,
                max_steps_without_structure,
                control,
                declined_feature_bytes,
                on_forgetting,
                ..settings(CampaignMode::Reproducible)
            }
        },
    )
}

/// A running campaign: the selector, its store, and busy walkers.
pub struct Campaign<'a> {
    settings: &'a SelectorSettings,
    scripts: &'a [Script],
    walkers: usize,
    pub selector: Selector,
    pub store: MemoryStore,
    at_work: Vec<WorkItem>,
    /// All commits except those that only record interrupted walks.
    pub commits: Vec<Commit>,
}

impl<'a> Campaign<'a> {
    pub fn begin(settings: &'a SelectorSettings, scripts: &'a [Script], walkers: usize) -> Self {
        let selector = open(settings, scripts.len(), SelectorSnapshot::default());
        let (store, at_work, commits) = (MemoryStore::default(), Vec::new(), Vec::new());
        let mut campaign = Self { settings, scripts, walkers, selector, store, at_work, commits };
        let commit = campaign.selector.start_walks();
        campaign.commit(commit);
        campaign
    }

    fn commit(&mut self, commit: Commit) {
        self.store.commit(&commit);
        let only_keeps = commit.decisions.is_empty() && commit.values.is_empty();
        if !only_keeps {
            self.commits.push(commit);
        }
    }

    /// Gives an assignment to an idle walker, if there are both.
    fn ask(&mut self) -> bool {
        if self.at_work.len() == self.walkers {
            return false;
        }
        match self.selector.next_assignment(0) {
            Scheduling::Assign(assignment) => {
                let mixture = Arc::clone(self.selector.mixture());
                self.at_work.push(WorkItem { assignment: *assignment, mixture });
                true
            }
            Scheduling::Wait => {
                assert!(!self.at_work.is_empty(), "nothing to wait for");
                false
            }
            Scheduling::Done => {
                assert!(self.selector.is_done() && self.at_work.is_empty());
                false
            }
        }
    }

    fn take(&mut self, index: prop::sample::Index) -> Option<WorkItem> {
        (!self.at_work.is_empty()).then(|| self.at_work.remove(index.index(self.at_work.len())))
    }

    fn deliver(&mut self, work: &WorkItem, pause_after: Option<u64>) {
        let seed = self.store.walks[&work.assignment.walk].seed_structure as usize;
        let report = advance(&self.scripts[seed], &work.assignment, &work.mixture, pause_after);
        let paused = report.outcome == Outcome::Interrupted;
        let commit = self.selector.report(report).unwrap();
        assert!(!paused || commit.is_some(), "an interrupted walk is kept at once");
        if let Some(commit) = commit {
            self.commit(commit);
        }
    }

    fn crash(&mut self) {
        self.at_work.clear();
        self.selector = open(self.settings, self.scripts.len(), self.store.snapshot());
        assert!(self.selector.start_walks().walks.is_empty());
    }

    /// All processes die, and the campaign continues with other settings.
    pub fn go_on(&mut self, settings: &'a SelectorSettings) {
        self.at_work.clear();
        self.settings = settings;
        self.selector = open(self.settings, self.scripts.len(), self.store.snapshot());
        let commit = self.selector.start_walks();
        self.commit(commit);
    }

    pub fn act(&mut self, act: Act) {
        let index = match act {
            Act::Ask => {
                self.ask();
                return;
            }
            Act::Queue(unfinished) => return self.selector.set_unfinished_jobs(unfinished),
            Act::Crash => return self.crash(),
            Act::Deliver(index) | Act::Interrupt(index, _) | Act::Lose(index) => index,
        };
        let Some(work) = self.take(index) else { return };
        match act {
            Act::Lose(_) => self.selector.assignment_lost(work.assignment.walk),
            Act::Interrupt(_, steps) => self.deliver(&work, Some(steps)),
            _ => self.deliver(&work, None),
        }
    }

    /// Continues without incidents until all walks have ended; with `crash_often`, with a crash after every commit.
    pub fn finish(mut self, crash_often: bool) -> Self {
        for _ in 0..10_000 {
            if self.selector.is_done() {
                return self;
            }
            while self.ask() {}
            let (work, commits) = (self.at_work.remove(0), self.commits.len());
            self.deliver(&work, None);
            if crash_often && self.commits.len() > commits {
                self.crash();
            }
        }
        panic!("the campaign does not end");
    }

    /// Everything that must be equal, as text. Different bits of a number give different text.
    pub fn content(&self) -> Vec<String> {
        let rest = format!("{:?} {:?} {:?}", self.store.walks, self.store.components, self.store.values);
        self.commits.iter().map(|commit| format!("{commit:?}")).chain([rest]).collect()
    }
}
