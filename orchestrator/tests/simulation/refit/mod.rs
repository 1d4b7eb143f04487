//! Refits of a run: the real schedule and the real supervisor. What is around them follows `runtime::version_loop` and
//! `runtime::refit_process` step by step: when a run looks for refits, and what it does after its walks.

use std::time::Duration;

use monitor::refit_progress::{LABEL_SET, LabelSplit};
use monitor::refit_schedule::{AfterWalks, BesideWalks, RefitSchedule};
use orchestrator::selector::{PotentialVersion, SelectorSettings};
use orchestrator::supervisor::{ChildState, Limits, Supervisor, SupervisorAction};
use serde_json::json;
use store::{StoreError, VersionRecord, VersionState};

use super::event::{Event, Exit};
use super::fault::{ClientKind, Time};
use super::planted::PlantedBug;
use super::world::{WALL_CLOCK, World};

/// Time between two looks for refits and versions beside walks.
const CHECK_INTERVAL: Time = 2_000;
/// A refit that cannot go on is tried again after this time.
const RETRY_INTERVAL: Time = 20_000;
/// A refit is never considered hung.
const NO_TIMEOUT: Duration = Duration::from_secs(1 << 32);

/// What happens to refits.
#[derive(Clone, Debug)]
pub enum RefitEvent {
    /// A run looks for refits and versions beside its walks.
    Check(u64),
    /// The supervisor of a run's refit has something to do.
    Supervises(u64),
    RefitterActs(u32),
    RefitterIsKilled(u32, Exit),
    /// A run learns that its refitter has ended.
    RefitterGone(u64, Exit),
}

/// The refits of a run with one version of the potential.
pub struct RunRefits {
    /// The version of its walks.
    version: u32,
    stage: Stage,
    /// While a refit runs.
    supervisor: Option<Supervisor>,
    /// When the next one may begin, after one that could not go on.
    wait_until: Time,
    superseded: bool,
    walks_end: bool,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// Walks run; in a live campaign, refits beside them.
    Walks,
    /// A refit after the walks.
    Refit,
    /// A refit was asked to end.
    Stops,
}

impl RunRefits {
    pub fn new(version: u32) -> Self {
        let (stage, supervisor) = (Stage::Walks, None);
        Self { version, stage, supervisor, wait_until: 0, superseded: false, walks_end: false }
    }

    /// Whether all walks have ended, and with them what served them.
    pub fn walks_are_over(&self) -> bool {
        self.stage != Stage::Walks
    }

    /// Whether walks have ended for those of a newer version.
    pub fn makes_room(&self) -> bool {
        self.superseded
    }
}

impl World {
    /// The version of the walks of a run.
    pub fn version_of(&self, session: u64) -> u32 {
        self.runs.get(&session).and_then(|run| run.refits.as_ref()).map_or(0, |refits| refits.version)
    }

    pub fn refit_event(&mut self, event: RefitEvent) {
        match event {
            RefitEvent::Check(session) => self.look_for_refits(session),
            RefitEvent::Supervises(session) => {
                if self.is_active(session, || Event::Refit(RefitEvent::Supervises(session))) {
                    self.drive_refit(session);
                }
            }
            RefitEvent::RefitterActs(id) => self.refitter_acts(id),
            RefitEvent::RefitterIsKilled(id, exit) => self.refitter_exits(id, exit),
            RefitEvent::RefitterGone(session, exit) => self.refitter_gone(session, exit),
        }
    }

    /// The schedule of the refits, from the store.
    pub(super) fn refit_schedule(&mut self) -> Result<RefitSchedule, StoreError> {
        let plan = self.scenario.refits.as_ref().expect("a campaign with refits");
        let (mut rules, timing) = (plan.rules(), plan.timing);
        if self.bug == Some(PlantedBug::VersionLimitForgotten) && self.store.generation > 1 {
            rules.max_versions = usize::MAX;
        }
        self.store.read(self.now, async |store| RefitSchedule::read(store, rules, timing).await)
    }

    /// The settings of the selector, with the version of the potential in force.
    pub(super) fn settings_in_force(&mut self) -> Result<SelectorSettings, StoreError> {
        let settings = self.scenario.settings.clone();
        if self.scenario.refits.is_none() {
            return Ok(settings);
        }
        let schedule = self.refit_schedule()?;
        let in_force = match self.bug {
            Some(PlantedBug::RefusedVersionTakenUp) => schedule.progress.versions.last(),
            _ => schedule.in_force(),
        };
        let version = in_force.map(PotentialVersion::from).unwrap_or_default();
        Ok(SelectorSettings { version, refit_at: schedule.walks_end_at(), ..settings })
    }

    fn refits_of(&mut self, session: u64) -> Option<&mut RunRefits> {
        self.runs.get_mut(&session)?.refits.as_mut()
    }

    fn has_live_refits(&self) -> bool {
        self.scenario.refits.as_ref().is_some_and(|plan| plan.timing.beside_walks)
    }

    /// Looks for refits and versions beside the walks of a live campaign, from now on.
    pub(super) fn watch_refits(&mut self, session: u64) {
        if self.has_live_refits() {
            self.after(CHECK_INTERVAL, Event::Refit(RefitEvent::Check(session)));
        }
    }

    fn look_for_refits(&mut self, session: u64) {
        if !self.is_active(session, || Event::Refit(RefitEvent::Check(session))) {
            return;
        }
        let now = self.now;
        let refits = self.refits_of(session).expect("a campaign with refits");
        if refits.stage != Stage::Walks {
            return;
        }
        let (version, may_start) = (refits.version, refits.supervisor.is_none() && refits.wait_until <= now);
        self.watch_refits(session);
        let Ok(schedule) = self.refit_schedule() else { return };
        match schedule.beside_walks(version, WALL_CLOCK, self.wall_clock()) {
            BesideWalks::Superseded => self.walks_make_room(session, true),
            BesideWalks::WalksEnd => self.walks_make_room(session, false),
            BesideWalks::RefitDue if may_start => {
                let another = self.store.read(now, async |store| store.is_refit_running().await);
                if another.is_ok_and(|another| !another) {
                    self.start_refit(session);
                }
            }
            BesideWalks::RefitDue | BesideWalks::GoOn => {}
        }
    }

    /// Ends the biased walks of a run: for those of a newer version, or because no walk starts with that.
    fn walks_make_room(&mut self, session: u64, for_version: bool) {
        if for_version && self.bug == Some(PlantedBug::OldWalksContinue) {
            return self.begin_beside(session);
        }
        let run = self.runs.get_mut(&session).expect("it looks for versions");
        let refits = run.refits.as_mut().expect("a campaign with refits");
        if run.finished {
            return;
        }
        refits.superseded |= for_version;
        if !std::mem::replace(&mut refits.walks_end, true) {
            run.core.supersede_walks();
            self.tell(format!("the walks of run {session} make room"));
            self.pump(session);
        }
    }

    /// The planted bug: walks of the newer version, while those of the version before go on.
    fn begin_beside(&mut self, session: u64) {
        if self.runs.keys().next_back() != Some(&session) {
            return;
        }
        let Ok(restored) = self.restore_selector() else { return };
        let run = self.runs.get_mut(&session).expect("it looks for versions");
        let process = (run.record.clone(), run.lock.take());
        let next = self.next_session;
        self.next_session += 1;
        self.begin_walks(next, process, restored);
    }

    /// The walks of a run have ended, with all its processes: what comes then?
    pub(super) fn walks_have_ended(&mut self, session: u64) {
        let run = self.runs.get_mut(&session).expect("it has walks");
        let is_stopping = run.stopping.is_cancelled();
        let refits = run.refits.as_mut().expect("a campaign with refits");
        if refits.stage != Stage::Walks {
            return;
        }
        let (version, is_running) = (refits.version, refits.supervisor.is_some());
        if is_stopping {
            return self.stop_refit(session);
        }
        let schedule = match self.refit_schedule() {
            Ok(schedule) => schedule,
            Err(error) => return self.run_ends(session, &error.to_string()),
        };
        match schedule.after_walks(version, is_running) {
            AfterWalks::NewerVersion => self.stop_refit(session),
            AfterWalks::Refit if self.bug == Some(PlantedBug::RefitAbandoned) => {
                self.finish_run(session, true)
            }
            AfterWalks::Refit => {
                self.refits_of(session).expect("as above").stage = Stage::Refit;
                if !is_running {
                    self.start_refit(session);
                }
            }
            AfterWalks::End => self.finish_run(session, true),
        }
    }

    fn start_refit(&mut self, session: u64) {
        let max_attempts = self.scenario.refits.as_ref().expect("a campaign with refits").max_attempts;
        let limits =
            Limits { heartbeat_timeout: NO_TIMEOUT, max_restarts: max_attempts - 1, ..Limits::default() };
        self.tell(format!("run {session} starts a refit"));
        self.refits_of(session).expect("as above").supervisor = Some(Supervisor::new(1, limits));
        self.drive_refit(session);
    }

    /// A run that is asked to stop ends the refit after its walks.
    pub(super) fn stop_refit_after_walks(&mut self, session: u64) {
        if self.refits_of(session).is_some_and(|refits| refits.stage == Stage::Refit) {
            self.stop_refit(session);
        }
    }

    /// Asks the refit of a run to end, if there is one. What follows, follows then.
    fn stop_refit(&mut self, session: u64) {
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
    fn drive_refit(&mut self, session: u64) {
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

    fn refitter_gone(&mut self, session: u64, exit: Exit) {
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

    /// After a refit, or without one: the walks of the version in force, unless the run was asked to stop.
    fn refit_is_over(&mut self, session: u64) {
        if self.runs[&session].stopping.is_cancelled() {
            return self.finish_run(session, false);
        }
        if self.store.is_replaced(session) {
            return self.run_ends(session, "it has lost its lock");
        }
        let (selector, version) = match self.restore_selector() {
            Ok(restored) => restored,
            Err(error) => return self.run_ends(session, &error.to_string()),
        };
        if selector.is_done() {
            match self.is_anything_left() {
                Ok(true) => {}
                Ok(false) => return self.finish_run(session, true),
                Err(error) => return self.run_ends(session, &error.to_string()),
            }
        }
        let run = self.runs.remove(&session).expect("it goes on");
        let next = self.next_session;
        self.next_session += 1;
        self.tell(format!("run {session} goes on as {next}, with version {version}"));
        self.begin_walks(next, (run.record, run.lock), (selector, version));
    }

    /// Whether a campaign whose walks have all ended has labels to wait for, or a version to train.
    fn is_anything_left(&mut self) -> Result<bool, StoreError> {
        let wall = self.wall_clock();
        let is_refit_left = self.refit_schedule()?.progress.is_refit_left();
        let pending = self.store.read(self.now, async |store| store.has_pending_labels(wall).await);
        Ok(is_refit_left || pending?)
    }
}

/// The record of a refused attempt.
pub(super) fn refused_version(number: u32, parent: u32, time: i64) -> VersionRecord {
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
