//! What a labeller does whose calculations are jobs: the shell around the decisions of `workers::labeller`, step by
//! step. It runs beside the renewal of the lease, and is dropped when the labeller turns to something else.
//!
//! It is a coroutine: it waits for the answer to one request after the other, which the world gives in virtual time.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::future::poll_fn;
use std::pin::Pin;
use std::rc::Rc;
use std::task::Poll;

use batch::{CommandOutput, JobId};
use dft::{Exit, FailureClass, RetryAdjustment};
use store::PastCalculation;
use store::records::Lease;
use workers::labeller::decisions::{
    CalculationEnd, CalculationState, EarlierStep, EndReason, failure_at, is_left_over,
};

use super::super::calculation::CalculationResult;
use super::super::fault::Time;
use super::super::planted::PlantedBug;
use super::dialect::Dialect;
use super::files::{CalculationFiles, DirectoryRemoval, SharedFiles};

/// Time between two tries of a submission.
pub(super) const RETRY_INTERVAL: Time = 3_000;
/// First and longest time between two looks at a directory.
pub(super) const POLL_INTERVALS: [Time; 2] = [400, 2_000];
/// First and longest time between two tries while Slurm accepts no job.
pub(super) const FULL_PAUSES: [Time; 2] = [2_000, 60_000];
/// Directories younger than this are not cleaned up.
const MIN_AGE: Time = 60_000;

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
    /// To another batch system: submit the job of this calculation under this number.
    Submit(String, u32),
    /// The state of the job with this id.
    Poll(JobId),
    /// Cancel the job with this id.
    Delete(JobId),
    /// What the store knows of the attempt that made a calculation.
    Past(i64, u32),
    /// The content of a directory is removed.
    Remove,
}

/// The answer.
#[derive(Clone, Debug)]
pub enum Answer {
    Done,
    /// Of a command; `None` if Slurm did not answer.
    Text(Option<String>),
    /// Slurm accepts no further job.
    Full,
    /// Of a command of another batch system.
    Output(CommandOutput),
    Past(Option<PastCalculation>),
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
pub(super) type Failing<T> = Result<T, String>;

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
    /// The batch system, if it is not Slurm.
    pub dialect: Option<Dialect>,
}

impl LabellerIo {
    pub(super) async fn request(&self, request: Request) -> Answer {
        self.exchange.borrow_mut().request = Some(request);
        poll_fn(|_| self.exchange.borrow_mut().answer.take().map_or(Poll::Pending, Poll::Ready)).await
    }

    pub(super) async fn sleep(&self, time: Time) {
        self.request(Request::Sleep(time)).await;
    }

    pub(super) async fn text(&self, request: Request) -> Option<String> {
        match self.request(request).await {
            Answer::Text(text) => text,
            Answer::Done | Answer::Full | Answer::Output(_) | Answer::Past(_) => None,
        }
    }

    pub(super) fn now(&self) -> Time {
        self.files.borrow().now
    }

    async fn inspect(&self, name: &str) -> Failing<CalculationState> {
        match &self.dialect {
            Some(dialect) => Ok(self.inspect_custom(dialect, name).await),
            None => self.inspect_slurm(name).await,
        }
    }

    async fn submit(&self, name: &str) -> Failing<()> {
        match &self.dialect {
            Some(dialect) => self.submit_custom(dialect, name).await,
            None => self.submit_slurm(name).await,
        }
    }

    async fn wait(&self, name: &str) -> Failing<Option<CalculationEnd>> {
        match &self.dialect {
            Some(dialect) => self.wait_custom(dialect, name).await,
            None => self.wait_slurm(name).await,
        }
    }

    /// Ends what is left of a calculation and removes its directory.
    async fn clear(&self, name: &str, why: DirectoryRemoval) -> Failing<()> {
        match &self.dialect {
            Some(dialect) => self.cancel_custom(dialect, name).await?,
            None => self.cancel_slurm(name).await?,
        }
        self.remove(name, why).await;
        Ok(())
    }

    /// Removes a directory. That takes a while, in which the labeller may be killed.
    async fn remove(&self, name: &str, why: DirectoryRemoval) {
        self.files.borrow_mut().begin_removal(name, why, self.bug);
        self.request(Request::Remove).await;
        self.files.borrow_mut().end_removal(name);
    }

    /// The newest of these calculations that can be waited for, and whether it must be submitted.
    async fn find(&self, earlier: &[String]) -> Failing<Option<(String, bool)>> {
        let mut named = BTreeSet::new();
        let mut found = None;
        for name in earlier.iter().map(|text| directory_of(text)).filter(|name| named.insert(*name)) {
            let state = self.inspect(name).await?;
            match state.of_earlier(found.is_some()) {
                EarlierStep::Leave => {}
                EarlierStep::Clear => {
                    self.clear(name, DirectoryRemoval::Lost { has_newer: found.is_some() }).await?
                }
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
            self.clear(&name, DirectoryRemoval::Lost { has_newer: false }).await?;
            return Ok(TaskEnd::Result(CalculationResult::Failure(FailureClass::NodeFailure), None));
        };
        let result = self.read(&name, &end);
        self.files.borrow_mut().check_result(&name, result.map(drop));
        let result = match result {
            Ok(energy) => CalculationResult::Label(energy),
            Err(FailureClass::OtherProgram) => {
                self.remove(&name, DirectoryRemoval::OtherProgram).await;
                return Err("another program has calculated".to_owned());
            }
            Err(class) => {
                use FailureClass::{Crashed, NodeFailure, OutOfMemory};
                if let (Crashed | NodeFailure | OutOfMemory, Some(node)) = (class, &end.node)
                    && self.dialect.is_none()
                {
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
        let made = self.now();
        let files =
            CalculationFiles { job: lease.job, made, adjustments, excluded, ..CalculationFiles::default() };
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

    /// Removes directories that killed labellers left and whose results are not needed.
    async fn clean_up(&self) -> Failing<()> {
        let old = self.files.borrow().older_than(MIN_AGE);
        for name in old {
            let (job, attempt) = name.split_once('.').expect("job and attempt");
            let (job, attempt) = (job.parse().expect("a number"), attempt.parse().expect("a number"));
            let Answer::Past(Some(past)) = self.request(Request::Past(job, attempt)).await else { continue };
            if past.wanted && self.bug != Some(PlantedBug::WantedRemoved) {
                continue;
            }
            let is_its = past.calculation.as_ref().is_some_and(|text| directory_of(text) == name);
            let state = if is_its { Some(self.inspect(&name).await?) } else { None };
            let past = match self.bug {
                Some(PlantedBug::WantedRemoved) => PastCalculation { wanted: false, ..past },
                _ => past,
            };
            if is_left_over(&past, state.as_ref()) {
                self.remove(&name, DirectoryRemoval::LeftOver).await;
            }
        }
        Ok(())
    }

    /// Makes a label. A labeller `cleans` up before its first one.
    pub async fn label(
        self,
        lease: Box<Lease>,
        adjustments: BTreeSet<RetryAdjustment>,
        cleans: bool,
    ) -> TaskEnd {
        if cleans && let Err(why) = self.clean_up().await {
            return TaskEnd::LabellerFails(why);
        }
        self.make(lease, adjustments).await.unwrap_or_else(TaskEnd::LabellerFails)
    }

    /// Ends a calculation that is no longer needed.
    pub async fn stop(self, name: String) -> TaskEnd {
        match self.clear(&name, DirectoryRemoval::NotNeeded).await {
            Ok(()) => TaskEnd::Cleared,
            Err(why) => TaskEnd::LabellerFails(why),
        }
    }
}

/// The directory of a calculation, as an attempt recorded it, perhaps with the node where it failed.
fn directory_of(record: &str) -> &str {
    record.split('@').next().unwrap_or(record)
}
