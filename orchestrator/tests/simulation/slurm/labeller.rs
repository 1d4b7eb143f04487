//! What a labeller does whose calculations are Slurm jobs: the shell around the decisions of `workers::labeller`, step by
//! step. It runs beside the renewal of the lease, and is dropped when the labeller turns to something else.
//!
//! It is a coroutine: it waits for the answer to one request after the other, which the world gives in virtual time.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::future::poll_fn;
use std::pin::Pin;
use std::rc::Rc;
use std::task::Poll;

use dft::{Exit, FailureClass, RetryAdjustment};
use store::records::Lease;
use workers::labeller::decisions::{
    CalculationEnd, CalculationState, EarlierStep, EndReason, Inspection, InspectionStep, JobDirectory,
    SqueueJob, SubmissionRetry, SubmissionStep, Traces, WaitStep, failure_at, infer_end, is_listed,
    jobs_to_cancel,
};

use super::super::calculation::CalculationResult;
use super::super::fault::Time;
use super::super::planted::PlantedBug;
use super::files::{CalculationFiles, SETTLE_TIME, SharedFiles};

/// Time between two questions to Slurm.
pub const SQUEUE_INTERVAL: Time = 20_000;
/// Time between two tries of a submission.
const RETRY_INTERVAL: Time = 3_000;
/// First and longest time between two looks at a directory.
const POLL_INTERVALS: [Time; 2] = [400, 2_000];
/// First and longest time between two tries while Slurm accepts no job.
const FULL_PAUSES: [Time; 2] = [2_000, 60_000];
/// How long a cancelled job may take to end.
const CANCEL_TIMEOUT: Time = 5_000;

/// What a labeller waits for.
#[derive(Clone, Debug)]
pub enum Request {
    Sleep(Time),
    /// Every job of this name.
    Ask(String),
    /// The names of all unfinished jobs, which labellers share.
    List,
    Sbatch(String),
    Cancel(Vec<u64>),
    /// The store records this calculation with the attempt.
    Record(String),
    /// The labeller waits for this calculation from now on.
    Take(String),
}

/// The answer.
#[derive(Clone, Debug)]
pub enum Answer {
    Done,
    /// Of a command; `None` if Slurm did not answer.
    Text(Option<String>),
    /// Slurm accepts no further job.
    Full,
}

/// How it ends.
pub enum TaskEnd {
    /// With a result, and the calculation whose directory is removed then.
    Result(CalculationResult, Option<String>),
    /// Nothing is left of a calculation that was not needed.
    Cleared,
    /// The labeller cannot go on.
    LabellerFails(String),
}

/// Why a labeller cannot go on.
type Failing<T> = Result<T, String>;

/// A task of a labeller.
pub struct SlurmTask {
    pub future: Pin<Box<dyn Future<Output = TaskEnd>>>,
    pub exchange: Rc<RefCell<Exchange>>,
    /// Answers to earlier requests mean nothing.
    pub token: u64,
}

/// The request that waits, or its answer.
#[derive(Default)]
pub struct Exchange {
    pub request: Option<Request>,
    pub answer: Option<Answer>,
}

/// What a task reaches.
#[derive(Clone)]
pub struct LabellerIo {
    pub exchange: Rc<RefCell<Exchange>>,
    pub files: Rc<RefCell<SharedFiles>>,
    pub bug: Option<PlantedBug>,
}

impl LabellerIo {
    async fn request(&self, request: Request) -> Answer {
        self.exchange.borrow_mut().request = Some(request);
        poll_fn(|_| self.exchange.borrow_mut().answer.take().map_or(Poll::Pending, Poll::Ready)).await
    }

    async fn sleep(&self, time: Time) {
        self.request(Request::Sleep(time)).await;
    }

    async fn text(&self, request: Request) -> Option<String> {
        match self.request(request).await {
            Answer::Text(text) => text,
            Answer::Done | Answer::Full => None,
        }
    }

    fn now(&self) -> Time {
        self.files.borrow().now
    }

    fn look(&self, name: &str) -> JobDirectory {
        match self.files.borrow().look(name) {
            JobDirectory::Own { end, .. } if self.bug == Some(PlantedBug::BegunOverlooked) => {
                JobDirectory::Own { begun: false, end }
            }
            found => found,
        }
    }

    async fn ask(&self, name: &str) -> Option<Vec<SqueueJob>> {
        let text = self.text(Request::Ask(name.to_owned())).await?;
        Some(SqueueJob::parse_all(&text).expect("lines of squeue"))
    }

    /// Asks until Slurm answers.
    async fn jobs(&self, name: &str) -> Vec<SqueueJob> {
        loop {
            match self.ask(name).await {
                Some(jobs) => return jobs,
                None if self.bug == Some(PlantedBug::SilenceTakenAsGone) => return Vec::new(),
                None => self.sleep(SQUEUE_INTERVAL).await,
            }
        }
    }

    /// As [`workers::labeller`] inspects a Slurm job.
    async fn inspect(&self, name: &str) -> Failing<CalculationState> {
        let mut inspection = Inspection::default();
        let first = match self.look(name) {
            JobDirectory::Own { end: None, .. } if self.bug == Some(PlantedBug::OldAnswerBelieved) => {
                JobDirectory::Own { begun: true, end: None }
            }
            found => found,
        };
        let mut step = inspection.looked(first);
        loop {
            step = match step {
                InspectionStep::Ask => inspection.answered(self.jobs(name).await),
                InspectionStep::Settle => {
                    if self.bug != Some(PlantedBug::FilesBelievedAtOnce) {
                        self.sleep(SETTLE_TIME).await;
                    }
                    inspection.looked(self.look(name))
                }
                InspectionStep::InferEnd(reported) => {
                    let end = match self.bug {
                        Some(PlantedBug::EndsMixedUp) => infer_end(None, &Traces::default()),
                        _ => infer_end(reported.as_ref(), &self.files.borrow().traces(name)),
                    };
                    self.files.borrow_mut().record_inferred(name, end.clone());
                    return Ok(CalculationState::Ended(end));
                }
                InspectionStep::Is(state) => return Ok(state),
                InspectionStep::NotVisible(why) => return Err(why),
            };
        }
    }

    async fn submit(&self, name: &str) -> Failing<()> {
        let (mut retry, mut pause) = (SubmissionRetry::default(), FULL_PAUSES[0]);
        loop {
            match self.request(Request::Sbatch(name.to_owned())).await {
                Answer::Text(Some(_)) => return Ok(()),
                Answer::Full => {
                    self.sleep(pause).await;
                    pause = (2 * pause).min(FULL_PAUSES[1]);
                    continue;
                }
                Answer::Text(None) | Answer::Done => {}
            }
            let (jobs, exists) = (self.jobs(name).await, self.look(name) != JobDirectory::Missing);
            let permit = || Ok::<_, String>(self.files.borrow_mut().permit_all_nodes(name));
            match retry.failed(&jobs, exists, permit)? {
                SubmissionStep::Wait => return Ok(()),
                SubmissionStep::Again => self.sleep(RETRY_INTERVAL).await,
                SubmissionStep::Refused => return Err(format!("Slurm refuses {name}")),
            }
        }
    }

    async fn wait(&self, name: &str) -> Failing<Option<CalculationEnd>> {
        let (mut pause, mut asked) = (POLL_INTERVALS[0], self.now());
        loop {
            if let JobDirectory::Own { end: Some(end), .. } = self.look(name) {
                return Ok(Some(end));
            }
            if self.now() - asked >= SQUEUE_INTERVAL {
                let mut names = self.text(Request::List).await;
                if self.bug == Some(PlantedBug::SilenceTakenAsGone) {
                    names.get_or_insert_default();
                }
                if !is_listed(names.as_deref(), name) {
                    match self.inspect(name).await?.while_waiting() {
                        WaitStep::Read(end) => return Ok(Some(end)),
                        WaitStep::Submit => {
                            self.files.borrow_mut().check_not_begun(name);
                            self.submit(name).await?;
                        }
                        WaitStep::Wait => {}
                        WaitStep::Abandon => return Ok(None),
                    }
                }
                asked = self.now();
            }
            self.sleep(pause).await;
            pause = (pause * 5 / 4).min(POLL_INTERVALS[1]);
        }
    }

    /// Ends what is left of a calculation and removes its directory.
    async fn clear(&self, name: &str) -> Failing<()> {
        let away = || "Slurm does not answer".to_owned();
        let started = self.now();
        loop {
            let jobs = self.ask(name).await.ok_or_else(away)?;
            let ids: Vec<_> = jobs_to_cancel(&jobs).iter().filter_map(|id| id.number()).collect();
            if !ids.is_empty() {
                self.text(Request::Cancel(ids)).await.ok_or_else(away)?;
            }
            if jobs.iter().all(SqueueJob::is_over) || self.now() - started > CANCEL_TIMEOUT {
                break;
            }
            self.sleep(200).await;
        }
        self.files.borrow_mut().remove(name);
        Ok(())
    }

    /// The newest of these calculations that can be waited for, and whether it must be submitted.
    async fn find(&self, earlier: &[String]) -> Failing<Option<(String, bool)>> {
        let mut named = BTreeSet::new();
        let mut found = None;
        for name in earlier.iter().map(|text| directory_of(text)).filter(|name| named.insert(*name)) {
            let state = self.inspect(name).await?;
            match state.of_earlier(found.is_some()) {
                EarlierStep::Leave => {}
                EarlierStep::Clear => self.clear(name).await?,
                EarlierStep::Take => {
                    let is_ready = state == CalculationState::Ready;
                    if is_ready {
                        self.files.borrow_mut().check_not_begun(name);
                    }
                    found = Some((name.to_owned(), is_ready));
                }
            }
        }
        Ok(found)
    }

    async fn make(self, lease: Box<Lease>, adjustments: BTreeSet<RetryAdjustment>) -> Failing<TaskEnd> {
        let (name, is_ready) = match self.find(&lease.earlier_calculations).await? {
            Some((name, is_ready)) => {
                self.request(Request::Take(name.clone())).await;
                self.request(Request::Record(name.clone())).await;
                (name, is_ready)
            }
            None => {
                let name = format!("{}.{}", lease.job, lease.attempt);
                self.prepare(&name, &lease, adjustments);
                self.request(Request::Record(name.clone())).await;
                self.request(Request::Take(name.clone())).await;
                (name, true)
            }
        };
        if is_ready {
            self.submit(&name).await?;
        }
        let Some(end) = self.wait(&name).await? else {
            self.clear(&name).await?;
            return Ok(TaskEnd::Result(CalculationResult::Failure(FailureClass::NodeFailure), None));
        };
        let result = self.read(&name, &end);
        self.files.borrow_mut().check_result(&name, result.map(drop));
        let result = match result {
            Ok(energy) => CalculationResult::Label(energy),
            Err(FailureClass::OtherProgram) => {
                self.files.borrow_mut().remove(&name);
                return Err("another program has calculated".to_owned());
            }
            Err(class) => {
                use FailureClass::{Crashed, NodeFailure, OutOfMemory};
                if let (Crashed | NodeFailure | OutOfMemory, Some(node)) = (class, &end.node) {
                    self.request(Request::Record(format!("{name}@{node}"))).await;
                }
                CalculationResult::Failure(class)
            }
        };
        Ok(TaskEnd::Result(result, Some(name)))
    }

    /// Makes the directory of a new calculation.
    fn prepare(&self, name: &str, lease: &Lease, adjustments: BTreeSet<RetryAdjustment>) {
        let failed = lease.failed_calculations.iter().filter_map(|text| text.split_once('@'));
        let excluded = match adjustments.contains(&RetryAdjustment::OtherNode) {
            true => failed.map(|(_, node)| node.to_owned()).collect(),
            false => BTreeSet::new(),
        };
        let files = CalculationFiles { job: lease.job, adjustments, excluded, ..CalculationFiles::default() };
        self.files.borrow_mut().directories.insert(name.to_owned(), files);
    }

    /// The energy in the files of a calculation that ended so.
    fn read(&self, name: &str, end: &CalculationEnd) -> Result<f64, FailureClass> {
        let EndReason::Ended(exit) = end.how else { return Err(FailureClass::Crashed) };
        let files = self.files.borrow();
        let shown = files.directories[name].shown.unwrap_or(Err(FailureClass::Crashed));
        let failed = |class: FailureClass| failure_at(exit, class.with_message("as its files show")).class;
        match exit {
            Exit::Code(0) => shown.map_err(failed),
            _ => Err(failed(shown.err().unwrap_or(FailureClass::Crashed))),
        }
    }

    /// Makes a label.
    pub async fn label(self, lease: Box<Lease>, adjustments: BTreeSet<RetryAdjustment>) -> TaskEnd {
        self.make(lease, adjustments).await.unwrap_or_else(TaskEnd::LabellerFails)
    }

    /// Ends a calculation that is no longer needed.
    pub async fn stop(self, name: String) -> TaskEnd {
        match self.clear(&name).await {
            Ok(()) => TaskEnd::Cleared,
            Err(why) => TaskEnd::LabellerFails(why),
        }
    }
}

/// The directory of a calculation, as an attempt recorded it, perhaps with the node where it failed.
fn directory_of(record: &str) -> &str {
    record.split('@').next().unwrap_or(record)
}
