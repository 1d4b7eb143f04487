//! A stand-in for Slurm: its queue, nodes and daemon, with commands that take time, are refused or lose their replies. It
//! answers in the words of `squeue`, which the labeller's own parser reads.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::PathBuf;
use std::rc::Rc;
use std::task::{Context, Poll, Waker};

use dft::{Exit as ProgramExit, FailureClass, RetryAdjustment};
use store::CalculationRecord;
use store::records::Lease;
use workers::labeller::decisions::{CalculationEnd, EndReason};

use super::fault::{ClientKind, Time};
use super::ladder::{Difficulty, Ladders};
use super::random::Random;
use super::slurm_files::{SETTLE_TIME, SharedFiles};
use super::slurm_labeller::{Answer, Exchange, LabellerIo, Request, SQUEUE_INTERVAL, SlurmTask, TaskEnd};
use super::world::{Event, Exit, World};

const NODES: [&str; 3] = ["n1", "n2", "n3"];
/// Time between two tries to begin a job that waits for another one, or for Slurm.
const SCHEDULING_INTERVAL: Time = 1_000;
/// A command whose reply is lost fails after this time.
const REPLY_TIMEOUT: Time = 10_000;
/// Time between two tries of a write while the database is busy or the disk full.
const STORE_RETRY_INTERVAL: Time = 1_000;
/// States of jobs that end without a word of their runner, with what Slurm writes into the job's log.
const ENDS: [(&str, FailureClass, &str); 7] = [
    (
        "TIMEOUT",
        FailureClass::TimeLimit,
        "slurmstepd: error: *** JOB 1 ON n1 CANCELLED AT now DUE TO TIME LIMIT ***",
    ),
    (
        "OUT_OF_MEMORY",
        FailureClass::OutOfMemory,
        "slurmstepd: error: Detected 1 oom_kill event in StepId=1.batch.",
    ),
    (
        "FAILED",
        FailureClass::OutOfMemory,
        "slurmstepd: error: StepId=1.batch exceeded memory limit (2 > 1), being killed",
    ),
    (
        "NODE_FAIL",
        FailureClass::NodeFailure,
        "slurmstepd: error: *** JOB 1 ON n1 CANCELLED AT now DUE TO NODE FAILURE ***",
    ),
    ("CANCELLED", FailureClass::NodeFailure, "slurmstepd: error: *** JOB 1 ON n1 CANCELLED AT now ***"),
    (
        "PREEMPTED",
        FailureClass::NodeFailure,
        "slurmstepd: error: *** JOB 1 ON n1 CANCELLED AT now DUE TO PREEMPTION ***",
    ),
    ("FAILED", FailureClass::NodeFailure, "Killed"),
];

/// What goes wrong with Slurm and its nodes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SlurmFault {
    /// slurmctld does not answer. Jobs go on, and their ends are known later.
    Away { until: Time },
    /// The queue is full.
    Full { until: Time },
    /// The reply to the next `sbatch` is lost: there is a job all the same.
    ReplyLost,
    /// A labeller is killed during its next `sbatch`, which submits the job later.
    LateSubmission { delay: Time },
    /// A job ends, in one of the ways of [`ENDS`].
    JobEnds { how: usize },
    /// A job that waits is cancelled.
    WaitingJobCancelled,
    /// What nodes write is seen much later.
    FilesLate { until: Time },
    /// The directory of a calculation is removed.
    DirectoryRemoved,
}

impl SlurmFault {
    pub fn draw(random: &mut Random, until: Time) -> Self {
        match random.below(16) {
            0..3 => Self::Away { until },
            3 => Self::Full { until },
            4..6 => Self::ReplyLost,
            6..9 => Self::LateSubmission { delay: random.between(2_000, 12_000) },
            9..12 => Self::JobEnds { how: random.below(ENDS.len() as u64) as usize },
            12 => Self::WaitingJobCancelled,
            13..15 => Self::FilesLate { until },
            _ => Self::DirectoryRemoved,
        }
    }

    pub fn end(&self, at: Time) -> Time {
        match self {
            Self::Away { until } | Self::Full { until } | Self::FilesLate { until } => *until,
            _ => at,
        }
    }
}

impl fmt::Display for SlurmFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = |time: &Time| *time as f64 / 1000.0;
        match self {
            Self::Away { until } => write!(f, "Slurm does not answer until {} s", seconds(until)),
            Self::Full { until } => write!(f, "Slurm accepts no job until {} s", seconds(until)),
            Self::ReplyLost => f.write_str("the reply to the next sbatch will be lost"),
            Self::LateSubmission { delay } => write!(
                f,
                "a labeller will be killed during its next sbatch, which submits the job {} s later",
                seconds(delay)
            ),
            Self::JobEnds { how } => write!(f, "a job ends as {}", ENDS[*how].0),
            Self::WaitingJobCancelled => f.write_str("a job that waits is cancelled"),
            Self::FilesLate { until } => {
                write!(f, "files of nodes are seen late until {} s", seconds(until))
            }
            Self::DirectoryRemoved => f.write_str("the directory of a calculation is removed"),
        }
    }
}

/// What happens at Slurm, and to labellers that use it.
#[derive(Clone, Debug)]
pub enum SlurmEvent {
    /// An `sbatch` arrives; its reply goes to this request of a labeller.
    Submitted {
        name: String,
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
    pub fn new(seed: u64) -> Self {
        Self {
            seed,
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

    pub fn remove_directory(&mut self, name: &str) {
        self.files.borrow_mut().remove(name);
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
                    let sentence = format!("the directory of {name} is gone");
                    drop(files);
                    self.tell(sentence);
                }
            }
        }
    }

    pub fn slurm_event(&mut self, event: SlurmEvent) {
        match event {
            SlurmEvent::Submitted { name, excluded, client, replies } => {
                self.job_is_submitted(name, excluded, client, replies);
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
        name: String,
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
            self.tell(format!("Slurm has job {id}, of calculation {name}"));
            let job = BatchJob {
                id,
                name,
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
        let (reply, delay) = match replies {
            true => (reply, self.random.between(20, 300)),
            false => (Answer::Text(None), REPLY_TIMEOUT),
        };
        self.after(delay, Event::Slurm(SlurmEvent::Answer(client.0, client.1, reply)));
    }

    /// A job gets its node, unless another one of its name is unfinished.
    fn batch_job_begins(&mut self, id: u64) {
        let (now, is_away) = (self.now, self.is_slurm_away());
        let BatchJob { ref name, state, ref excluded, .. } = *self.slurm.job(id);
        if state != "PENDING" {
            return;
        }
        let (name, excluded) = (name.clone(), excluded.clone());
        let is_earlier = |job: &BatchJob| job.name == name && job.id < id && !job.is_over();
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
        if found.is_removed || found.begun.is_some() {
            job.state = if found.is_removed { "FAILED" } else { "COMPLETED" };
            job.ended = Some(now);
            return self.tell(format!("job {id} does nothing"));
        }
        (job.state, job.is_calculating) = ("RUNNING", true);
        (found.begun, found.is_running) = (Some((now, now + delay)), true);
        found.is_damaged |= delay > SETTLE_TIME;
        let number = found.job;
        let longest = if self.random.happens(30) { 40_000 } else { 15_000 };
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

    /// A labeller begins to make a label.
    pub fn begin_slurm_label(&mut self, id: u32, lease: Box<Lease>, adjustments: BTreeSet<RetryAdjustment>) {
        let io = self.labeller_io();
        let exchange = Rc::clone(&io.exchange);
        self.begin_task(id, SlurmTask { future: Box::pin(io.label(lease, adjustments)), exchange, token: 0 });
    }

    /// A labeller ends a calculation that is no longer needed.
    pub fn begin_slurm_stop(&mut self, id: u32, calculation: String) {
        let io = self.labeller_io();
        let exchange = Rc::clone(&io.exchange);
        self.begin_task(id, SlurmTask { future: Box::pin(io.stop(calculation)), exchange, token: 0 });
    }

    fn labeller_io(&self) -> LabellerIo {
        LabellerIo {
            exchange: Rc::new(RefCell::new(Exchange::default())),
            files: Rc::clone(&self.slurm.files),
            bug: self.bug,
        }
    }

    fn begin_task(&mut self, id: u32, task: SlurmTask) {
        self.slurm.tasks.insert(id, task);
        self.task_continues(id, None);
    }

    /// Gives a labeller the answer to its request, until its next one.
    fn task_continues(&mut self, id: u32, answer: Option<Answer>) {
        let Some(mut task) = self.slurm.tasks.remove(&id) else { return };
        *task.exchange.borrow_mut() = Exchange { request: None, answer };
        self.slurm.files.borrow_mut().now = self.now;
        let polled = task.future.as_mut().poll(&mut Context::from_waker(Waker::noop()));
        let broken = self.slurm.files.borrow_mut().broken.take();
        if let Some(broken) = broken {
            return self.fail(broken);
        }
        match polled {
            Poll::Ready(end) => self.labeller_task_ends(id, end),
            Poll::Pending => {
                let request = task.exchange.borrow_mut().request.take().expect("it waits for an answer");
                self.slurm.next_token += 1;
                task.token = self.slurm.next_token;
                let token = task.token;
                self.slurm.tasks.insert(id, task);
                self.fulfil(id, token, request);
            }
        }
    }

    /// Does what a labeller requests; the answer comes later.
    fn fulfil(&mut self, id: u32, token: u64, request: Request) {
        let (now, is_away) = (self.now, self.is_slurm_away());
        let delay = if is_away { self.random.between(500, 5_000) } else { self.random.between(20, 500) };
        let (answer, delay) = match request {
            Request::Sleep(time) => (Answer::Done, time),
            Request::Ask(_) | Request::List | Request::Cancel(_) if is_away && !self.has_list(&request) => {
                (Answer::Text(None), delay)
            }
            Request::Ask(name) => {
                let jobs = self.slurm.known(now).filter(|job| job.name == name);
                (Answer::Text(Some(jobs.map(|job| job.line(now) + "\n").collect())), delay)
            }
            Request::List => (Answer::Text(Some(self.list_of_jobs())), delay),
            Request::Cancel(ids) => {
                ids.into_iter().for_each(|id| self.cancel_batch_job(id));
                (Answer::Text(Some(String::new())), delay)
            }
            Request::Sbatch(name) => return self.labeller_submits(id, token, name),
            Request::Take(calculation) => {
                self.labeller_takes(id, calculation);
                (Answer::Done, 0)
            }
            Request::Record(ref calculation) => match self.labeller_writes_calculation(id, calculation) {
                Ok(()) => (Answer::Done, 1),
                Err(error) if error.is_transient() => {
                    let again = SlurmEvent::Repeats(id, token, request);
                    return self.after(STORE_RETRY_INTERVAL, Event::Slurm(again));
                }
                Err(error) => return self.fail(format!("labeller process {id} fails: {error}")),
            },
        };
        self.after(delay, Event::Slurm(SlurmEvent::Answer(id, token, answer)));
    }

    fn has_list(&self, request: &Request) -> bool {
        let recent = |made: Time| self.now < made + SQUEUE_INTERVAL;
        matches!(request, Request::List) && self.slurm.list.as_ref().is_some_and(|(made, _)| recent(*made))
    }

    /// The list that labellers share, made again if it is old.
    fn list_of_jobs(&mut self) -> String {
        if !self.has_list(&Request::List) {
            let unfinished = self.slurm.jobs.iter().filter(|job| !job.is_over());
            let names: Vec<_> = unfinished.map(|job| job.name.as_str()).collect();
            self.slurm.list = Some((self.now, names.join("\n")));
        }
        self.slurm.list.as_ref().map(|(_, names)| names.clone()).unwrap_or_default()
    }

    /// `sbatch` is under way; it goes on if its labeller is killed.
    fn labeller_submits(&mut self, id: u32, token: u64, name: String) {
        let trouble =
            (!self.slurm.next_submissions.is_empty()).then(|| self.slurm.next_submissions.remove(0));
        let late = match trouble {
            Some(SlurmFault::LateSubmission { delay }) => Some(delay),
            _ => None,
        };
        let excluded = match self.slurm.files.borrow().directories.get(&name) {
            Some(found) if !found.is_removed => Some(found.excluded.clone()),
            _ => None,
        };
        let event = match excluded {
            Some(excluded) => {
                let replies = trouble != Some(SlurmFault::ReplyLost);
                SlurmEvent::Submitted { name, excluded, client: (id, token), replies }
            }
            // There is no script.
            None => SlurmEvent::Answer(id, token, Answer::Text(None)),
        };
        let delay = late.unwrap_or_else(|| self.random.between(50, 500));
        self.after(delay, Event::Slurm(event));
        if late.is_some() {
            self.labeller_exits(id, Exit::Killed);
        }
    }

    fn labeller_writes_calculation(&mut self, id: u32, calculation: &str) -> Result<(), store::StoreError> {
        let Some(lease) = self.lease_of(id) else { return Ok(()) };
        let made = CalculationRecord { cores: Some(1), ..CalculationRecord::default() };
        self.store.write(self.now, ClientKind::Labeller, "a calculation is recorded", async |store| {
            store.record_calculation(&lease, calculation, &made).await
        })
    }

    fn labeller_task_ends(&mut self, id: u32, end: TaskEnd) {
        match end {
            TaskEnd::Result(result, calculation) => self.labeller_has_result(id, result, calculation),
            TaskEnd::Cleared => self.labeller_is_idle(id),
            TaskEnd::LabellerFails(why) => {
                self.tell(format!("labeller process {id} cannot go on: {why}"));
                self.labeller_fails(id);
            }
        }
    }
}
