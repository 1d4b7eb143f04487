//! Decisions on the reports of a round, in the order of walks.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use atoms::CloseContact;
use calm::grade::maximum;
use calm::rules::CovarianceUpdateKind;
use calm::{UpdateOutcome, UpdateSettings};
use serde_json::json;
use store::records::{CandidateRecord, Commit, ComponentRecord, Decision, Fate, TRAINING_FRAMES};
use wire::messages::{DeclineReason, Outcome, Verdict, WalkEnd};
use wire::{CandidateBlock, ContentHash, WalkId};

use super::completion::CompletionCheck;
use super::decision_state::{ADDITIVE, DecisionState};
use super::error::SelectorError;
use super::forgetting::ForgettingState;
use super::regrade::{RegradedCandidate, RegradedReport};
use super::settings::{OnForgetting, UpdateProtocol};

/// Priority of label jobs of biased candidates; control frames come after them.
const BIASED_PRIORITY: i32 = 10;
const CONTROL_PRIORITY: i32 = 0;

/// Kind of the decision on a candidate that cannot be graded, and on a control frame with atoms too close.
pub(super) const LEFT_OUT: &str = "left_out";
/// Kind of the decision that makes updates additive.
pub(super) const FORGETTING: &str = "forgetting";

impl DecisionState {
    /// Decides on the reports of a round, in order. `assigned` contains the walks that walkers work on.
    pub fn decide(
        &mut self,
        reports: Vec<RegradedReport>,
        assigned: &BTreeMap<WalkId, u32>,
    ) -> Result<Commit, SelectorError> {
        let mut commit = Commit::default();
        let mut touched = BTreeSet::new();
        for mut report in reports {
            let id = report.walk;
            touched.insert(id);
            let (steps, accepted) = (self.apply_report(&mut report, &mut commit), self.accepted);
            commit.traces.push((id, report.trace));
            match report.outcome {
                Outcome::Candidate(regraded) => {
                    let decided = regraded.and_then(|regraded| self.take(id, regraded, &mut commit));
                    match decided {
                        Err(error) if error.is_of_candidate() => {
                            self.leave_out(id, report.progress.step, &error.to_string(), &mut commit);
                        }
                        other => other?,
                    }
                }
                Outcome::Ended(end) => self.end_walk(id, &end, &mut commit),
                // A control walk that missed its last frame will not provide it in a later assignment.
                Outcome::StepsDone if self.walks[id].missed_its_frames() => {
                    self.end_walk(id, &WalkEnd::Completed, &mut commit);
                }
                Outcome::StepsDone | Outcome::Interrupted => {}
            }
            self.count_steps(id, steps, self.accepted > accepted);
        }
        self.finish_commit(assigned, touched, &mut commit);
        Ok(commit)
    }

    /// Ends what a limit ends, without any report.
    pub fn end_walks_by_limits(&mut self, assigned: &BTreeMap<WalkId, u32>) -> Commit {
        let mut commit = Commit::default();
        self.finish_commit(assigned, BTreeSet::new(), &mut commit);
        commit
    }

    /// Adds to a commit what follows from its decisions: ends by limits, control walks, and the records of all `touched` walks.
    fn finish_commit(
        &mut self,
        assigned: &BTreeMap<WalkId, u32>,
        mut touched: BTreeSet<WalkId>,
        commit: &mut Commit,
    ) {
        touched.extend(self.end_by_limits(assigned, commit));
        touched.extend(self.start_controls(commit));
        commit.walks = touched.iter().map(|id| self.walks[*id].to_record()).collect();
        self.add_values(commit);
    }

    /// Updates the walk from the report, and logs rollbacks. Returns the number of steps of the assignment if the walk is
    /// biased; 0 if it rolled back behind its start.
    fn apply_report(&mut self, report: &mut RegradedReport, commit: &mut Commit) -> u64 {
        let steps_per_assignment = self.settings.steps_per_assignment;
        let walk = self.walks.count_report(report.walk);
        walk.record_assignment(report, commit);
        let steps = match walk.is_biased() {
            true => report.progress.step.saturating_sub(walk.counted_step(steps_per_assignment)),
            false => 0,
        };
        let returned = report.progress.segment > walk.state.segment;
        walk.state.segment = walk.state.segment.max(report.progress.segment);
        let made_no_step = match report.outcome {
            Outcome::Ended(WalkEnd::InvalidStart { .. }) => true,
            // It cannot go on from its checkpoint, which may not even be readable.
            Outcome::Ended(WalkEnd::Diverged { .. }) => {
                walk.record.checkpoint.as_ref() == Some(&report.checkpoint)
            }
            _ => false,
        };
        if !made_no_step {
            walk.record.checkpoint = Some(report.checkpoint.clone());
            walk.record.progress = report.progress.clone();
        }
        walk.state.verdict = None;
        walk.set_last_step(steps_per_assignment);
        if returned {
            let progress = &report.progress;
            let (from, to) = progress.last_rollback.unzip();
            let detail = json!({
                "segment": progress.segment, "from": from, "to": to, "tau": progress.tau, "rollbacks": progress.rollbacks,
            });
            commit.decisions.push(self.decision("segment", report.walk, detail));
        }
        steps
    }

    /// Counts the steps of biased walks since the last accepted structure, of the groups that count. Structures of assignments that
    /// were under way when the limit was reached are accepted, but the limit stays reached.
    fn count_steps(&mut self, id: WalkId, steps: u64, found: bool) {
        let (groups, group) = (&self.settings.stop_groups, &self.walks[id].record.conditions.group);
        if !groups.is_empty() && !groups.contains(group) {
            return;
        }
        if !found {
            self.steps_without_structure += steps;
        } else if !self.finds_nothing_new() {
            self.steps_without_structure = 0;
        }
    }

    /// Decides on what a walk offers: a candidate, or a requested frame of a control walk.
    fn take(
        &mut self,
        id: WalkId,
        regraded: RegradedCandidate,
        commit: &mut Commit,
    ) -> Result<(), SelectorError> {
        match self.walks[id].is_biased() {
            true => self.decide_candidate(id, regraded, commit),
            false => self.keep_control_frame(id, regraded, commit),
        }
    }

    /// Decides on a candidate of a biased walk, and ends the walk if it has reached its limit.
    pub fn decide_candidate(
        &mut self,
        id: WalkId,
        regraded: RegradedCandidate,
        commit: &mut Commit,
    ) -> Result<(), SelectorError> {
        let graded = regraded.with_mixture(&self.mixture)?;
        let view = graded.block.view();
        let candidate = view.id();
        self.staleness.add(self.mixture.version().saturating_sub(view.mixture_version()));
        let mut detail = json!({
            "walker": grade_summary(view.gamma, view.mixture_version()),
            "selector": grade_summary(&graded.selector.gamma, self.mixture.version()),
            "original": grade_summary(&graded.original.gamma, 0),
        });
        if self.threshold_factor > 1.0 {
            detail["raised_by"] = json!(self.threshold_factor);
            detail["threshold"] =
                json!(self.settings.collection.with_threshold_factor(self.threshold_factor).threshold());
        }
        let completion = self.completion.as_ref().and_then(|rule| rule.check(&graded));
        if let Some(check) = completion {
            detail["completion"] = check.in_decision();
        }
        let mut alarm = false;
        let reason = self.reason_to_decline(id, candidate.content, &graded);
        let unlikely =
            completion.filter(CompletionCheck::declines).map(|_| DeclineReason::UnlikelyToComplete);
        let (fate, verdict) = match reason.or(unlikely) {
            Some(reason) => {
                detail["reason"] = json!(reason.name());
                (Fate::Declined(reason), Verdict::Declined(reason))
            }
            None => {
                alarm = self.update(&graded, commit, &mut detail)?;
                self.accept(id, candidate.content, candidate.step);
                (Fate::Accepted, Verdict::Accepted)
            }
        };
        let keep_features = self.should_keep_features(fate, &graded.block);
        self.record_decision(id, graded, fate, keep_features, detail, commit);
        self.act_on_alarm(id, alarm, commit);
        self.walk_mut(id).state.verdict = Some(verdict);
        if self.has_collected_enough(&self.walks[id]) {
            self.end_walk(id, &WalkEnd::QuotaReached, commit);
        }
        Ok(())
    }

    /// Records a requested frame of a control walk: it is labelled like a candidate, but does not update the mixture.
    /// The limits on distances hold for it as for candidates of biased walks, so that both sides of a comparison
    /// consist of structures that pass the same guard.
    pub fn keep_control_frame(
        &mut self,
        id: WalkId,
        regraded: RegradedCandidate,
        commit: &mut Commit,
    ) -> Result<(), SelectorError> {
        let graded = regraded.with_mixture(&self.mixture)?;
        let candidate = graded.block.view().id();
        if let Some(contact) = self.too_close(id, &graded) {
            return Err(SelectorError::TooClose { candidate, contact });
        }
        let detail = json!({ "original": grade_summary(&graded.original.gamma, 0) });
        self.record_decision(id, graded, Fate::Accepted, true, detail, commit);
        let walk = self.walk_mut(id);
        walk.record.accepted += 1;
        walk.state.wanted.retain(|wanted| *wanted > candidate.step);
        if walk.state.wanted.is_empty() {
            self.end_walk(id, &WalkEnd::QuotaReached, commit);
        }
        Ok(())
    }

    /// The atoms of a structure that are closer than the limits of its walk.
    fn too_close(&self, id: WalkId, graded: &RegradedCandidate) -> Option<CloseContact> {
        let seed_structure = self.walks[id].record.seed_structure as usize;
        self.min_distances[seed_structure].violation(&graded.bonds.shortest)
    }

    /// Declines a candidate that cannot be graded, or that the mixture cannot be updated with (training atoms must still
    /// have a grade), or a control frame with atoms too close. Its walk continues: each later frame of a control walk is
    /// still matched by step. The log has the reason; the candidate is not stored.
    pub fn leave_out(&mut self, id: WalkId, step: u64, error: &str, commit: &mut Commit) {
        self.left_out += 1;
        commit.decisions.push(self.decision(LEFT_OUT, id, json!({ "step": step, "error": error })));
        let walk = self.walk_mut(id);
        walk.state.verdict = Some(Verdict::Declined(DeclineReason::LeftOut));
        if !walk.is_biased() {
            walk.state.wanted.retain(|wanted| *wanted > step);
            if walk.state.wanted.is_empty() {
                self.end_walk(id, &WalkEnd::QuotaReached, commit);
            }
        }
    }

    /// Adds a decision with its candidate to the commit.
    fn record_decision(
        &self,
        id: WalkId,
        graded: RegradedCandidate,
        fate: Fate,
        keep_features: bool,
        detail: serde_json::Value,
        commit: &mut Commit,
    ) {
        let RegradedCandidate { block, selector, original, .. } = graded;
        let (walk, candidate) = (&self.walks[id], Some(block.view().id()));
        let (kind, priority) = match fate {
            _ if !walk.is_biased() => ("control", CONTROL_PRIORITY),
            Fate::Accepted => ("accepted", BIASED_PRIORITY),
            Fate::Declined(_) => ("declined", BIASED_PRIORITY),
        };
        let seed_structure = walk.record.seed_structure;
        commit.decisions.push(Decision { candidate, ..self.decision(kind, id, detail) });
        commit.candidates.push(CandidateRecord {
            block,
            fate,
            seed_structure,
            selector,
            original,
            keep_features,
            priority,
        });
    }

    /// The first applicable reason to decline, in the order of the checks below. Only what none of them applies to can be unlikely to
    /// complete.
    fn reason_to_decline(
        &self,
        id: WalkId,
        content: ContentHash,
        graded: &RegradedCandidate,
    ) -> Option<DeclineReason> {
        let walk = &self.walks[id];
        if self.too_close(id, graded).is_some() {
            Some(DeclineReason::TooClose)
        } else if self.known.contains(&content) {
            Some(DeclineReason::Duplicate)
        } else if self.has_collected_enough(walk) || self.is_budget_exhausted() {
            Some(DeclineReason::Budget)
        } else if !self.settings.collection.is_met(&graded.selector.gamma) {
            Some(DeclineReason::Covered)
        } else if !self
            .settings
            .collection
            .with_threshold_factor(self.threshold_factor)
            .is_met(&graded.selector.gamma)
        {
            Some(DeclineReason::Backlog)
        } else {
            // The walker has tested the grade under its own mixture, which sinks with updates.
            let is_too_large = |bound| maximum(&graded.original.gamma) > bound;
            self.settings.max_grade.is_some_and(is_too_large).then_some(DeclineReason::GradeTooLarge)
        }
    }

    /// Updates the mixture to cover the candidate, and adds the new version to the commit. Returns whether the mixture
    /// has forgotten too much. An error changes nothing.
    fn update(
        &mut self,
        graded: &RegradedCandidate,
        commit: &mut Commit,
        detail: &mut serde_json::Value,
    ) -> Result<bool, SelectorError> {
        if self.settings.update == UpdateProtocol::Never {
            return Ok(false);
        }
        let view = graded.block.view();
        let elements = &graded.bonds.elements;
        let settings = update_settings(&self.settings.search, self.switched_to_additive);
        let outcome = calm::update(&self.mixture, elements, view.features, &settings)
            .map_err(|source| SelectorError::Update { candidate: view.id(), source })?;
        let updated = Arc::new(self.mixture.with_changes(&outcome.changed)?);
        let changed = outcome.changed.iter().map(|change| (change.element, change.slot)).collect();
        self.forgetting.update(&self.regrader.original, &updated, &changed)?;
        self.mixture = updated;
        for change in &outcome.changed {
            let (element, slot) = (change.element as u32, change.slot as u32);
            commit.components.push(ComponentRecord { element, slot, bytes: change.component.to_bytes() });
        }
        detail["update"] = update_summary(&outcome);
        let state = self.forgetting_state();
        if let Some(training) = state.training {
            detail["training_frames"] = json!(training);
        }
        detail["forgetting"] = state.in_decision();
        detail["forgetting_alarm"] = json!(state.is_alarming());
        commit.values.push((TRAINING_FRAMES.to_owned(), state.to_json().to_string()));
        Ok(state.is_alarming())
    }

    /// What the live mixture has forgotten.
    pub fn forgetting_state(&self) -> ForgettingState {
        self.forgetting.state(&self.regrader.original, self.settings.forgetting_alarm)
    }

    /// Makes updates additive after an update that raised the alarm, if the campaign asks for it.
    fn act_on_alarm(&mut self, id: WalkId, alarm: bool, commit: &mut Commit) {
        let is_convex = self.settings.search.covariance_update == CovarianceUpdateKind::Convex;
        let switches = self.settings.on_forgetting == OnForgetting::Additive && is_convex;
        if alarm && switches && !self.switched_to_additive {
            self.switched_to_additive = true;
            commit.decisions.push(self.decision(FORGETTING, id, json!({ "covariance_update": "additive" })));
        }
    }

    fn accept(&mut self, id: WalkId, content: ContentHash, step: u64) {
        self.accepted += 1;
        self.known.insert(content);
        let walk = self.walk_mut(id);
        walk.record.accepted += 1;
        walk.state.accepted_steps.push(step);
        let seed_structure = walk.record.seed_structure;
        let of_seed_structure = self.accepted_by_seed_structure.entry(seed_structure).or_default();
        *of_seed_structure += 1;
        if self.settings.max_per_seed_structure.is_some_and(|most| *of_seed_structure >= most) {
            self.full_seed_structures.insert(seed_structure);
        }
    }

    /// Features of accepted candidates are always stored, those of declined candidates within a limit.
    fn should_keep_features(&mut self, fate: Fate, block: &CandidateBlock) -> bool {
        if fate == Fate::Accepted {
            return true;
        }
        let bytes = size_of_val(block.view().features) as u64;
        let keeps = self.declined_feature_bytes + bytes <= self.settings.declined_feature_bytes;
        if keeps {
            self.declined_feature_bytes += bytes;
        }
        keeps
    }

    pub fn end_walk(&mut self, id: WalkId, end: &WalkEnd, commit: &mut Commit) {
        self.end_walk_as(id, end.name(), describe_end(end), commit);
    }

    /// Ends a walk with this final state, and the reason as text.
    pub fn end_walk_as(&mut self, id: WalkId, end: &str, reason: String, commit: &mut Commit) {
        let walk = self.walks.end(id, end, reason);
        let detail = json!({
            "end": end, "reason": walk.record.reason, "step": walk.record.progress.step,
            "accepted": walk.record.accepted,
        });
        let seed_structure = walk.is_biased().then_some(walk.record.seed_structure);
        if seed_structure.is_some_and(|seed| self.restarts_mixture_after(seed)) {
            let next_version = self.mixture.version() + 1;
            self.mixture = Arc::new(self.regrader.original.at_version(next_version));
            commit.components.clear();
            commit.restart_mixture = true;
            self.forgetting.restart();
            let state = self.forgetting_state();
            commit.values.push((TRAINING_FRAMES.to_owned(), state.to_json().to_string()));
        }
        commit.decisions.push(self.decision("ended", id, detail));
    }

    /// Whether the biased walk after one of this seed structure starts from the original mixture.
    fn restarts_mixture_after(&self, seed_structure: u32) -> bool {
        match self.settings.update {
            UpdateProtocol::Cumulative | UpdateProtocol::Never => false,
            UpdateProtocol::PerSeedStructure => {
                let next = self.walks.unfinished(true).next();
                next.map(|id| self.walks[id].record.seed_structure) != Some(seed_structure)
            }
            UpdateProtocol::PerWalk => true,
        }
    }

    /// Ends the unassigned biased walks if all have to end, or those whose seed structure has its maximum number of structures.
    fn end_by_limits(&mut self, assigned: &BTreeMap<WalkId, u32>, commit: &mut Commit) -> BTreeSet<WalkId> {
        let is_idle = |id: &WalkId| !assigned.contains_key(id);
        let (end, over): (_, BTreeSet<_>) = match self.end_of_all_walks() {
            Some(end) => (end, self.walks.unfinished(true).filter(is_idle).collect()),
            None => {
                let of_full_seed_structures = self
                    .full_seed_structures
                    .iter()
                    .flat_map(|seed| self.walks.unfinished_of_seed_structure(*seed));
                (WalkEnd::QuotaReached, of_full_seed_structures.filter(is_idle).collect())
            }
        };
        over.iter().for_each(|id| self.end_walk(*id, &end, commit));
        self.full_seed_structures
            .retain(|seed| self.walks.unfinished_of_seed_structure(*seed).next().is_some());
        over
    }

    /// Creates the control walks of biased walks of the version in force that have ended. Returns all changed walks.
    fn start_controls(&mut self, commit: &mut Commit) -> Vec<WalkId> {
        let mut touched = Vec::new();
        if !self.settings.control {
            return touched;
        }
        for id in self.walks.without_control() {
            if self.walks[id].record.conditions.version != self.version {
                continue;
            }
            let control_id = self.next_walk_id();
            commit.decisions.push(self.start_control(control_id, id));
            touched.extend([id, control_id]);
        }
        touched
    }

    /// Creates the control walk of the biased walk `of`, which must exist.
    pub fn start_control(&mut self, id: WalkId, of: WalkId) -> Decision {
        let steps_per_assignment = self.settings.steps_per_assignment;
        let control = self.walks.insert_control(id, of, steps_per_assignment);
        let detail = json!({ "control_of": of, "wanted": control.state.wanted });
        self.decision("begun", id, detail)
    }
}

/// Why a walk ended, as text, if the name of the end is not sufficient.
fn describe_end(end: &WalkEnd) -> String {
    match end {
        WalkEnd::Completed
        | WalkEnd::QuotaReached
        | WalkEnd::Budget
        | WalkEnd::Superseded
        | WalkEnd::NothingNew
        | WalkEnd::VolumeBoundary => String::new(),
        WalkEnd::Trapped { guard } => format!("rejected by the {guard} guard again and again"),
        WalkEnd::Diverged { reason } | WalkEnd::InvalidStart { reason } => reason.clone(),
    }
}

fn grade_summary(gamma: &[f64], mixture_version: u64) -> serde_json::Value {
    let above = gamma.iter().filter(|gamma| **gamma > 1.0).count();
    json!({ "gamma_max": maximum(gamma), "atoms_above_1": above, "mixture_version": mixture_version })
}

/// How a campaign updates its mixture now: as `configured` when it began, or additively since it forgot too much. `values` are those
/// of its store ([`store::Store::values`]).
pub fn update_settings_in_force(configured: &UpdateSettings, values: &[(String, String)]) -> UpdateSettings {
    update_settings(configured, values.iter().any(|(name, value)| name == ADDITIVE && value != "0"))
}

/// How the mixture is updated, before or after updates became additive.
pub(super) fn update_settings(configured: &UpdateSettings, switched_to_additive: bool) -> UpdateSettings {
    let mut settings = configured.clone();
    if switched_to_additive {
        (settings.covariance_update, settings.alpha_values) = (CovarianceUpdateKind::Additive, None);
    }
    settings
}

/// What the decision log has of an update.
pub(super) fn update_summary(outcome: &UpdateOutcome) -> serde_json::Value {
    let places: Vec<_> = outcome.changed.iter().map(|change| (change.element, change.slot)).collect();
    json!({
        "alpha": outcome.alpha,
        "trials": outcome.trials,
        "ended_by": outcome.end,
        "inflations": outcome.inflations,
        "gamma_max_after": maximum(&outcome.gamma_after),
        "components": places,
    })
}

#[cfg(test)]
mod tests {
    use calm::UpdateRule;
    use calm::rules::MaximumGradeUpdate;

    use super::*;

    #[test]
    fn atoms_count_whose_grade_exceeds_one() {
        let summary = grade_summary(&[0.5, 1.0, 1.5, 2.0, 3.0], 7);
        assert_eq!(summary, json!({ "gamma_max": 3.0, "atoms_above_1": 3, "mixture_version": 7 }));
    }

    #[test]
    fn updates_are_additive_once_the_store_says_so() {
        let configured = UpdateSettings {
            covariance_update: CovarianceUpdateKind::Convex,
            alpha_values: None,
            stop: UpdateRule::MaximumGrade(MaximumGradeUpdate { target: 1.25.try_into().unwrap() }),
        };
        let kind = |name: &str, value: &str| {
            let values = [("round".to_owned(), "3".to_owned()), (name.to_owned(), value.to_owned())];
            update_settings_in_force(&configured, &values).covariance_update
        };
        assert_eq!(kind(ADDITIVE, "1"), CovarianceUpdateKind::Additive);
        for (name, value) in [(ADDITIVE, "0"), ("left_out", "1")] {
            assert_eq!(kind(name, value), CovarianceUpdateKind::Convex, "{name}");
        }
    }
}
