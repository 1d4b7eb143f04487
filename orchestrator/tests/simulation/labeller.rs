//! Labellers: a stand-in that follows the rules of `workers::labeller` step by step, on the real label queue.

use dft::FailureClass;
use monitor::end_reason::is_refit_due;
use store::records::{Label, Lease};
use store::{CalculationRecord, CompleteOutcome, FailOutcome, LeaseStatus, ProcessRecord, StoreError};
use wire::ContentHash;
use workers::labeller::decisions::{attempt_limit, counts_as_attempt};

use super::calculation::{CalculationResult, CalculationState};
use super::fault::{ClientKind, Time};
use super::planted::PlantedBug;
use super::world::{Event, Exit, World};
use crate::common::ATOMS;

/// The protocol of the labels.
pub const PROTOCOL: ContentHash = ContentHash([7; 32]);
/// Attempts before a label counts as failed.
pub const ATTEMPTS: u32 = 3;
/// Duration of a lease, s; it is renewed every third of it.
const LEASE: u32 = 30;
const RENEWAL_INTERVAL: Time = LEASE as Time * 1000 / 3;
const HEARTBEAT_INTERVAL: Time = 15_000;
const POLL_INTERVAL: Time = 6_000;
/// Time between two tries of a write while the database is busy or the disk full.
const RETRY_INTERVAL: Time = 1_000;
/// A replaced labeller may begin no label so long after its successor started.
const REPLACED_AFTER: Time = 3 * HEARTBEAT_INTERVAL;

/// A process of a labeller.
pub struct Labeller {
    pub number: u32,
    pub record: ProcessRecord,
    pub stopped_until: Time,
    started: Time,
    phase: Phase,
    /// What it was told to do last; earlier events mean nothing.
    token: u64,
    /// Asked to stop.
    stop: bool,
    no_more_jobs: bool,
    is_registered: bool,
}

#[derive(Clone)]
enum Phase {
    /// Registers itself.
    Begins,
    /// Polls the queue.
    Idle,
    /// Records the calculation that it will start, or has found.
    Records { lease: Box<Lease>, calculation: String, is_new: bool },
    /// Waits for a calculation, or finds or prepares it.
    Works { lease: Box<Lease>, calculation: Option<String>, held: bool },
    /// Ends a calculation that is no longer needed.
    Stops,
    /// Delivers the result of a calculation that has ended.
    Delivers { lease: Box<Lease>, result: CalculationResult, calculation: Option<String> },
    /// Removes the directory of a calculation whose result is delivered.
    Removes { calculation: String },
    /// Gives back what it holds, and leaves its calculation to the next labeller.
    Releases,
    /// Ends in order.
    Leaves,
}

impl World {
    /// The labeller with this number that started last.
    pub fn newest_labeller(&self, number: u32) -> Option<u32> {
        self.labellers.iter().filter(|(_, labeller)| labeller.number == number).map(|(id, _)| *id).next_back()
    }

    /// Starts a process of a labeller.
    pub fn new_labeller(&mut self, number: u32) -> u32 {
        let id = self.next_labeller;
        self.next_labeller += 1;
        let mut record = self.labeller_record(number, format!("labeller-{id}"));
        // In earnest, ticks since boot order processes, whatever the wall clock says.
        record.started = i64::from(id);
        self.tell(format!("labeller {number} starts as process {id}"));
        self.labellers.insert(
            id,
            Labeller {
                number,
                record,
                stopped_until: 0,
                started: self.now,
                phase: Phase::Begins,
                token: 0,
                stop: false,
                no_more_jobs: false,
                is_registered: false,
            },
        );
        let delay = self.random.between(100, 2_000);
        self.after(delay, Event::LabellerStarts(id));
        id
    }

    pub(super) fn is_labeller_active(&mut self, id: u32, event: Event) -> bool {
        let Some(labeller) = self.labellers.get(&id) else { return false };
        let until = labeller.stopped_until;
        if until > self.now {
            self.at(until, event);
        }
        until <= self.now
    }

    pub fn labeller_starts(&mut self, id: u32) {
        if self.is_labeller_active(id, Event::LabellerStarts(id)) {
            self.labeller_continues(id, Phase::Begins, 0);
        }
    }

    /// Goes on with this phase after a time.
    fn labeller_continues(&mut self, id: u32, phase: Phase, delay: Time) {
        let Some(labeller) = self.labellers.get_mut(&id) else { return };
        labeller.phase = phase;
        labeller.token += 1;
        let token = labeller.token;
        self.after(delay, Event::LabellerActs(id, token));
    }

    pub fn labeller_acts(&mut self, id: u32, token: u64) {
        if !self.is_labeller_active(id, Event::LabellerActs(id, token)) {
            return;
        }
        let labeller = &self.labellers[&id];
        if labeller.token != token {
            return;
        }
        match labeller.phase.clone() {
            Phase::Begins => self.labeller_registers(id),
            Phase::Idle => self.labeller_polls(id),
            Phase::Records { lease, calculation, is_new } => {
                self.labeller_records(id, lease, calculation, is_new);
            }
            Phase::Works { lease, calculation, held } => self.labeller_renews(id, lease, calculation, held),
            Phase::Delivers { lease, result, calculation } => {
                self.labeller_delivers(id, lease, result, calculation);
            }
            Phase::Stops => {}
            Phase::Removes { calculation } => {
                self.slurm.remove_directory(&calculation);
                self.labeller_continues(id, Phase::Idle, 0);
            }
            Phase::Releases => self.labeller_releases(id),
            Phase::Leaves => self.labeller_leaves(id),
        }
    }

    /// Handles an error: waits if it passes, otherwise ends the labeller.
    fn labeller_retries(&mut self, id: u32, phase: Phase, error: &StoreError) {
        if error.is_transient() {
            self.labeller_continues(id, phase, RETRY_INTERVAL);
        } else {
            self.fail(format!("labeller process {id} fails: {error}"));
        }
    }

    fn labeller_registers(&mut self, id: u32) {
        let record = self.labellers[&id].record.clone();
        let written =
            self.store.write(self.now, ClientKind::Labeller, "a labeller registers", async |store| {
                store.upsert_process(&record).await
            });
        match written {
            Ok(()) => {
                self.labellers.get_mut(&id).unwrap().is_registered = true;
                self.labeller_continues(id, Phase::Idle, 0);
                self.after(0, Event::LabellerHeartbeat(id));
            }
            Err(error) => self.labeller_retries(id, Phase::Begins, &error),
        }
    }

    /// Says which leases a labeller knows of. The database's reply to a commit may have been lost.
    fn state_leases(&mut self, id: u32, held: &[&Lease]) -> Result<usize, StoreError> {
        if self.bug == Some(PlantedBug::LostLeaseForgotten) {
            return Ok(0);
        }
        let (holder, wall) = (self.labellers[&id].record.id.clone(), self.wall_clock());
        // Usually nothing is written.
        self.store.write(self.now, ClientKind::Labeller, "leases are stated", async |store| {
            store.state_leases(&holder, held, wall).await
        })
    }

    fn labeller_polls(&mut self, id: u32) {
        let (now, wall) = (self.now, self.wall_clock());
        let labeller = &self.labellers[&id];
        if labeller.stop {
            return self.labeller_continues(id, Phase::Leaves, 0);
        }
        let (holder, no_more_jobs, number) =
            (labeller.record.id.clone(), labeller.no_more_jobs, labeller.number);
        let polled = self.state_leases(id, &[]).and_then(|_| {
            if !self.store.read(now, async |store| store.has_pending_labels(wall).await)? {
                return Ok((None, no_more_jobs));
            }
            let lease = self.store.write(now, ClientKind::Labeller, "a lease", async |store| {
                store.lease(PROTOCOL, &holder, wall, LEASE).await
            })?;
            Ok((lease, false))
        });
        match polled {
            Ok((None, true)) => self.labeller_continues(id, Phase::Leaves, 0),
            Ok((None, false)) => self.labeller_continues(id, Phase::Idle, POLL_INTERVAL),
            Ok((Some(lease), _)) => {
                let (job, attempt) = (lease.job, lease.attempt);
                self.tell(format!("labeller {number} (process {id}) leases job {job}, attempt {attempt}"));
                self.check_not_replaced(id);
                self.labeller_begins_job(id, Box::new(lease));
            }
            Err(error) => self.labeller_retries(id, Phase::Idle, &error),
        }
    }

    /// A labeller that was replaced, and could know it, leases nothing.
    fn check_not_replaced(&mut self, id: u32) {
        let Labeller { number, stopped_until, .. } = self.labellers[&id];
        let newer =
            self.labellers.range(id + 1..).filter(|(_, other)| other.number == number && other.is_registered);
        let since = newer.map(|(_, other)| other.started.max(stopped_until)).min();
        let reachable = self.store.away_until.max(self.store.full_until);
        if since.is_some_and(|since| self.now > since.max(reachable) + REPLACED_AFTER) {
            self.fail(format!("labeller process {id} leases a job although it was replaced"));
        }
    }

    /// Finds an earlier calculation of the job, or prepares a new one.
    fn labeller_begins_job(&mut self, id: u32, lease: Box<Lease>) {
        let adjustments = match self.adjustments_of(&lease) {
            Ok(adjustments) => adjustments,
            Err(class) => {
                let result = CalculationResult::Failure(class);
                return self.labeller_continues(id, Phase::Delivers { lease, result, calculation: None }, 0);
            }
        };
        if self.scenario.slurm {
            let phase = Phase::Works { lease: lease.clone(), calculation: None, held: true };
            self.labeller_continues(id, phase, RENEWAL_INTERVAL);
            return self.begin_slurm_label(id, lease, adjustments);
        }
        let is_useful = |calculation: &&String| {
            let state = self.calculations.get(*calculation).map(|found| found.state);
            !lease.failed_calculations.contains(calculation)
                && matches!(state, Some(CalculationState::Running | CalculationState::Ended))
        };
        let looks = self.bug != Some(PlantedBug::CalculationNotLookedUp);
        let earlier = lease.earlier_calculations.iter().find(is_useful).filter(|_| looks).cloned();
        let is_new = earlier.is_none();
        let calculation = earlier.unwrap_or_else(|| format!("{}.{}", lease.job, lease.attempt));
        if is_new && self.bug == Some(PlantedBug::CalculationRecordedLate) {
            self.start_calculation(&calculation, lease.job);
            let delay = self.random.between(1_000, 3_000);
            return self.labeller_continues(id, Phase::Records { lease, calculation, is_new: false }, delay);
        }
        let delay = self.random.between(10, 500);
        self.labeller_continues(id, Phase::Records { lease, calculation, is_new }, delay);
    }

    /// Records the calculation, and starts it then.
    fn labeller_records(&mut self, id: u32, lease: Box<Lease>, calculation: String, is_new: bool) {
        let made = CalculationRecord { cores: Some(1), ..CalculationRecord::default() };
        let name = calculation.as_str();
        let written =
            self.store.write(self.now, ClientKind::Labeller, "a calculation is recorded", async |store| {
                store.record_calculation(&lease, name, &made).await
            });
        if let Err(error) = written {
            return self.labeller_retries(id, Phase::Records { lease, calculation, is_new }, &error);
        }
        if is_new {
            self.start_calculation(&calculation, lease.job);
        }
        let is_over = self.calculations[&calculation].state != CalculationState::Running;
        let phase = Phase::Works { lease, calculation: Some(calculation.clone()), held: true };
        self.labeller_continues(id, phase, RENEWAL_INTERVAL);
        if is_over {
            self.wake_labellers_of(&calculation);
        }
    }

    /// Renews a lease. If it was lost, finds out whether the result is still needed.
    fn labeller_renews(&mut self, id: u32, lease: Box<Lease>, calculation: Option<String>, mut held: bool) {
        let (now, wall) = (self.now, self.wall_clock());
        let stop = self.labellers[&id].stop;
        if let Some(calculation) = calculation.as_ref().filter(|_| stop) {
            self.tell(format!("labeller process {id} leaves calculation {calculation} running"));
            self.slurm.drop_task(id);
            return self.labeller_continues(id, Phase::Releases, 0);
        }
        if held {
            let renewed = self.store.write(now, ClientKind::Labeller, "a lease is renewed", async |store| {
                store.renew(&lease, wall, LEASE).await
            });
            held = match renewed {
                Err(error) if !error.is_transient() => return self.fail(format!("renewal: {error}")),
                renewed => renewed.unwrap_or(true),
            };
            if self.bug == Some(PlantedBug::LeaseGivenTwice) {
                let requeue = sqlx::query(
                    "UPDATE job SET state = 'queued', holder = NULL, expires = NULL WHERE number = $1",
                );
                self.store.runtime.block_on(requeue.bind(lease.job).execute(&mut self.direct)).unwrap();
            }
        }
        let _ = self.state_leases(id, &[&lease]);
        if let Some(own) = calculation.as_ref().filter(|_| !held) {
            match self.store.read(now, async |store| store.lease_status(&lease).await) {
                Ok(LeaseStatus::Over) => {
                    self.tell(format!("labeller process {id} stops: the result is no longer needed"));
                    return self.labeller_stops_calculation(id, own.clone());
                }
                Ok(LeaseStatus::LeasedAgain { calculation: Some(other) }) if other == *own => {
                    self.slurm.drop_task(id);
                    return self.labeller_continues(id, Phase::Idle, 0);
                }
                _ => {}
            }
        }
        // It leaves as soon as it has a calculation.
        let pause = if stop { RETRY_INTERVAL } else { RENEWAL_INTERVAL };
        self.labeller_continues(id, Phase::Works { lease, calculation, held }, pause);
    }

    /// Ends a calculation that is no longer needed.
    fn labeller_stops_calculation(&mut self, id: u32, calculation: String) {
        if !self.scenario.slurm {
            self.remove_calculation(&calculation);
            return self.labeller_continues(id, Phase::Idle, 0);
        }
        self.labeller_continues(id, Phase::Stops, 0);
        self.begin_slurm_stop(id, calculation);
    }

    /// The lease on which a labeller works.
    pub fn lease_of(&self, id: u32) -> Option<Box<Lease>> {
        match &self.labellers.get(&id)?.phase {
            Phase::Works { lease, .. } => Some(lease.clone()),
            _ => None,
        }
    }

    /// A labeller has found or prepared the calculation for which it waits.
    pub fn labeller_takes(&mut self, id: u32, taken: String) {
        if let Some(Labeller { phase: Phase::Works { calculation, .. }, .. }) = self.labellers.get_mut(&id) {
            *calculation = Some(taken);
        }
    }

    /// A labeller has the result of its job.
    pub fn labeller_has_result(&mut self, id: u32, result: CalculationResult, calculation: Option<String>) {
        let Some(lease) = self.lease_of(id) else { return };
        let delay = self.random.between(5, 500);
        self.labeller_continues(id, Phase::Delivers { lease, result, calculation }, delay);
    }

    pub fn labeller_is_idle(&mut self, id: u32) {
        self.labeller_continues(id, Phase::Idle, 0);
    }

    /// A labeller cannot go on, whatever the job.
    pub fn labeller_fails(&mut self, id: u32) {
        let (holder, wall) = (self.labellers[&id].record.id.clone(), self.wall_clock());
        // Otherwise the leases of a dead process are released.
        let _ = self.store.write(self.now, ClientKind::Labeller, "leases are released", async |store| {
            store.release_all(&holder, wall).await
        });
        self.labeller_exits(id, Exit::Failed);
    }

    /// A calculation has ended: who waits for it delivers its result.
    pub fn wake_labellers_of(&mut self, ended: &str) {
        let waits = |labeller: &Labeller| match &labeller.phase {
            Phase::Works { lease, calculation: Some(own), .. } if own == ended => Some(lease.clone()),
            _ => None,
        };
        let waiting: Vec<_> =
            self.labellers.iter().filter_map(|(id, labeller)| Some((*id, waits(labeller)?))).collect();
        let calculation = &self.calculations[ended];
        let result = match calculation.state {
            CalculationState::Gone => CalculationResult::Failure(FailureClass::NodeFailure),
            _ => calculation.result,
        };
        for (id, lease) in waiting {
            let delay = self.random.between(5, 500);
            self.labeller_continues(id, Phase::Delivers { lease, result, calculation: None }, delay);
        }
    }

    fn labeller_delivers(
        &mut self,
        id: u32,
        lease: Box<Lease>,
        result: CalculationResult,
        calculation: Option<String>,
    ) {
        let (now, wall, client) = (self.now, self.wall_clock(), ClientKind::Labeller);
        let delivered = match result {
            CalculationResult::Label(energy) => {
                let forces = vec![[0.1, 0.2, 0.3]; ATOMS];
                let label = Label { energy, forces, stress: None, details: Default::default() };
                let outcome = self
                    .store
                    .write(now, client, "a label", async |store| store.complete(&lease, &label, wall).await);
                outcome.map(|outcome| match outcome {
                    CompleteOutcome::Label => "labelled".to_owned(),
                    CompleteOutcome::KeptAsCheck => "kept as a check".to_owned(),
                })
            }
            CalculationResult::Failure(class) => {
                let limit = attempt_limit(&lease.failures, class, self.attempts());
                let counts = counts_as_attempt(class) || self.bug == Some(PlantedBug::NodeFailuresCounted);
                let outcome = self.store.write(now, client, "a failure", async |store| match counts {
                    true => store.fail(&lease, class.name(), "log", limit, wall).await,
                    false => store.release_lost(&lease, class.name(), "log", wall).await,
                });
                if let Ok(FailOutcome::Failed) = outcome {
                    self.check_failed_job(lease.job);
                }
                outcome.map(|outcome| format!("{class}, {outcome:?}"))
            }
        };
        match delivered {
            Ok(what) => {
                self.tell(format!("labeller process {id} delivers job {}: {what}", lease.job));
                match calculation {
                    Some(calculation) => self.labeller_continues(id, Phase::Removes { calculation }, 200),
                    None => self.labeller_continues(id, Phase::Idle, 0),
                }
            }
            Err(error) => {
                self.labeller_retries(id, Phase::Delivers { lease, result, calculation }, &error);
            }
        }
    }

    fn labeller_releases(&mut self, id: u32) {
        let (holder, wall) = (self.labellers[&id].record.id.clone(), self.wall_clock());
        let released =
            self.store.write(self.now, ClientKind::Labeller, "leases are released", async |store| {
                store.release_all(&holder, wall).await
            });
        match released {
            Ok(_) => self.labeller_continues(id, Phase::Leaves, 0),
            Err(error) => self.labeller_retries(id, Phase::Releases, &error),
        }
    }

    fn labeller_leaves(&mut self, id: u32) {
        let record = self.labellers[&id].record.id.clone();
        let left = self.state_leases(id, &[]).and_then(|_| {
            self.store.write(self.now, ClientKind::Labeller, "a labeller leaves", async |store| {
                store.remove_process(&record).await
            })
        });
        match left {
            Ok(()) => self.labeller_exits(id, Exit::Done),
            Err(error) => self.labeller_retries(id, Phase::Leaves, &error),
        }
    }

    /// Says that a labeller lives, and finds out whether it is still needed.
    pub fn labeller_heartbeat(&mut self, id: u32) {
        if !self.is_labeller_active(id, Event::LabellerHeartbeat(id)) {
            return;
        }
        let (now, wall) = (self.now, self.wall_clock());
        let continues = self.bug == Some(PlantedBug::ReplacedLabellerContinues);
        let labeller = self.labellers.get_mut(&id).unwrap();
        let sent = (|| {
            let others = self.store.read(now, async |store| store.processes(None).await)?;
            if !continues && others.iter().any(|other| other.replaces(&labeller.record)) {
                labeller.stop = true;
            }
            let led = others.iter().any(ProcessRecord::is_leading);
            labeller.no_more_jobs = match led {
                true => false,
                false => self.store.read(now, async |store| {
                    Ok(store.all_walks_ended().await? && !is_refit_due(store).await?)
                })?,
            };
            if !led {
                self.store.write(now, ClientKind::Labeller, "leases of dead processes", async |store| {
                    store.release_leases_of_dead_processes(wall).await
                })?;
            }
            labeller.record.last_seen = wall;
            if labeller.stop {
                labeller.record.state = "stopping".to_owned();
            }
            let record = labeller.record.clone();
            self.store.write(now, ClientKind::Labeller, "a heartbeat", async |store| {
                store.upsert_process(&record).await
            })
        })();
        match sent {
            Err(error) if !error.is_transient() => self.fail(format!("heartbeat: {error}")),
            _ => self.after(HEARTBEAT_INTERVAL, Event::LabellerHeartbeat(id)),
        }
    }

    /// Asks a labeller to stop.
    pub fn terminate_labeller(&mut self, id: u32) {
        let Some(labeller) = self.labellers.get_mut(&id) else { return };
        labeller.stop = true;
        // It notices at once, whatever it waits for; a calculation continues without it.
        if let Phase::Idle | Phase::Works { .. } = labeller.phase {
            let phase = labeller.phase.clone();
            self.labeller_continues(id, phase, 100);
        }
    }

    /// The process of a labeller ends; its calculations continue.
    pub fn labeller_exits(&mut self, id: u32, exit: Exit) {
        let Some(labeller) = self.labellers.remove(&id) else { return };
        self.slurm.drop_task(id);
        self.tell(format!("labeller {} (process {id}) has ended: {exit:?}", labeller.number));
        self.process_is_dead(&labeller.record.id);
        self.after(1, Event::LabellerGone(id, labeller.record.id, exit));
    }
}
