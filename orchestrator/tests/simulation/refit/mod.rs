//! Versions of the potential in a run: the real schedule. What is around it follows `runtime::version_loop` step by step: when a run
//! looks for refits, and what it does after its walks.

mod process;

use monitor::refit_schedule::{AfterWalks, BesideWalks, RefitSchedule};
use orchestrator::selector::{PotentialVersion, SelectorSettings};
use orchestrator::supervisor::Supervisor;
use store::StoreError;

use super::event::{Event, Exit};
use super::fault::Time;
use super::planted::PlantedBug;
use super::world::{WALL_CLOCK, World};

pub(super) use process::refused_version;

/// Time between two looks for refits and versions beside walks.
const CHECK_INTERVAL: Time = 2_000;

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
