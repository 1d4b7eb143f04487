//! Labellers: a stand-in that follows the rules of `workers::labeller` step by step, on the real label queue.

mod delivery;
mod heartbeat;
mod queue;
mod work;

use store::records::Lease;
use store::{ProcessRecord, StoreError};
use wire::ContentHash;

use super::calculation::CalculationResult;
use super::event::{Event, Exit};
use super::fault::{ClientKind, Time};
use super::world::World;

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
/// A replaced labeller may begin no label so long after its successor registered.
const REPLACED_AFTER: Time = 3 * HEARTBEAT_INTERVAL;

/// A process of a labeller.
pub struct Labeller {
    pub number: u32,
    pub record: ProcessRecord,
    pub stopped_until: Time,
    phase: Phase,
    /// What it was told to do last; earlier events mean nothing.
    token: u64,
    /// Asked to stop.
    stop: bool,
    no_more_jobs: bool,
    /// When the store learned of it.
    registered: Option<Time>,
    /// It has removed what killed labellers left.
    has_cleaned: bool,
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
                phase: Phase::Begins,
                token: 0,
                stop: false,
                no_more_jobs: false,
                registered: None,
                has_cleaned: false,
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
            Phase::Removes { calculation } => self.remove_directory(id, &calculation),
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
                self.labellers.get_mut(&id).unwrap().registered = Some(self.now);
                self.labeller_continues(id, Phase::Idle, 0);
                self.after(0, Event::LabellerHeartbeat(id));
            }
            Err(error) => self.labeller_retries(id, Phase::Begins, &error),
        }
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
