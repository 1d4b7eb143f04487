//! The process of a refit, as a run sees it: the real supervisor. What is around it follows `runtime::refit_process` step by step.

use std::time::Duration;

use monitor::refit_progress::{LABEL_SET, LabelSplit};
use orchestrator::supervisor::{ChildState, Limits, Supervisor, SupervisorAction};
use serde_json::json;
use store::{StoreError, VersionRecord, VersionState};

use super::super::event::{Event, Exit};
use super::super::fault::{ClientKind, Time};
use super::super::world::World;
use super::{RefitEvent, Stage};

/// A refit that cannot go on is tried again after this time.
const RETRY_INTERVAL: Time = 20_000;
/// A refit is never considered hung.
const NO_TIMEOUT: Duration = Duration::from_secs(1 << 32);

impl World {
    pub(super) fn start_refit(&mut self, session: u64) {
        let max_attempts = self.scenario.refits.as_ref().expect("a campaign with refits").max_attempts;
        let limits =
            Limits { heartbeat_timeout: NO_TIMEOUT, max_restarts: max_attempts - 1, ..Limits::default() };
        self.tell(format!("run {session} starts a refit"));
        self.refits_of(session).expect("as above").supervisor = Some(Supervisor::new(1, limits));
        self.drive_refit(session);
    }

    /// A run that is asked to stop ends the refit after its walks.
    pub(in super::super) fn stop_refit_after_walks(&mut self, session: u64) {
        if self.refits_of(session).is_some_and(|refits| refits.stage == Stage::Refit) {
            self.stop_refit(session);
        }
    }

    /// Asks the refit of a run to end, if there is one. What follows, follows then.
    pub(super) fn stop_refit(&mut self, session: u64) {
        let elapsed = self.elapsed();
        let refits = self.refits_of(session).expect("a campaign with refits");
        refits.stage = Stage::Stops;
        match &mut refits.supervisor {
            None => self.refit_is_over(session),
            Some(supervisor) => {
                let actions = supervisor.stop(elapsed);
                self.act_on_refitter(session, actions);
                self.drive_refit(session);
            }
        }
    }

    /// Does what is due of the refit of a run.
    pub(super) fn drive_refit(&mut self, session: u64) {
        let elapsed = self.elapsed();
        let Some(supervisor) = self.refits_of(session).and_then(|refits| refits.supervisor.as_mut()) else {
            return;
        };
        let actions = supervisor.due_actions(elapsed);
        let (is_over, deadline) = (supervisor.is_over(), supervisor.next_deadline());
        self.act_on_refitter(session, actions);
        if is_over {
            return self.refit_ends(session);
        }
        if let Some(deadline) = deadline.filter(|deadline| *deadline < NO_TIMEOUT) {
            let due = (deadline.as_nanos().div_ceil(1_000_000) as Time).max(self.now + 1);
            self.at(due, Event::Refit(RefitEvent::Supervises(session)));
        }
    }

    fn act_on_refitter(&mut self, session: u64, actions: Vec<SupervisorAction>) {
        for action in actions {
            match action {
                SupervisorAction::Start { .. } => {
                    let version = self.refits_of(session).expect("its refit").version;
                    self.new_refitter(session, version);
                }
                SupervisorAction::Terminate { .. } => self.terminate_refitter(session),
                SupervisorAction::Kill { .. } => {
                    let running = self.refitter_of(session);
                    running.into_iter().for_each(|id| self.refitter_exits(id, Exit::Killed));
                }
            }
        }
    }

    pub(super) fn refitter_gone(&mut self, session: u64, exit: Exit) {
        if !self.is_active(session, || Event::Refit(RefitEvent::RefitterGone(session, exit))) {
            return;
        }
        let elapsed = self.elapsed();
        let refits = self.refits_of(session).expect("a campaign with refits");
        if let Some(supervisor) = &mut refits.supervisor {
            supervisor.ended(0, exit.reason(), elapsed);
        }
        // A database that is busy for a moment has the record a little longer.
        let _ = self.store.read(self.now, async |store| store.remove_dead_refits().await);
        self.drive_refit(session);
    }

    /// No process of a refit runs, and none will be started.
    fn refit_ends(&mut self, session: u64) {
        let (now, elapsed, is_live) = (self.now, self.elapsed(), self.has_live_refits());
        let refits = self.refits_of(session).expect("its refit");
        let supervisor = refits.supervisor.take().expect("its refit");
        let status = supervisor.status(elapsed).next().expect("one process");
        let is_reported = (status.state == ChildState::Failed)
            .then(|| status.last_failure.is_some_and(|reason| reason.is_reported()));
        match (refits.stage, is_reported) {
            (Stage::Walks, None) => {}
            (Stage::Refit | Stage::Stops, None) => self.refit_is_over(session),
            (Stage::Walks, Some(true)) => refits.wait_until = now + RETRY_INTERVAL,
            (stage @ (Stage::Walks | Stage::Refit), Some(false)) if is_live => match self.refuse(session) {
                Err(error) => self.run_ends(session, &error.to_string()),
                Ok(()) if stage == Stage::Refit => self.refit_is_over(session),
                Ok(()) => {}
            },
            (_, Some(_)) => self.run_ends(session, "the refit failed"),
        }
    }

    /// Records that no version comes of a refit that crashes again and again.
    fn refuse(&mut self, session: u64) -> Result<(), StoreError> {
        let (now, wall) = (self.now, self.wall_clock());
        let parent = self.refits_of(session).expect("a campaign with refits").version;
        let (versions, structures, last_decision, labels) = self.store.read(now, async |store| {
            let (labels, _) = LabelSplit::default().label_set(store).await?.unwrap_or_default();
            let last_decision = store.newest_mixture().await?.decision;
            Ok((store.versions().await?, store.accepted_structures().await?, last_decision, labels))
        })?;
        let number = VersionRecord::next_number(&versions);
        let kept = self.refits.directories.get(&number).and_then(|directory| directory.labels.clone());
        let record = VersionRecord {
            reason: "the refit failed".to_owned(),
            structures,
            last_decision,
            figures: json!({ LABEL_SET: kept.map_or(labels, |(labels, _)| labels) }),
            ..refused_version(number, parent, wall)
        };
        self.tell(format!("version {number} is refused: its refit crashed"));
        self.store.write(now, ClientKind::Orchestrator, "a version is refused", async |store| {
            store.add_version(&record, None).await.map(|()| true)
        })?;
        Ok(())
    }
}

/// The record of a refused attempt.
pub(in super::super) fn refused_version(number: u32, parent: u32, time: i64) -> VersionRecord {
    VersionRecord {
        number,
        parent,
        state: VersionState::Refused,
        reason: String::new(),
        method: "native".to_owned(),
        structures: 0,
        last_decision: 0,
        labels: 0,
        model_hash: String::new(),
        mixture_hash: String::new(),
        figures: serde_json::Value::Null,
        seconds: 0.0,
        core_hours: 0.0,
        time,
    }
}
