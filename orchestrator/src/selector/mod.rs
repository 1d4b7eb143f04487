//! The selector: owns the mixture, decides on every candidate, and assigns the walks to walkers.
//!
//! It has two parts. `DecisionState` decides on candidates and walks, one after the other, and knows nothing of
//! assignments. The other part hands out assignments and collects reports, in rounds if the campaign is reproducible. A
//! replay uses the same `DecisionState`.
//!
//! Three calls drive it. [`Selector::next_assignment`] returns the next assignment for an idle walker.
//! [`Selector::report`] takes the report on an assignment and returns what must be committed; no later assignment may
//! be sent before the caller has committed it. All relevant state is part of a [`Commit`], so [`Selector::restore`]
//! continues exactly from the store.

mod backlog;
mod completion;
mod decide;
mod decision_state;
mod error;
mod forgetting;
mod mixture_history;
mod regrade;
mod replay;
mod rules;
mod scheduling;
mod settings;
mod start_walks;
mod training_frames;
mod walk;
mod walk_table;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use calm::Mixture;
use store::records::{Commit, WalkRecord};
use wire::conditions::VariedConditions;
use wire::messages::{AssignmentReport, Outcome, WalkEnd};
use wire::{CampaignId, CompletionCoefficients, WalkId};

use crate::grader::Grader;
use backlog::Backlog;
use completion::{CompletionRule, ProbabilitySource};
pub use decide::update_settings_in_force;
use decision_state::DecisionState;
pub use decision_state::VERSION;
pub use error::SelectorError;
pub use mixture_history::{AcceptedAtoms, MixtureHistory};
pub use regrade::{RegradedCandidate, RegradedReport, Regrader};
pub use replay::{Replay, ReplayError, ReplayedDecision};
pub use scheduling::Scheduling;
pub use settings::{
    CampaignMode, OnForgetting, PotentialVersion, SeedStructurePlan, SelectorSettings, SelectorSnapshot,
    UpdateProtocol,
};
pub use training_frames::TrainingFrames;
use walk::Walk;

/// The selector. See the [module](self).
pub struct Selector {
    campaign: CampaignId,
    seed_structures: Vec<SeedStructurePlan>,
    decisions: DecisionState,
    /// The walker of each assigned walk, until it reports or is lost.
    assigned: BTreeMap<WalkId, u32>,
    /// Walks of the current round that have not reported yet (reproducible mode), …
    outstanding: BTreeSet<WalkId>,
    /// … and the reports of the others.
    reports: BTreeMap<WalkId, RegradedReport>,
    /// Walks that get no assignments for now.
    paused: BTreeSet<WalkId>,
    /// Biased and control walks that can be assigned.
    ready: [BTreeSet<WalkId>; 2],
}

impl Selector {
    /// A selector that continues from the state in a store, which is empty at the start of a campaign. New seed
    /// structures get their walks by [`Selector::start_walks`].
    pub fn restore(
        settings: SelectorSettings,
        campaign: CampaignId,
        seed_structures: Vec<SeedStructurePlan>,
        grader: Grader,
        original: Arc<Mixture>,
        training: Option<TrainingFrames>,
        snapshot: SelectorSnapshot,
    ) -> Result<Self, SelectorError> {
        let decisions =
            DecisionState::restore(settings, &seed_structures, grader, original, training, snapshot)?;
        let mut selector = Self {
            campaign,
            seed_structures,
            decisions,
            assigned: BTreeMap::new(),
            outstanding: BTreeSet::new(),
            reports: BTreeMap::new(),
            paused: BTreeSet::new(),
            ready: Default::default(),
        };
        let walks: Vec<WalkId> = selector.decisions.walks.iter().map(|walk| walk.record.walk).collect();
        selector.update_ready(walks);
        Ok(selector)
    }

    /// The mixture for the assignments of [`Selector::next_assignment`].
    pub fn mixture(&self) -> &Arc<Mixture> {
        &self.decisions.mixture
    }

    /// The original mixture of the version of the potential in force.
    pub fn original(&self) -> &Arc<Mixture> {
        &self.decisions.regrader.original
    }

    /// How near the alarm over a mixture that forgets its training data is: it is raised above 1.
    pub fn forgetting_level(&self) -> f64 {
        self.decisions.forgetting_state().level
    }

    /// Every walk, for display: name of its seed structure, and its step (`last` if it has ended).
    pub fn walk_progress(&self, last: u64) -> Vec<(WalkId, String, u64)> {
        let varied = VariedConditions::among(self.decisions.walks.iter().map(|walk| &walk.record.conditions));
        let standing = |walk: &Walk| {
            let name = &self.seed_structures[walk.record.seed_structure as usize].name;
            let name = varied.name(name, &walk.record.conditions);
            let control = if walk.is_biased() { "" } else { " (control)" };
            let step = if walk.has_ended() { last } else { walk.record.progress.step };
            (walk.record.walk, format!("{name}{control}"), step)
        };
        self.decisions.walks.iter().map(standing).collect()
    }

    /// The walks that have ended: number, state and reason.
    pub fn ended_walks(&self) -> impl Iterator<Item = (WalkId, &str, &str)> {
        let walks = self.decisions.walks.iter().filter(|walk| walk.has_ended());
        walks.map(|Walk { record, .. }| (record.walk, record.state.as_str(), record.reason.as_str()))
    }

    /// Creates a walk for each seed structure without one: at the start of a campaign, with a new version of the potential, or
    /// when seed structures were added. Resumes walks that ended because of a limit that has been raised since, or for a
    /// version that was refused. No walk starts while a limit of the whole campaign is reached, or room is made for a new
    /// version. The commit is empty if nothing changes.
    pub fn start_walks(&mut self) -> Commit {
        let commit = self.decisions.start_walks(&self.seed_structures);
        self.update_ready(commit.walks.iter().map(|walk| walk.walk));
        commit
    }

    /// Ends the biased walks that no walker works on as superseded, and others when they report: a new version of the
    /// potential is there. Their control walks run to their end.
    pub fn supersede_walks(&mut self) -> Commit {
        self.decisions.settings.refit_at = Some(0);
        let commit = self.decisions.end_walks_by_limits(&self.assigned);
        self.update_ready(commit.walks.iter().map(|walk| walk.walk));
        commit
    }

    /// Enables raising the threshold of the collection rule while more than `limit` label jobs are unfinished (see
    /// [`Self::set_unfinished_jobs`]). Live mode only, since the length of the queue depends on timing.
    pub fn raise_threshold_above(&mut self, limit: u64) {
        self.decisions.backlog = Some(Backlog::new(limit));
    }

    /// Sets the number of unfinished label jobs, for all later decisions and assignments.
    pub fn set_unfinished_jobs(&mut self, unfinished: u64) {
        self.decisions.threshold_factor =
            self.decisions.backlog.map_or(1.0, |backlog| backlog.factor(unfinished));
    }

    /// Enables declining candidates whose labels complete with a smaller probability than this, once a model is known ([`Self::set_completion_model`]).
    /// Live mode only, since the model depends on when labels are made.
    pub fn decline_unlikely(&mut self, min_probability: f64) {
        self.decisions.completion = Some(CompletionRule { min_probability, source: None });
    }

    /// Sets the model by which completion is predicted, for all later decisions, if unlikely candidates are declined.
    pub fn set_completion_model(&mut self, coefficients: CompletionCoefficients) {
        if let Some(rule) = &mut self.decisions.completion {
            rule.source = Some(ProbabilitySource::Model(coefficients));
        }
    }

    /// Sets the paused walks, which get no assignments. In reproducible mode their round waits for them, and so do the
    /// other walks: decisions do not depend on who was paused when.
    pub fn set_paused(&mut self, walks: BTreeSet<WalkId>) {
        let before = std::mem::replace(&mut self.paused, walks);
        let changed: Vec<WalkId> = before.symmetric_difference(&self.paused).copied().collect();
        self.update_ready(changed);
    }

    /// Number of unfinished label jobs above which walkers wait: `limit`, or a larger number if the threshold is raised
    /// first.
    pub fn max_unfinished_jobs(&self, limit: u64) -> u64 {
        self.decisions.backlog.map_or(limit, Backlog::max_unfinished_jobs)
    }

    /// Takes the report on an assignment. The returned commit must be written before any later assignment is sent.
    /// Further reports may be taken before that, if their commits are written together with it or afterwards. Reports
    /// on an earlier assignment change nothing. A report on the current assignment counts even if it is not assigned as
    /// far as is known here: the walker was considered lost, or the orchestrator was restarted.
    pub fn report(&mut self, report: AssignmentReport) -> Result<Option<Commit>, SelectorError> {
        let regraded = self.decisions.regrader.regrade(report, &self.decisions.mixture);
        self.report_regraded(regraded)
    }

    /// Ends a walk whose current assignment cannot be completed, as if it had been reported.
    pub fn abandon_walk(&mut self, id: WalkId, reason: String) -> Result<Option<Commit>, SelectorError> {
        let Some(walk) = self.decisions.walks.get(id) else { return Ok(None) };
        let WalkRecord { assignments: number, checkpoint, progress, .. } = walk.record.clone();
        let (checkpoint, outcome) =
            (checkpoint.unwrap_or_default(), Outcome::Ended(WalkEnd::Diverged { reason }));
        let (start, trace, frames) = (None, Vec::new(), Vec::new());
        self.report(AssignmentReport {
            walk: id,
            assignment: number,
            start,
            outcome,
            checkpoint,
            progress,
            trace,
            frames,
        })
    }

    /// Regrades reports for [`Selector::report_regraded`], for example on other threads.
    pub fn regrader(&self) -> &Regrader {
        &self.decisions.regrader
    }

    /// Like [`Selector::report`], for a report whose candidate is already regraded. The result does not depend on when
    /// it was.
    pub fn report_regraded(&mut self, report: RegradedReport) -> Result<Option<Commit>, SelectorError> {
        let (id, number) = (report.walk, report.assignment);
        let mode = self.decisions.settings.mode;
        let in_round = match mode {
            CampaignMode::Live => true,
            CampaignMode::Reproducible => self.outstanding.contains(&id),
        };
        let is_current = |walk: &&Walk| in_round && walk.record.assignments == number && !walk.has_ended();
        if self.decisions.walks.get(id).filter(is_current).is_none() {
            return Ok(None);
        }
        self.assigned.remove(&id);
        if matches!(report.outcome, Outcome::Interrupted) {
            let walk = self.decisions.walk_mut(id);
            let commit = walk.interrupt(report);
            self.update_ready([id]);
            return Ok(Some(commit));
        }
        let reports = match mode {
            CampaignMode::Live => vec![report],
            CampaignMode::Reproducible => {
                self.outstanding.remove(&id);
                self.reports.insert(id, report);
                self.update_ready([id]);
                if !self.outstanding.is_empty() {
                    return Ok(None);
                }
                std::mem::take(&mut self.reports).into_values().collect()
            }
        };
        let commit = self.decisions.decide(reports, &self.assigned)?;
        self.update_ready(commit.walks.iter().map(|walk| walk.walk));
        Ok(Some(commit))
    }
}
