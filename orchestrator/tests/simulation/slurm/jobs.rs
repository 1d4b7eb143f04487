//! Jobs of the batch system: how they are submitted, begin, end and are cancelled.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::rc::Rc;

use dft::{Exit as ProgramExit, FailureClass};
use workers::labeller::decisions::{CalculationEnd, EndReason};

use super::super::event::Event;
use super::super::fault::Time;
use super::super::ladder::Difficulty;
use super::super::world::World;
use super::SlurmEvent;
use super::dialect::Dialect;
use super::fault::ENDS;
use super::files::SETTLE_TIME;
use super::labeller::Answer;

const NODES: [&str; 3] = ["n1", "n2", "n3"];
/// Time between two tries to begin a job that waits for another one, or for Slurm.
const SCHEDULING_INTERVAL: Time = 1_000;
/// A command whose reply is lost fails after this time.
const REPLY_TIMEOUT: Time = 10_000;

/// A job.
pub struct BatchJob {
    pub id: u64,
    /// That of its directory.
    pub name: String,
    submission: u32,
    excluded: BTreeSet<String>,
    pub state: &'static str,
    node: &'static str,
    begun: Time,
    /// When Slurm knew that it had ended.
    pub ended: Option<Time>,
    /// It calculates now: a job whose calculation another one has begun does nothing.
    pub is_calculating: bool,
}

impl BatchJob {
    pub fn is_over(&self) -> bool {
        self.ended.is_some()
    }

    /// As `squeue` shows it.
    pub fn line(&self, now: Time) -> String {
        let seconds = match (self.state, self.ended) {
            ("PENDING", _) => 0,
            (_, ended) => ended.unwrap_or(now).saturating_sub(self.begun) / 1000,
        };
        let (id, state, node) = (self.id, self.state, self.node);
        format!("{id}|{state}|{node}|{}:{:02}|None", seconds / 60, seconds % 60)
    }
}

impl World {
    pub(super) fn job_is_submitted(
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
    pub(super) fn batch_job_begins(&mut self, id: u64) {
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
    pub(super) fn batch_job_ends(&mut self, id: u64, how: Option<usize>) {
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

    pub(super) fn cancel_batch_job(&mut self, id: u64) {
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
