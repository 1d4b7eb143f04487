//! A stand-in for a batch system: its queue, nodes and daemon, with commands that take time, are refused or lose their replies.
//! It answers in the words of `squeue`, or in those of PBS or LSF, which the labeller's own parsers read.

mod custom_labeller;
mod dialect;
mod fault;
mod files;
mod labeller;
mod requests;
mod slurm_labeller;

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::rc::Rc;

use dft::{Exit as ProgramExit, FailureClass, RetryAdjustment};
use workers::labeller::decisions::{CalculationEnd, EndReason};

use super::event::Event;
use super::fault::Time;
use super::ladder::{Difficulty, Ladders};
use super::scenario::Scenario;
use super::world::World;
use dialect::Dialect;
use fault::ENDS;
use files::{SETTLE_TIME, SharedFiles};
use labeller::{Answer, Request, SlurmTask};

pub use fault::SlurmFault;

const NODES: [&str; 3] = ["n1", "n2", "n3"];
/// Time between two tries to begin a job that waits for another one, or for Slurm.
const SCHEDULING_INTERVAL: Time = 1_000;
/// A command whose reply is lost fails after this time.
const REPLY_TIMEOUT: Time = 10_000;
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
    /// The program of a job ends, by itself or in one of the ways of [`ENDS`].
    Ends(u64, Option<usize>),
    /// Slurm knows that a job has this state.
    Known(u64, &'static str),
    Answer(u32, u64, Answer),
    /// A labeller tries to write again.
    Repeats(u32, u64, Request),
}

/// A job.
struct BatchJob {
    id: u64,
    /// That of its directory.
    name: String,
    submission: u32,
    excluded: BTreeSet<String>,
    state: &'static str,
    node: &'static str,
    begun: Time,
    /// When Slurm knew that it had ended.
    ended: Option<Time>,
    /// It calculates now: a job whose calculation another one has begun does nothing.
    is_calculating: bool,
}

impl BatchJob {
    fn is_over(&self) -> bool {
        self.ended.is_some()
    }

    /// As `squeue` shows it.
    fn line(&self, now: Time) -> String {
        let seconds = match (self.state, self.ended) {
            ("PENDING", _) => 0,
            (_, ended) => ended.unwrap_or(now).saturating_sub(self.begun) / 1000,
        };
        let (id, state, node) = (self.id, self.state, self.node);
        format!("{id}|{state}|{node}|{}:{:02}|None", seconds / 60, seconds % 60)
    }
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

    fn job_is_submitted(
        &mut self,
        (name, submission): (String, u32),
        excluded: BTreeSet<String>,
        client: (u32, u64),
        replies: bool,
    ) {
        let is_refused = NODES.iter().all(|node| excluded.contains(*node));
        let reply = if self.is_slurm_away() || is_refused {
            Answer::Text(None)
        } else if self.now < self.slurm.full_until {
            Answer::Full
        } else {
            let id = self.slurm.jobs.len() as u64 + 1;
            self.tell(format!("the batch system has job {id}, of calculation {name}"));
            let job = BatchJob {
                id,
                name,
                submission,
                excluded,
                state: "PENDING",
                node: "",
                begun: self.now,
                ended: None,
                is_calculating: false,
            };
            self.slurm.jobs.push(job);
            let most = if self.random.happens(50) { 900 } else { 6_000 };
            let delay = self.random.between(200, most);
            self.after(delay, Event::Slurm(SlurmEvent::Begins(id)));
            Answer::Text(Some(id.to_string()))
        };
        if let Some(dialect) = self.slurm.dialect.clone() {
            return self.custom_reply(&dialect, client, reply, replies);
        }
        let (reply, delay) = match replies {
            true => (reply, self.random.between(20, 300)),
            false => (Answer::Text(None), REPLY_TIMEOUT),
        };
        self.after(delay, Event::Slurm(SlurmEvent::Answer(client.0, client.1, reply)));
    }

    /// The answer of another batch system to a submission.
    fn custom_reply(&mut self, dialect: &Dialect, client: (u32, u64), reply: Answer, replies: bool) {
        // A daemon that is away, or whose reply is lost, lets the command hang, or fail.
        let hangs = self.random.happens(50);
        let (reply, delay) = match reply {
            Answer::Full => (Answer::Output(dialect.full()), self.random.between(20, 300)),
            Answer::Text(Some(id)) if replies => {
                let number = id.parse().expect("its number");
                (Answer::Output(dialect.submitted(number)), self.random.between(20, 300))
            }
            _ if hangs => (Answer::Text(None), REPLY_TIMEOUT),
            _ => (Answer::Output(dialect.unreachable()), self.random.between(200, 3_000)),
        };
        self.after(delay, Event::Slurm(SlurmEvent::Answer(client.0, client.1, reply)));
    }

    /// A job gets its node, unless another one of its name is unfinished.
    fn batch_job_begins(&mut self, id: u64) {
        let (now, is_away) = (self.now, self.is_slurm_away());
        let BatchJob { ref name, state, ref excluded, submission, .. } = *self.slurm.job(id);
        if state != "PENDING" {
            return;
        }
        let (name, excluded) = (name.clone(), excluded.clone());
        // Slurm lets a job wait for others of its name.
        let is_singleton = self.slurm.dialect.is_none();
        let is_earlier = |job: &BatchJob| is_singleton && job.name == name && job.id < id && !job.is_over();
        if is_away || self.slurm.jobs.iter().any(is_earlier) {
            return self.after(SCHEDULING_INTERVAL, Event::Slurm(SlurmEvent::Begins(id)));
        }
        let nodes: Vec<_> = NODES.into_iter().filter(|node| !excluded.contains(*node)).collect();
        let node = nodes[self.random.below(nodes.len() as u64) as usize];
        let delay = self.files_are_seen_after();
        let files = Rc::clone(&self.slurm.files);
        let mut files = files.borrow_mut();
        let found = files.directories.get_mut(&name).expect("it was submitted from there");
        let job = self.slurm.job(id);
        (job.node, job.begun) = (node, now);
        if found.is_removed || found.is_closed || found.begun.is_some() {
            job.state = if found.is_removed { "FAILED" } else { "COMPLETED" };
            job.ended = Some(now);
            return self.tell(format!("job {id} does nothing"));
        }
        (job.state, job.is_calculating) = ("RUNNING", true);
        (found.begun, found.begun_by, found.is_running) = (Some((now, now + delay)), submission, true);
        found.is_damaged |= delay > SETTLE_TIME;
        let number = found.job;
        // Labellers ask other batch systems less often.
        let long = if is_singleton { 40_000 } else { 70_000 };
        let longest = if self.random.happens(30) { long } else { 15_000 };
        let time = self.random.between(3_000, longest);
        self.tell(format!("job {id} of calculation {name} begins on {node}"));
        let others = files.directories.values().filter(|other| other.job == number && other.is_running);
        if others.count() > 1 && !self.handled.contains(&number) {
            self.fail(format!("two calculations of job {number} run at the same time"));
        }
        let how = self.random.happens(12).then(|| self.random.below(ENDS.len() as u64) as usize);
        self.after(time, Event::Slurm(SlurmEvent::Ends(id, how)));
    }

    /// After this time labellers see what a node has written now.
    fn files_are_seen_after(&mut self) -> Time {
        match self.now < self.slurm.late_until {
            true => self.random.between(0, 12_000),
            false => self.random.between(0, SETTLE_TIME - 200),
        }
    }

    /// The program of a job ends; its runner records it, unless Slurm has ended both.
    fn batch_job_ends(&mut self, id: u64, how: Option<usize>) {
        let (now, away_until) = (self.now, self.slurm.away_until);
        let job = self.slurm.job(id);
        if !std::mem::take(&mut job.is_calculating) {
            return;
        }
        let (name, node) = (job.name.clone(), job.node);
        let delay = self.files_are_seen_after();
        let files = Rc::clone(&self.slurm.files);
        let mut files = files.borrow_mut();
        let is_first = {
            let number = files.directories[&name].job;
            let others = files.directories.iter().filter(|(other, _)| **other != name);
            !others.map(|(_, other)| other).any(|other| other.job == number && other.begun.is_some())
        };
        let found = files.directories.get_mut(&name).expect("it has begun");
        found.is_running = false;
        let knows_at = away_until.max(now) + self.random.between(200, 900);
        if let Some((state, class, words)) = how.map(|how| ENDS[how]) {
            let words = self.slurm.dialect.as_ref().map_or(words, |dialect| dialect.last_words(class));
            found.log = (words.to_owned(), now);
            found.truth = Some(Err(class));
            self.tell(format!("job {id} of calculation {name} ends: {state}"));
            return self.at(knows_at, Event::Slurm(SlurmEvent::Known(id, state)));
        }
        let failure = Difficulty::of(self.slurm.seed, found.job).failure(&found.adjustments, is_first);
        let exit = match failure {
            None => ProgramExit::Code(0),
            Some(FailureClass::TimeLimit) => ProgramExit::TimeLimit,
            Some(FailureClass::OutOfMemory) => ProgramExit::OutOfMemory,
            Some(_) => ProgramExit::Code(1),
        };
        let energy = -found.job as f64 - self.random.below(100) as f64 / 1e3;
        found.shown = Some(failure.map_or(Ok(energy), Err));
        found.truth = Some(failure.map_or(Ok(()), Err));
        found.log.1 = now;
        found.is_damaged |= delay > SETTLE_TIME;
        let end = CalculationEnd {
            how: EndReason::Ended(exit),
            program: PathBuf::new(),
            seconds: 1.0,
            memory: 0,
            node: Some(node.to_owned()),
            remark: None,
        };
        found.end = Some((end, now, now + delay));
        drop(files);
        self.tell(format!("job {id} of calculation {name} ends: {failure:?}"));
        self.after(100, Event::Slurm(SlurmEvent::Known(id, "COMPLETING")));
        self.at(knows_at, Event::Slurm(SlurmEvent::Known(id, "COMPLETED")));
    }

    fn cancel_batch_job(&mut self, id: u64) {
        let now = self.now;
        let job = self.slurm.job(id);
        if job.is_over() || job.state == "COMPLETING" {
            return;
        }
        let (name, was_calculating) = (job.name.clone(), std::mem::take(&mut job.is_calculating));
        let is_waiting = job.state == "PENDING";
        job.state = "COMPLETING";
        if let Some(found) = self.slurm.files.borrow_mut().directories.get_mut(&name)
            && (was_calculating || is_waiting && found.begun.is_none())
        {
            found.is_running &= !was_calculating;
            found.truth = Some(Err(FailureClass::NodeFailure));
            found.log.1 = now;
        }
        self.tell(format!("job {id} of calculation {name} is cancelled"));
        let delay = if is_waiting { 0 } else { self.random.between(200, 3_000) };
        self.after(delay, Event::Slurm(SlurmEvent::Known(id, "CANCELLED")));
    }
}
