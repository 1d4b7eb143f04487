//! The selector: owns the one mixture, decides on every candidate, and hands out the turns of walks.
//!
//! It has two halves. The judge decides what becomes of candidates and walks, one after the other, and knows
//! nothing of turns. The other half hands out turns and gathers what comes of them, in rounds if the campaign is to be
//! reproducible. What is replayed goes through the same judge.
//!
//! It is driven by three calls. [`Selector::next_assignment`] gives the next turn for a free walker, [`Selector::report`] takes
//! what came of a turn and returns what must be committed, and no turn is given out again before the caller has
//! committed it. All state that matters goes through a [`Commit`], so [`Selector::restore`] continues from the store
//! as if nothing had happened.

mod backlog;
mod decide;
mod decision_state;
mod regrade;
mod replay;
mod rules;
mod scheduling;
mod staleness;
mod start_walks;
mod walk;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use atoms::Structure;
use calm::watch::ForgettingAlarm;
use calm::{Mixture, MixtureError};
use serde::{Deserialize, Serialize};
use store::records::{Commit, ComponentRecord, WalkRecord};
use wire::messages::{Outcome, Report, WalkEnd};
use wire::{CampaignId, CandidateId, ContentHash, WalkId};

use crate::grader::{Grader, GraderError};
use backlog::Backlog;
pub use decide::TrainingFrames;
use decision_state::DecisionState;
pub use decision_state::restored_mixture;
pub use regrade::{RegradedCandidate, RegradedReport, Regrader};
pub use replay::{Replay, ReplayError, ReplayedDecision};
pub use scheduling::Scheduling;
pub use staleness::Staleness;
use walk::Walk;

/// The value under which the histogram of ages ([`Staleness`], JSON) is committed.
pub const STALENESS: &str = "staleness";

/// Whether the same campaign gives the same bytes each time, or walks never wait for each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// Walks advance in rounds; the decisions do not depend on the number of walkers or on their speed.
    Reproducible,
    /// Updates are applied as candidates arrive.
    Live,
}

impl Mode {
    /// `"reproducible"` or `"live"`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reproducible => "reproducible",
            Self::Live => "live",
        }
    }
}

/// What becomes of the mixture from one seed structure to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpdateProtocol {
    /// A seed structure starts from the coverage gathered before it.
    Carried,
    /// Each seed structure starts from the original mixture.
    Restarted,
    /// The mixture is never updated.
    Never,
}

/// What the selector needs to know of the configuration.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Reproducible or live.
    pub mode: Mode,
    /// Biased walks that advance together in a round.
    pub walks_per_round: usize,
    /// Steps of a turn.
    pub steps_per_assignment: u64,
    /// Carried, restarted or never.
    pub update: UpdateProtocol,
    /// How the covariance is updated and when the search for α stops.
    pub search: calm::UpdateSettings,
    /// When the training frames' grades are an alarm.
    pub forgetting_alarm: ForgettingAlarm,
    /// When a structure is a candidate.
    pub collection: calm::CollectionRule,
    /// Most structures accepted from one seed structure.
    pub max_per_seed_structure: u32,
    /// Most structures accepted in the campaign.
    pub max_structures: Option<u32>,
    /// Whether every biased walk that collected something is followed by its unbiased control.
    pub control: bool,
    /// Shortest distance below which a structure is refused, Å, and as a fraction of the seed structure's own.
    pub min_distance: (f64, f64),
    /// Bytes of feature vectors of declined candidates that are kept.
    pub declined_feature_bytes: u64,
}

/// Where walks start.
#[derive(Clone, Debug)]
pub struct SeedStructure {
    /// Name.
    pub name: String,
    /// Structure.
    pub structure: Structure,
}

/// What a store gives back of a selector.
#[derive(Clone, Debug, Default)]
pub struct SelectorSnapshot {
    /// Every walk.
    pub walks: Vec<WalkRecord>,
    /// The components that differ from the original mixture.
    pub components: Vec<ComponentRecord>,
    /// Hashes of the structures that are known already.
    pub known: Vec<ContentHash>,
    /// How many of them were imported.
    pub imported: u64,
    /// The values of past commits.
    pub values: Vec<(String, String)>,
}

/// Why the selector cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum SelectorError {
    /// A candidate that cannot be graded.
    #[error("candidate {candidate}: {source}")]
    Grade {
        /// Which.
        candidate: CandidateId,
        /// Why.
        source: GraderError,
    },
    /// An update that failed.
    #[error("updating the mixture for candidate {candidate}: {source}")]
    Update {
        /// Which.
        candidate: CandidateId,
        /// Why.
        source: calm::UpdateError,
    },
    /// A mixture that does not fit together.
    #[error(transparent)]
    Mixture(#[from] MixtureError),
    /// A seed structure that cannot be used.
    #[error("seed structure '{name}': {source}")]
    SeedStructure {
        /// Which.
        name: String,
        /// Why.
        source: GraderError,
    },
    /// A database that does not fit the campaign.
    #[error("the campaign's database cannot be continued: {0}")]
    Snapshot(String),
    /// Training frames that do not fit the mixture.
    #[error("grading the training frames: {source}")]
    Training {
        /// Why.
        source: calm::GradeError,
    },
}

/// The pure core. See the [module](self).
pub struct Selector {
    campaign: CampaignId,
    seeds: Vec<SeedStructure>,
    decisions: DecisionState,
    /// Walks of the round in hand, with the reports that have come in.
    in_round: BTreeMap<WalkId, Option<RegradedReport>>,
    /// Walks that get no turn for now.
    paused: BTreeSet<WalkId>,
}

impl Selector {
    /// A selector that continues from what a store holds, from nothing at the start of a campaign. Seed structures that
    /// have no walk yet are left to [`Selector::start_walks`].
    pub fn restore(
        settings: Settings,
        campaign: CampaignId,
        seeds: Vec<SeedStructure>,
        grader: Grader,
        original: Arc<Mixture>,
        training: Option<TrainingFrames>,
        snapshot: SelectorSnapshot,
    ) -> Result<Self, SelectorError> {
        let decisions = DecisionState::restore(settings, &seeds, grader, original, training, snapshot)?;
        Ok(Self { campaign, seeds, decisions, in_round: BTreeMap::new(), paused: BTreeSet::new() })
    }

    /// The mixture of the turns that [`Selector::next_assignment`] gives out.
    pub fn mixture(&self) -> &Arc<Mixture> {
        &self.decisions.mixture
    }

    /// Every walk for those who watch: its seed structure's name, and its step (`last` once it has ended).
    pub fn walk_progress(&self, last: u64) -> Vec<(WalkId, String, u64)> {
        let standing = |walk: &Walk| {
            let name = &self.seeds[walk.record.seed_structure as usize].name;
            let control = if walk.is_biased() { "" } else { " (control)" };
            let step = if walk.has_ended() { last } else { walk.record.progress.step };
            (walk.record.walk, format!("{name}{control}"), step)
        };
        self.decisions.walks.values().map(standing).collect()
    }

    /// The walks that have ended: number, state and reason.
    pub fn ended_walks(&self) -> impl Iterator<Item = (WalkId, &str, &str)> {
        let walks = self.decisions.walks.values().filter(|walk| walk.has_ended());
        walks.map(|Walk { record, .. }| (record.walk, record.state.as_str(), record.reason.as_str()))
    }

    /// Makes a walk for every seed structure that has none: at the start of a campaign, or when seed structures were
    /// added to it. Walks that had ended by a budget which has grown since go on. The commit is empty if there was
    /// nothing to do.
    pub fn start_walks(&mut self) -> Commit {
        self.decisions.start_walks(&self.seeds)
    }

    /// From now on the threshold of the collection rule is raised while more than `limit` label jobs are unfinished
    /// (see [`Self::set_unfinished_jobs`]). Live mode only: the length of the queue depends on what happens when.
    pub fn raise_threshold_above(&mut self, limit: u64) {
        self.decisions.backlog = Some(Backlog::above(limit));
    }

    /// Says how many label jobs are unfinished, for decisions and turns from now on.
    pub fn set_unfinished_jobs(&mut self, unfinished: u64) {
        self.decisions.threshold_factor =
            self.decisions.backlog.map_or(1.0, |backlog| backlog.factor(unfinished));
    }

    /// From now on these walks, and no others, get no turn. In reproducible mode their round waits for them, and so the other
    /// walks do: what is decided does not depend on who was paused when.
    pub fn set_paused(&mut self, walks: BTreeSet<WalkId>) {
        self.paused = walks;
    }

    /// Walkers have to wait while more label jobs than this are unfinished, where they are to wait above `limit` unless the
    /// threshold is raised first.
    pub fn max_unfinished_jobs(&self, limit: u64) -> u64 {
        self.decisions.backlog.map_or(limit, Backlog::bound)
    }

    /// Takes what came of a turn. What it returns must be committed before a turn that is asked for afterwards is given to
    /// anybody; further reports may be taken before that, if what they return is committed with it or after it.
    /// A report of a turn that is over changes nothing. One of the present turn counts also if nobody has it in hand as
    /// far as is known here: it comes from a walker that was taken for lost, or from before a restart.
    pub fn report(&mut self, report: Report) -> Result<Option<Commit>, SelectorError> {
        let regraded = self.decisions.regrader.regrade(report, &self.decisions.mixture);
        self.report_regraded(regraded)
    }

    /// Ends a walk whose turn, which a walker had in hand, cannot be worked on; as a report of that would.
    pub fn abandon_walk(&mut self, id: WalkId, reason: String) -> Result<Option<Commit>, SelectorError> {
        let Some(walk) = self.decisions.walks.get(&id) else { return Ok(None) };
        let WalkRecord { turn, checkpoint, progress, .. } = walk.record.clone();
        let (checkpoint, outcome) =
            (checkpoint.unwrap_or_default(), Outcome::Ended(WalkEnd::BlewUp { reason }));
        self.report(Report { walk: id, assignment: turn, outcome, checkpoint, progress })
    }

    /// What a report's candidate needs to be examined elsewhere, for [`Selector::report_regraded`].
    pub fn regrader(&self) -> &Regrader {
        &self.decisions.regrader
    }

    /// [`Selector::report`] of a report whose candidate has been examined already. What comes of it is the same, whenever
    /// that was.
    pub fn report_regraded(&mut self, report: RegradedReport) -> Result<Option<Commit>, SelectorError> {
        let (id, number) = (report.walk, report.assignment);
        let mode = self.decisions.settings.mode;
        let in_round = match mode {
            Mode::Live => true,
            Mode::Reproducible => self.in_round.get(&id).is_some_and(Option::is_none),
        };
        let present = |walk: &&mut Walk| in_round && walk.record.turn == number && !walk.has_ended();
        let Some(walk) = self.decisions.walks.get_mut(&id).filter(present) else { return Ok(None) };
        walk.is_assigned = false;
        if matches!(report.outcome, Outcome::Interrupted) {
            walk.interrupt(report);
            return Ok(Some(Commit { walks: vec![walk.to_record()], ..Commit::default() }));
        }
        let reports = match mode {
            Mode::Live => vec![report],
            Mode::Reproducible => {
                self.in_round.insert(id, Some(report));
                if self.in_round.values().any(Option::is_none) {
                    return Ok(None);
                }
                std::mem::take(&mut self.in_round).into_values().flatten().collect()
            }
        };
        self.decisions.decide(reports).map(Some)
    }
}
