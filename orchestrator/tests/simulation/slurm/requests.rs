//! What labellers that use Slurm request, and the answers of the world.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::rc::Rc;
use std::task::{Context, Poll, Waker};

use batch::{CommandOutput, JobId};
use dft::RetryAdjustment;
use store::CalculationRecord;
use store::records::Lease;

use super::super::event::{Event, Exit};
use super::super::fault::{ClientKind, Time};
use super::super::world::World;
use super::files::DirectoryRemoval;
use super::labeller::{Answer, Exchange, LabellerIo, Request, SlurmTask, TaskEnd};
use super::slurm_labeller::SQUEUE_INTERVAL;
use super::{SlurmEvent, SlurmFault};

/// Time between two tries of a write while the database is busy or the disk full.
const STORE_RETRY_INTERVAL: Time = 1_000;

impl World {
    /// A labeller begins to make a label.
    pub fn begin_slurm_label(
        &mut self,
        id: u32,
        lease: Box<Lease>,
        adjustments: BTreeSet<RetryAdjustment>,
        cleans: bool,
    ) {
        let io = self.labeller_io();
        let exchange = Rc::clone(&io.exchange);
        self.begin_task(
            id,
            SlurmTask { future: Box::pin(io.label(lease, adjustments, cleans)), exchange, token: 0 },
        );
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
            dialect: self.slurm.dialect.clone(),
        }
    }

    fn begin_task(&mut self, id: u32, task: SlurmTask) {
        self.slurm.tasks.insert(id, task);
        self.task_continues(id, None);
    }

    /// Gives a labeller the answer to its request, until its next one.
    pub(super) fn task_continues(&mut self, id: u32, answer: Option<Answer>) {
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
    pub(super) fn fulfil(&mut self, id: u32, token: u64, request: Request) {
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
            Request::Sbatch(name) => return self.labeller_submits(id, token, (name, 0)),
            Request::Submit(name, number) => return self.labeller_submits(id, token, (name, number)),
            Request::Poll(ref job) | Request::Delete(ref job) => {
                let deletes = matches!(request, Request::Delete(_));
                (self.ask_about(job, deletes), delay)
            }
            Request::Past(job, attempt) => {
                let past = self.store.read(now, async |store| store.past_calculation(job, attempt).await);
                match past {
                    Ok(past) => {
                        self.note_unwanted(job, attempt);
                        (Answer::Past(past), 1)
                    }
                    Err(_) => {
                        let again = SlurmEvent::Repeats(id, token, request);
                        return self.after(STORE_RETRY_INTERVAL, Event::Slurm(again));
                    }
                }
            }
            Request::Remove if self.is_killed_in_removal(id) => return,
            Request::Remove => (Answer::Done, delay),
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

    /// A labeller removes the directory of a calculation whose result is delivered.
    pub fn remove_directory(&mut self, labeller: u32, calculation: &str) {
        let mut files = self.slurm.files.borrow_mut();
        files.begin_removal(calculation, DirectoryRemoval::Delivered, self.bug);
        let broken = files.broken.take();
        drop(files);
        broken.into_iter().for_each(|broken| self.fail(broken));
        if !self.is_killed_in_removal(labeller) {
            self.slurm.files.borrow_mut().end_removal(calculation);
            self.labeller_is_idle(labeller);
        }
    }

    /// Kills a labeller that removes a directory, if a fault asks for it.
    fn is_killed_in_removal(&mut self, labeller: u32) -> bool {
        let is_killed = std::mem::take(&mut self.slurm.kills_in_removal);
        if is_killed {
            self.labeller_exits(labeller, Exit::Killed);
        }
        is_killed
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

    /// Notes whether the job of a calculation is over, for what must hold when the directory is removed.
    fn note_unwanted(&mut self, job: i64, attempt: u32) {
        let (open,): (i64,) = self
            .ask(&format!("SELECT count(*) FROM job WHERE number = {job} AND state IN ('queued', 'leased')"));
        let mut files = self.slurm.files.borrow_mut();
        if let Some(found) = files.directories.get_mut(&format!("{job}.{attempt}")) {
            found.is_unwanted = open == 0;
        }
    }

    /// Asks another batch system for the state of a job, or cancels the job.
    fn ask_about(&mut self, id: &JobId, deletes: bool) -> Answer {
        let dialect = self.slurm.dialect.clone().expect("another batch system");
        if self.is_slurm_away() {
            return if self.random.happens(50) {
                Answer::Text(None)
            } else {
                Answer::Output(dialect.unreachable())
            };
        }
        let (now, number) = (self.now, dialect.number(id));
        if deletes {
            self.cancel_batch_job(number);
            return Answer::Output(CommandOutput { success: true, ..CommandOutput::default() });
        }
        let state = self.slurm.known(now).find(|job| job.id == number).map(|job| job.state);
        Answer::Output(dialect.state(number, state))
    }

    /// A submission is under way; it goes on if its labeller is killed.
    fn labeller_submits(&mut self, id: u32, token: u64, (name, submission): (String, u32)) {
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
                SlurmEvent::Submitted { name, submission, excluded, client: (id, token), replies }
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
