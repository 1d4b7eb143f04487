//! A stand-in for a batch system: its queue, nodes and daemon, with commands that take time, are refused or lose their replies.
//! It answers in the words of `squeue`, or in those of PBS or LSF, which the labeller's own parsers read.

mod custom_labeller;
mod dialect;
mod fault;
mod files;
mod jobs;
mod labeller;
mod requests;
mod slurm_labeller;

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;

use dft::RetryAdjustment;

use super::event::Event;
use super::fault::Time;
use super::ladder::Ladders;
use super::scenario::Scenario;
use super::world::World;
use dialect::Dialect;
use files::SharedFiles;
use jobs::BatchJob;
use labeller::{Answer, Request, SlurmTask};

pub use fault::SlurmFault;

/// What happens at Slurm, and to labellers that use it.
#[derive(Clone, Debug)]
pub enum SlurmEvent {
    /// A submission arrives; its reply goes to this request of a labeller.
    Submitted {
        name: String,
        /// Its number, where submissions have one.
        submission: u32,
        excluded: BTreeSet<String>,
        client: (u32, u64),
        replies: bool,
    },
    /// A job gets its node.
    Begins(u64),
    /// The program of a job ends, by itself or in one of the ways of [`fault::ENDS`].
    Ends(u64, Option<usize>),
    /// Slurm knows that a job has this state.
    Known(u64, &'static str),
    Answer(u32, u64, Answer),
    /// A labeller tries to write again.
    Repeats(u32, u64, Request),
}

/// Slurm, the files of its jobs, and the labellers that use it.
pub struct SlurmWorld {
    seed: u64,
    /// The batch system, if it is not Slurm.
    dialect: Option<Dialect>,
    jobs: Vec<BatchJob>,
    files: Rc<RefCell<SharedFiles>>,
    away_until: Time,
    full_until: Time,
    late_until: Time,
    /// How long Slurm knows jobs that are over.
    memory: Time,
    /// What happens to the next calls of `sbatch`.
    next_submissions: Vec<SlurmFault>,
    /// The next labeller that removes a directory is killed meanwhile.
    kills_in_removal: bool,
    /// The list of unfinished jobs that labellers share, and when it was made.
    list: Option<(Time, String)>,
    tasks: BTreeMap<u32, SlurmTask>,
    next_token: u64,
    pub ladders: Ladders,
}

impl SlurmWorld {
    pub fn new(seed: u64, scenario: &Scenario) -> Self {
        Self {
            seed,
            dialect: scenario.custom.then(|| Dialect::of(seed)),
            jobs: Vec::new(),
            files: Rc::default(),
            away_until: 0,
            full_until: 0,
            late_until: 0,
            memory: [5_000, 25_000, 60_000][(seed % 3) as usize],
            next_submissions: Vec::new(),
            kills_in_removal: false,
            list: None,
            tasks: BTreeMap::new(),
            next_token: 0,
            ladders: Ladders::default(),
        }
    }

    /// The labeller has turned to something else.
    pub fn drop_task(&mut self, labeller: u32) {
        self.tasks.remove(&labeller);
    }

    /// The store has the result of a calculation.
    pub fn is_delivered(&mut self, name: &str) {
        if let Some(found) = self.files.borrow_mut().directories.get_mut(name) {
            found.is_delivered = true;
        }
    }

    /// The adjustments of all calculations of a job of the label queue.
    pub fn adjustments_tried(&self, job: i64) -> BTreeSet<RetryAdjustment> {
        let files = self.files.borrow();
        let calculations = files.directories.values().filter(|found| found.job == job);
        calculations.flat_map(|found| found.adjustments.iter().copied()).collect()
    }

    fn job(&mut self, id: u64) -> &mut BatchJob {
        &mut self.jobs[id as usize - 1]
    }

    /// The jobs that Slurm knows, in no order that means anything.
    fn known(&self, now: Time) -> impl Iterator<Item = &BatchJob> {
        let is_known = move |job: &&BatchJob| job.ended.is_none_or(|ended| now < ended + self.memory);
        let newest_first = self.seed.is_multiple_of(2);
        let number = self.jobs.len();
        let order = move |place: usize| if newest_first { number - 1 - place } else { place };
        (0..number).map(move |place| &self.jobs[order(place)]).filter(is_known)
    }
}

impl World {
    pub fn begin_slurm_fault(&mut self, fault: SlurmFault) {
        let slurm = &mut self.slurm;
        match fault {
            SlurmFault::Away { until } => slurm.away_until = slurm.away_until.max(until),
            SlurmFault::Full { until } => slurm.full_until = slurm.full_until.max(until),
            SlurmFault::FilesLate { until } => slurm.late_until = slurm.late_until.max(until),
            SlurmFault::ReplyLost | SlurmFault::LateSubmission { .. } => slurm.next_submissions.push(fault),
            SlurmFault::JobEnds { how } => {
                let job = slurm.jobs.iter().find(|job| job.is_calculating).map(|job| job.id);
                job.into_iter().for_each(|id| self.batch_job_ends(id, Some(how)));
            }
            SlurmFault::WaitingJobCancelled => {
                let job = slurm.jobs.iter().find(|job| job.state == "PENDING").map(|job| job.id);
                job.into_iter().for_each(|id| self.cancel_batch_job(id));
            }
            SlurmFault::KilledInRemoval => slurm.kills_in_removal = true,
            SlurmFault::DirectoryRemoved => {
                let mut files = slurm.files.borrow_mut();
                let found = files.directories.iter_mut().find(|(_, found)| !found.is_removed);
                if let Some((name, found)) = found {
                    (found.is_removed, found.is_damaged) = (true, true);
                    // Slurm knows a job by its name; ids of other jobs are gone with the directory, and what they compute is
                    // lost.
                    found.is_running &= slurm.dialect.is_none();
                    let sentence = format!("the directory of {name} is gone");
                    drop(files);
                    self.tell(sentence);
                }
            }
        }
    }

    pub fn slurm_event(&mut self, event: SlurmEvent) {
        match event {
            SlurmEvent::Submitted { name, submission, excluded, client, replies } => {
                self.job_is_submitted((name, submission), excluded, client, replies);
            }
            SlurmEvent::Begins(id) => self.batch_job_begins(id),
            SlurmEvent::Ends(id, how) => self.batch_job_ends(id, how),
            SlurmEvent::Known(id, state) => {
                let now = self.now;
                let job = self.slurm.job(id);
                job.state = state;
                if state != "COMPLETING" {
                    job.ended = Some(now);
                }
            }
            SlurmEvent::Answer(labeller, token, ref answer) => {
                if self.waits_for(labeller, token, &event) {
                    self.task_continues(labeller, Some(answer.clone()));
                }
            }
            SlurmEvent::Repeats(labeller, token, ref request) => {
                if self.waits_for(labeller, token, &event) {
                    self.fulfil(labeller, token, request.clone());
                }
            }
        }
    }

    /// Whether a labeller waits for this event and does not hang.
    fn waits_for(&mut self, labeller: u32, token: u64, event: &SlurmEvent) -> bool {
        self.slurm.tasks.get(&labeller).is_some_and(|task| task.token == token)
            && self.is_labeller_active(labeller, Event::Slurm(event.clone()))
    }

    fn is_slurm_away(&self) -> bool {
        self.now < self.slurm.away_until
    }
}
