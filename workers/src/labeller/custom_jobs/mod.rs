//! A calculation as a job of a custom batch system.
//!
//! Its directory, which every node sees, contains everything it needs, and a note of each submission that is made before the job is
//! submitted. Of several submissions, only the one that creates the link [`job::BEGUN`] calculates: a job submitted twice because
//! an answer was lost is calculated once.
//!
//! The runner records the end, as for local calculations. The batch system is asked rarely, only to find jobs that can no longer record
//! their end; while it does not answer, nothing is concluded.

mod end;
mod job;
mod script;

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ::batch::{CustomClient, CustomError, CustomScheduler, PolledState};
use dft::PassedEnvironment;
use store::StoreError;
use tokio::time::sleep;
use tracing::{info, warn};

use super::batch_job::{
    CANCEL_TIMEOUT, COMMAND_TIMEOUT, MAX_POLL_INTERVAL, MAX_REFUSALS, MIN_POLL_INTERVAL, RETRY_INTERVAL,
    SCRATCH_NOT_SHARED, own_user, settle,
};
use super::calculation_runner::{Calculation, CalculationEnd};
use super::calculation_state::{CalculationState, WaitStep};
use super::file_error::file_error;
use super::private_directory;
use job::{JobSubmission, MAX_SUBMISSIONS};

pub(super) use job::CustomJob;

/// Time between two questions to the batch system about a job.
const QUESTION_INTERVAL: Duration = Duration::from_secs(30);
/// A batch system may not know a job for this long after it was submitted.
const NOT_YET_KNOWN: Duration = Duration::from_secs(60);
/// A job whose id was lost is over this long after its time limit.
const LOST_MARGIN: Duration = Duration::from_secs(600);

/// Access to a custom batch system for calculations.
pub(super) struct CustomJobs {
    client: CustomClient,
    /// Whether it accepts no further jobs, and that was logged.
    is_full: AtomicBool,
}

impl CustomJobs {
    /// The commands, with the variables that programs get: a batch system may pass its environment to the job.
    pub fn new(scheduler: CustomScheduler, passed: &PassedEnvironment) -> Self {
        let client = CustomClient::new(scheduler, COMMAND_TIMEOUT);
        let client = client.with_environment(passed.from_current_process().collect());
        Self { client, is_full: AtomicBool::new(false) }
    }

    /// Writes what the job of a calculation needs into its directory.
    pub fn prepare(&self, calculation: Calculation, cores: u32, gpus: u32) -> io::Result<CustomJob> {
        let job = CustomJob {
            scheduler: self.client.scheduler().name.clone(),
            directory: calculation.directory.clone(),
            user: own_user(),
            time_limit: script::time_limit(&calculation),
        };
        script::write(calculation, &self.client, cores, gpus)?;
        Ok(job)
    }

    /// Submits a job. Waits while the batch system accepts no further job. If it refuses the job, the labeller fails, not the
    /// calculation.
    pub async fn submit(&self, job: &CustomJob) -> Result<(), StoreError> {
        let failed = |error| file_error(&job.directory, error);
        let mut refused = 0;
        loop {
            let Some(number) = job.begin_submission().map_err(failed)? else {
                let why =
                    format!("its {MAX_SUBMISSIONS} jobs ended before they began, or {SCRATCH_NOT_SHARED}");
                return Err(job_error(job, why));
            };
            let on_full = |full: &CustomError| {
                if !self.is_full.swap(true, Ordering::Relaxed) {
                    warn!("{full}: labels wait until it does");
                }
            };
            let submitted = self.client.submit(&job.script(number), None, on_full).await;
            if self.is_full.swap(false, Ordering::Relaxed) {
                info!("{} accepts jobs again", job.scheduler);
            }
            match submitted {
                Ok(id) => return job.end_submission(number, &id).map_err(failed),
                // There may be a job, which may calculate.
                Err(CustomError::TimedOut { .. }) => {}
                Err(error) => {
                    let is_wrong = matches!(error, CustomError::UnexpectedOutput { .. });
                    if !is_wrong {
                        job.forget_submission(number).map_err(failed)?;
                    }
                    refused += 1;
                    if refused >= MAX_REFUSALS || is_wrong || error.is_missing() {
                        return Err(job_error(job, format_args!("cannot submit its job: {error}")));
                    }
                }
            }
            sleep(RETRY_INTERVAL).await;
        }
    }

    pub async fn inspect(&self, job: &CustomJob) -> Result<CalculationState, StoreError> {
        if let Some(known) = poll_directory(job) {
            return Ok(known);
        }
        if job.scheduler != self.client.scheduler().name {
            return Ok(CalculationState::Elsewhere);
        }
        match job.begun() {
            Some(begun) => self.begun_job(job, begun).await,
            None => self.waiting_job(job).await,
        }
    }

    /// The state of a job of which a submission calculates.
    async fn begun_job(
        &self,
        job: &CustomJob,
        (number, age): (u32, Duration),
    ) -> Result<CalculationState, StoreError> {
        let submission = job.submissions().into_iter().find(|one| one.number == number);
        let state = match &submission {
            Some(submission) if submission.id.is_some() => self.poll(job, submission).await?,
            _ if age < Duration::from_secs(job.time_limit).saturating_add(LOST_MARGIN) => {
                PolledState::Running
            }
            _ => PolledState::Vanished,
        };
        if state.is_alive() {
            return Ok(CalculationState::Running);
        }
        settle(&job.directory).await;
        if let Some(end) = CalculationEnd::read(&job.directory) {
            return Ok(CalculationState::Ended(end));
        }
        let id = submission.and_then(|submission| submission.id);
        let end = end::infer_end(self.client.scheduler(), job, number, id.as_ref(), state);
        end.write(&job.directory).map_err(|error| file_error(&job.directory, error))?;
        Ok(CalculationState::Ended(end))
    }

    /// The state of a job that has not begun.
    async fn waiting_job(&self, job: &CustomJob) -> Result<CalculationState, StoreError> {
        for submission in job.submissions() {
            if submission.id.is_some() && self.poll(job, &submission).await?.is_alive() {
                return Ok(CalculationState::Running);
            }
        }
        settle(&job.directory).await;
        // It may have begun and ended meanwhile.
        Ok(match (CalculationEnd::read(&job.directory), job.begun()) {
            (Some(end), _) => CalculationState::Ended(end),
            (None, Some(_)) => CalculationState::Running,
            (None, None) => CalculationState::Ready,
        })
    }

    /// Waits for the end, and submits the job if it is over before it began; `None` if its directory was removed.
    pub async fn wait(&self, job: &CustomJob) -> Result<Option<CalculationEnd>, StoreError> {
        let (mut pause, mut asked) = (MIN_POLL_INTERVAL, Instant::now());
        loop {
            if let Some(end) = CalculationEnd::read(&job.directory) {
                return Ok(Some(end));
            }
            if asked.elapsed() >= QUESTION_INTERVAL {
                match self.inspect(job).await?.while_waiting() {
                    WaitStep::Read(end) => return Ok(Some(end)),
                    WaitStep::Submit => self.submit(job).await?,
                    WaitStep::Wait => {}
                    WaitStep::Abandon => return Ok(None),
                }
                asked = Instant::now();
            }
            sleep(pause).await;
            pause = (pause * 5 / 4).min(MAX_POLL_INTERVAL);
        }
    }

    /// Cancels a job and waits briefly for its end. If the batch system does not answer, this fails: the job continues, and a later
    /// labeller finds it.
    pub async fn cancel(&self, job: &CustomJob) -> Result<(), StoreError> {
        let failed = |error: CustomError| job_error(job, error);
        let mut living = Vec::new();
        for id in job.submissions().into_iter().filter_map(|submission| submission.id) {
            if self.client.poll(&id).await.map_err(failed)?.is_alive() {
                self.client.cancel(&id).await.map_err(failed)?;
                living.push(id);
            }
        }
        let started = Instant::now();
        while let Some(id) = living.pop() {
            while self.client.poll(&id).await.map_err(failed)?.is_alive() {
                if started.elapsed() > CANCEL_TIMEOUT {
                    return Ok(());
                }
                sleep(MIN_POLL_INTERVAL * 4).await;
            }
        }
        Ok(())
    }

    /// The state of a submission. Retries until the batch system answers.
    async fn poll(&self, job: &CustomJob, submission: &JobSubmission) -> Result<PolledState, StoreError> {
        let Some(id) = &submission.id else { return Ok(PolledState::Vanished) };
        loop {
            match self.client.poll(id).await {
                Ok(PolledState::Vanished) if submission.age < NOT_YET_KNOWN => {
                    return Ok(PolledState::Pending);
                }
                Ok(state) => return Ok(state),
                Err(error) if error.is_missing() => return Err(job_error(job, error)),
                Err(_) => sleep(QUESTION_INTERVAL).await,
            }
        }
    }
}

/// What can be said without the batch system.
pub(super) fn poll_directory(job: &CustomJob) -> Option<CalculationState> {
    let exists = job.directory.symlink_metadata().is_ok();
    if exists && !private_directory::is_own(&job.directory) {
        // Another user has created a directory of that name after it was removed, or has submitted the job.
        return Some(CalculationState::Elsewhere);
    }
    if let Some(end) = CalculationEnd::read(&job.directory) {
        return Some(CalculationState::Ended(end));
    }
    match exists {
        _ if job.user != own_user() => Some(CalculationState::Elsewhere),
        true => None,
        false => Some(CalculationState::Gone),
    }
}

fn job_error(job: &CustomJob, why: impl ToString) -> StoreError {
    file_error(&job.directory, io::Error::other(why.to_string()))
}
