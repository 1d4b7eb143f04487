//! Processes of refits: a stand-in that takes the steps of `refit`, each of which leaves something in a directory that
//! outlives it. Real are the registration of versions, the set of labels, and whether a refit is recorded already. A person
//! may go back to an earlier version.

use std::collections::{BTreeMap, BTreeSet};

use monitor::refit_progress::{LABEL_SET, LabelSet, NO_LABELS};
use monitor::refit_record::recorded_before;
use serde_json::json;
use store::{ExportCursor, ProcessRecord, StoreError, VersionFiles, VersionRecord, VersionState};

use super::event::{Event, Exit};
use super::fault::{ClientKind, Time};
use super::labeller::PROTOCOL;
use super::planted::PlantedBug;
use super::random::Random;
use super::refit::{RefitEvent, refused_version};
use super::world::World;

/// Number of steps of a training.
const EPOCHS: u32 = 4;

/// Refits that run, and what they leave.
#[derive(Default)]
pub struct RefitProcesses {
    running: BTreeMap<u32, Refitter>,
    pub(super) directories: BTreeMap<u32, RefitDirectory>,
    /// Faults of coming processes.
    kills: Vec<(Time, Exit)>,
    started: u32,
}

/// A process of a refit.
struct Refitter {
    session: u64,
    /// The version from which it trains.
    parent: u32,
    step: Step,
    record: ProcessRecord,
    has_lock: bool,
    stop: bool,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Step {
    Begins,
    /// Of the attempt with this number.
    FixesSet(u32),
    FixesLabels(u32),
    Trains(u32),
    Records(u32),
    RemovesDirectory(u32),
}

/// What a refit leaves for the next process of it.
#[derive(Clone, Default)]
pub struct RefitDirectory {
    /// Number of accepted structures, and the newest decision.
    set: Option<(u64, i64)>,
    /// The set of labels, and their number.
    pub(super) labels: Option<(String, u64)>,
    epochs: u32,
}

impl World {
    /// Starts a process of the refit of a run.
    pub(super) fn new_refitter(&mut self, session: u64, parent: u32) {
        self.refits.started += 1;
        let id = self.refits.started;
        let record = self.process_record(ProcessRecord::REFITTER, None, format!("refitter-{id}"));
        self.tell(format!("refitter {id} starts"));
        let refitter = Refitter { session, parent, step: Step::Begins, record, has_lock: false, stop: false };
        self.refits.running.insert(id, refitter);
        if !self.refits.kills.is_empty() {
            let (after, exit) = self.refits.kills.remove(0);
            self.after(after, Event::Refit(RefitEvent::RefitterIsKilled(id, exit)));
        }
        self.refitter_continues(id, Step::Begins, 500);
    }

    pub(super) fn refitter_of(&self, session: u64) -> Option<u32> {
        self.refits.running.iter().find(|(_, of)| of.session == session).map(|(id, _)| *id)
    }

    /// Processes of refits, that which runs first, are killed after this time.
    pub(super) fn kill_refitter(&mut self, after: Time, times: u32, exit: Exit) {
        let mut times = times;
        if let Some(id) = self.refits.running.keys().next_back().copied() {
            self.after(after, Event::Refit(RefitEvent::RefitterIsKilled(id, exit)));
            times -= 1;
        }
        self.refits.kills.extend((0..times).map(|_| (after, exit)));
    }

    fn refitter_continues(&mut self, id: u32, step: Step, longest: Time) {
        let Some(refitter) = self.refits.running.get_mut(&id) else { return };
        refitter.step = step;
        let delay = self.random.between(longest / 5, longest);
        self.after(delay, Event::Refit(RefitEvent::RefitterActs(id)));
    }

    pub(super) fn refitter_acts(&mut self, id: u32) {
        let Some(refitter) = self.refits.running.get(&id) else { return };
        if refitter.stop {
            return self.refitter_exits(id, Exit::Done);
        }
        let done = match refitter.step {
            Step::Begins => self.refitter_begins(id),
            Step::FixesSet(number) => self.refitter_fixes_set(id, number),
            Step::FixesLabels(number) => self.refitter_fixes_labels(id, number),
            Step::Trains(number) => {
                self.refitter_trains(id, number);
                Ok(())
            }
            Step::Records(number) => self.refitter_records(id, number),
            Step::RemovesDirectory(number) => {
                self.refits.directories.remove(&number);
                self.refitter_leaves(id);
                Ok(())
            }
        };
        match done {
            Ok(()) => {}
            Err(error @ StoreError::Inconsistent(_)) => self.fail(format!("refitter {id} fails: {error}")),
            Err(error) => {
                self.tell(format!("refitter {id} cannot go on: {error}"));
                self.refitter_exits(id, Exit::Failed);
            }
        }
    }

    /// Registers, locks the directory, and finds out what there is to do.
    fn refitter_begins(&mut self, id: u32) -> Result<(), StoreError> {
        let now = self.now;
        if self.refits.running.iter().any(|(other, refitter)| *other != id && refitter.has_lock) {
            self.tell(format!("refitter {id} cannot go on: another refit is running"));
            self.refitter_exits(id, Exit::Failed);
            return Ok(());
        }
        let split = self.scenario.refits.as_ref().expect("a campaign with refits").rules().split;
        let left: BTreeSet<u32> = self.refits.directories.keys().copied().collect();
        let refitter = self.refits.running.get_mut(&id).expect("it acts");
        refitter.has_lock = true;
        let (record, parent) = (refitter.record.clone(), refitter.parent);
        // A heartbeat may be missing.
        let _ = self.store.read(now, async |store| store.upsert_process(&record).await);
        let (before, number) = self.store.read(now, async |store| {
            let versions = store.versions().await?;
            let is_left = |number| left.contains(&number);
            let before = recorded_before((store, &split), &versions, parent, is_left).await?;
            Ok((before, VersionRecord::next_number(&versions)))
        })?;
        match before.filter(|_| self.bug != Some(PlantedBug::VersionRecordedTwice)) {
            Some(record) => {
                self.tell(format!("refitter {id} finds version {}: it is recorded", record.number));
                self.refits.directories.remove(&record.number);
                self.refitter_leaves(id);
            }
            None => {
                self.refits.directories.retain(|other, _| *other == number);
                self.refits.directories.entry(number).or_default();
                self.refitter_continues(id, Step::FixesSet(number), 500);
            }
        }
        Ok(())
    }

    fn refitter_fixes_set(&mut self, id: u32, number: u32) -> Result<(), StoreError> {
        let found = self.store.read(self.now, async |store| {
            // In this order: a structure that is accepted in between counts for the next refit.
            Ok((store.accepted_structures().await?, store.newest_mixture().await?.decision))
        })?;
        self.refits.directories.entry(number).or_default().set.get_or_insert(found);
        self.refitter_continues(id, Step::FixesLabels(number), 2_000);
        Ok(())
    }

    fn refitter_fixes_labels(&mut self, id: u32, number: u32) -> Result<(), StoreError> {
        let marks = self.store.read(self.now, async |store| store.label_marks(PROTOCOL).await)?;
        let directory = self.refits.directories.entry(number).or_default();
        let (_, last_decision) = directory.set.expect("it is fixed");
        let (mut set, mut labels) = (LabelSet::new(PROTOCOL), 0);
        for mark in marks {
            if !matches!(mark.cursor, ExportCursor::Candidate(decision) if decision > last_decision) {
                set.add(mark.cursor, mark.energy);
                labels += 1;
            }
        }
        let (_, labels) = directory.labels.get_or_insert((set.hash(), labels));
        let next = if *labels > 0 { Step::Trains(number) } else { Step::Records(number) };
        self.refitter_continues(id, next, 500);
        Ok(())
    }

    fn refitter_trains(&mut self, id: u32, number: u32) {
        let directory = self.refits.directories.entry(number).or_default();
        directory.epochs += 1;
        let next = if directory.epochs < EPOCHS { Step::Trains(number) } else { Step::Records(number) };
        self.refitter_continues(id, next, 4_000);
    }

    fn refitter_records(&mut self, id: u32, number: u32) -> Result<(), StoreError> {
        let directory = self.refits.directories.get(&number).cloned().unwrap_or_default();
        let parent = self.refits.running[&id].parent;
        let (record, files) = self.outcome_of_refit(number, parent, &directory);
        self.store.write(self.now, ClientKind::Refitter, "a version is recorded", async |store| {
            store.add_version(&record, files.as_ref()).await.map(|()| true)
        })?;
        let state = record.state.name();
        self.tell(format!(
            "refitter {id} records version {number} from {parent}: {state}, {} labels",
            record.labels
        ));
        self.refitter_continues(id, Step::RemovesDirectory(number), 1_000);
        Ok(())
    }

    /// What comes of a refit: the same whenever and however often it is tried.
    fn outcome_of_refit(
        &self,
        number: u32,
        parent: u32,
        directory: &RefitDirectory,
    ) -> (VersionRecord, Option<VersionFiles>) {
        let (structures, last_decision) = directory.set.unwrap_or_default();
        let (label_set, labels) = directory.labels.clone().unwrap_or_default();
        let mut random = Random::new(self.scenario.number ^ u64::from(number) << 24);
        let attempt = VersionRecord {
            structures,
            last_decision,
            labels,
            seconds: 1.0,
            ..refused_version(number, parent, self.wall_clock())
        };
        if labels == 0 || random.happens(20) {
            let reason = if labels == 0 { NO_LABELS } else { "its errors rose" };
            let figures = json!({ LABEL_SET: label_set });
            return (VersionRecord { reason: reason.to_owned(), figures, ..attempt }, None);
        }
        let model = format!("model {number} from {parent}, trained on {label_set}");
        let files =
            VersionFiles { model: model.into_bytes(), mixture: format!("mixture {number}").into_bytes() };
        let [model_hash, mixture_hash] = files.hashes();
        let error = random.between(50, 99) as f64 / 100.0;
        let set = json!({
            "name": "held_out", "kind": "held_out", "structures": 5,
            "parent": { "force_mae": 1.0 }, "version": { "force_mae": error },
        });
        let figures = json!({ "sets": [set], LABEL_SET: label_set });
        let state = VersionState::Registered;
        (VersionRecord { state, model_hash, mixture_hash, figures, ..attempt }, Some(files))
    }

    fn refitter_leaves(&mut self, id: u32) {
        let record = self.refits.running[&id].record.id.clone();
        let _ = self.store.read(self.now, async |store| store.remove_process(&record).await);
        self.refitter_exits(id, Exit::Done);
    }

    /// Asks the refitter of a run to stop: it does so after the current step.
    pub(super) fn terminate_refitter(&mut self, session: u64) {
        let of_run = |refitter: &&mut Refitter| refitter.session == session;
        self.refits.running.values_mut().filter(of_run).for_each(|refitter| refitter.stop = true);
    }

    /// The process of a refit ends; its directory stays.
    pub(super) fn refitter_exits(&mut self, id: u32, exit: Exit) {
        let Some(refitter) = self.refits.running.remove(&id) else { return };
        self.tell(format!("refitter {id} has ended: {exit:?}"));
        self.process_is_dead(&refitter.record.id);
        self.after(1, Event::Refit(RefitEvent::RefitterGone(refitter.session, exit)));
    }

    /// Refits end with the process that started them.
    pub(super) fn refitters_die_with(&mut self, session: u64) {
        let of_run: Vec<u32> = self.refitter_of(session).into_iter().collect();
        of_run.into_iter().for_each(|id| self.refitter_exits(id, Exit::Killed));
    }

    /// A person registers the files of an earlier version again, as `calmwalk versions … roll-back` does.
    pub(super) fn roll_back(&mut self) {
        let wall = self.wall_clock();
        let versions = self.store.runtime.block_on(self.store.store.versions()).unwrap();
        let registered: Vec<&VersionRecord> =
            versions.iter().filter(|version| version.state == VersionState::Registered).collect();
        let Some((newest, earlier)) = registered.split_last() else { return };
        let number = match self.random.below(1 + earlier.len() as u64) {
            0 => 0,
            place => earlier[place as usize - 1].number,
        };
        if newest.method == VersionRecord::ROLLBACK && newest.parent == number {
            return;
        }
        let source = earlier.iter().find(|version| version.number == number);
        let files = match self.store.runtime.block_on(self.store.store.version_files(number)).unwrap() {
            Some(files) => files,
            None => VersionFiles { model: b"model 0".to_vec(), mixture: b"mixture 0".to_vec() },
        };
        let [model_hash, mixture_hash] = files.hashes();
        let record = VersionRecord {
            state: VersionState::Registered,
            method: VersionRecord::ROLLBACK.to_owned(),
            structures: versions.iter().map(|version| version.structures).max().unwrap_or(0),
            last_decision: source.map_or(0, |source| source.last_decision),
            labels: source.map_or(0, |source| source.labels),
            model_hash,
            mixture_hash,
            ..refused_version(VersionRecord::next_number(&versions), number, wall)
        };
        let added =
            self.store.write(self.now, ClientKind::Labeller, "a version is rolled back", async |store| {
                store.add_version(&record, Some(&files)).await.map(|()| true)
            });
        self.tell(format!("version {} is version {number} again: {}", record.number, added.is_ok()));
    }
}
