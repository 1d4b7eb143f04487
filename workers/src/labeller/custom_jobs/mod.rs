//! A calculation as a job of a custom batch system.
//!
//! Its directory, which every node sees, contains everything it needs, and a note of each submission that is made before the job is
//! submitted. Of several submissions, only the one that creates the link [`job::BEGUN`] calculates: a job submitted twice because
//! an answer was lost is calculated once.
//!
//! The runner records the end, as for local calculations. The batch system is asked rarely, only to find jobs that can no longer record
//! their end; while it does not answer, nothing is concluded.

mod end;
mod inspection;
mod job;
mod script;
mod submission;

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use ::batch::{CustomClient, CustomError, CustomScheduler, JobId, PolledState};
use dft::PassedEnvironment;
use store::StoreError;
use tokio::time::sleep;
use tracing::{info, warn};

use super::batch_job::{
    CANCEL_TIMEOUT, COMMAND_TIMEOUT, MAX_POLL_INTERVAL, MIN_POLL_INTERVAL, RETRY_INTERVAL,
    SCRATCH_NOT_SHARED, own_user, settle,
};
use super::calculation_runner::{Calculation, CalculationEnd};
use super::calculation_state::{CalculationState, WaitStep};
use super::file_error::file_error;
use super::private_directory;

pub use end::infer_custom_end;
use inspection::NOT_YET_KNOWN;
pub use inspection::{CustomDirectory, CustomInspection, CustomStep};
pub(super) use job::CustomJob;
pub use job::{JobSubmission, MAX_NUMBER, MAX_SUBMISSIONS};
pub use submission::{AfterFailure, CustomSubmission, SubmissionFailure};

/// Time between two questions to the batch system about a job.
const QUESTION_INTERVAL: Duration = Duration::from_secs(30);

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
        let mut submission = CustomSubmission::default();
        loop {
            let Some(number) = job.begin_submission().map_err(failed)? else {
                return Err(no_submission_left(job));
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
            let error = match submitted {
                Ok(id) => return job.end_submission(number, &id).map_err(failed),
                Err(error) => error,
            };
            let AfterFailure { forget, again } = submission.failed(SubmissionFailure::of(&error));
            if forget {
                job.forget_submission(number).map_err(failed)?;
            }
            if !again {
                return Err(job_error(job, format_args!("cannot submit its job: {error}")));
            }
            sleep(RETRY_INTERVAL).await;
        }
    }

    pub async fn inspect(&self, job: &CustomJob) -> Result<CalculationState, StoreError> {
        let mut inspection = CustomInspection::new(Duration::from_secs(job.time_limit));
        let mut step = inspection.looked(self.look(job));
        loop {
            step = match step {
                CustomStep::Ask(id) => inspection.answered(self.poll(job, &id).await?),
                CustomStep::Settle => {
                    settle(&job.directory).await;
                    inspection.looked(self.look(job))
                }
                CustomStep::InferEnd { number, id, state } => {
                    let traces = end::traces(job, number);
                    let end = infer_custom_end(self.client.scheduler(), id.as_ref(), state, &traces);
                    end.write(&job.directory).map_err(|error| file_error(&job.directory, error))?;
                    return Ok(CalculationState::Ended(end));
                }
                CustomStep::Close => {
                    let closed = job.close().map_err(|error| file_error(&job.directory, error))?;
                    return Ok(if closed { CalculationState::Gone } else { CalculationState::Running });
                }
                CustomStep::Is(state) => return Ok(state),
            };
        }
    }

    fn look(&self, job: &CustomJob) -> CustomDirectory {
        match look_at_directory(job) {
            CustomDirectory::Open { .. } if job.scheduler != self.client.scheduler().name => {
                CustomDirectory::Foreign
            }
            found => found,
        }
    }

    /// Waits for the end, and submits the job if it is over before it began; `None` if its directory was removed. If no submission is left,
    /// the labeller fails, and the next one begins a new calculation.
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
                    WaitStep::Abandon if job.is_closed() => return Err(no_submission_left(job)),
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
        for JobSubmission { id, age, .. } in job.submissions() {
            let Some(id) = id else { continue };
            let state = self.client.poll(&id).await.map_err(failed)?;
            if state.is_alive() || state == PolledState::Vanished && age < NOT_YET_KNOWN {
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

    /// The state of a job. Retries until the batch system answers.
    async fn poll(&self, job: &CustomJob, id: &JobId) -> Result<PolledState, StoreError> {
        loop {
            match self.client.poll(id).await {
                Ok(state) => return Ok(state),
                Err(error) if error.is_missing() => return Err(job_error(job, error)),
                Err(_) => sleep(QUESTION_INTERVAL).await,
            }
        }
    }
}

/// The state as far as it can be known without the batch system.
pub(super) fn poll_directory(job: &CustomJob) -> Option<CalculationState> {
    match look_at_directory(job) {
        CustomDirectory::Missing => Some(CalculationState::Gone),
        CustomDirectory::Foreign => Some(CalculationState::Elsewhere),
        CustomDirectory::Ended(end) => Some(CalculationState::Ended(end)),
        CustomDirectory::Open { .. } => None,
    }
}

/// What the directory shows, whichever batch system there is now.
fn look_at_directory(job: &CustomJob) -> CustomDirectory {
    let exists = job.directory.symlink_metadata().is_ok();
    if exists && !private_directory::is_own(&job.directory) {
        // Another user has created a directory of that name after it was removed, or has submitted the job.
        return CustomDirectory::Foreign;
    }
    if let Some(end) = CalculationEnd::read(&job.directory) {
        return CustomDirectory::Ended(end);
    }
    if job.user != own_user() {
        return CustomDirectory::Foreign;
    }
    let begun = job.begun();
    if !exists || begun.is_none() && !job.can_begin() {
        return CustomDirectory::Missing;
    }
    CustomDirectory::Open { begun, submissions: job.submissions(), may_be_submitted: job.may_be_submitted() }
}

fn no_submission_left(job: &CustomJob) -> StoreError {
    let why = format!(
        "none of its {MAX_SUBMISSIONS} submissions has begun: their jobs ended before, {} did not answer, or {SCRATCH_NOT_SHARED}",
        job.scheduler
    );
    job_error(job, why)
}

fn job_error(job: &CustomJob, why: impl ToString) -> StoreError {
    file_error(&job.directory, io::Error::other(why.to_string()))
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::process::Command;

    use super::super::calculation_runner::RunnerCommand;
    use super::*;

    /// The jobs of lost ids may still wait: they do nothing when they start.
    #[tokio::test]
    async fn a_calculation_without_a_submission_left_is_closed_before_it_is_given_up() {
        let home = tempfile::tempdir().unwrap();
        let scheduler: CustomScheduler = toml::from_str(
            "name = \"files\"\nsubmit = \"false\"\npoll = \"false\"\ncancel = \"false\"\nvanished = [\"unknown\"]\n\
             states = { pending = [], running = [\"R\"], completed = [\"F\"] }\nscript = \"{command}\"\n",
        )
        .unwrap();
        let jobs = CustomJobs::new(scheduler, &PassedEnvironment::default());
        let runner = RunnerCommand { program: "/bin/touch".into(), arguments: vec!["ran".to_owned()] };
        let job = jobs.prepare(Calculation::example(home.path(), runner), 1, 0).unwrap();
        assert_eq!(jobs.inspect(&job).await.unwrap(), CalculationState::Ready);
        // Somebody has removed a part of the directory.
        for file in [job::SCRIPT, job::REQUEST].map(|file| home.path().join(file)) {
            let content = fs::read(&file).unwrap();
            fs::remove_file(&file).unwrap();
            assert_eq!(jobs.inspect(&job).await.unwrap(), CalculationState::Gone);
            fs::write(file, content).unwrap();
        }
        while job.begin_submission().unwrap().is_some() {}
        assert_eq!(jobs.inspect(&job).await.unwrap(), CalculationState::Gone);
        assert!(job.is_closed());
        let script = fs::read_to_string(job.script(1)).unwrap();
        assert!(Command::new("sh").args(["-c", &script]).status().unwrap().success());
        assert!(!home.path().join("ran").exists());
        // The next labeller comes to the same conclusion, and one that submits it says why it cannot.
        assert_eq!(jobs.inspect(&job).await.unwrap(), CalculationState::Gone);
        let error = jobs.submit(&job).await.unwrap_err().to_string();
        assert!(error.contains("none of its 4 submissions has begun"), "{error}");
        // One that has begun cannot be closed.
        fs::remove_file(home.path().join(job::BEGUN)).unwrap();
        assert!(Command::new("sh").args(["-c", &script]).status().unwrap().success());
        assert!(home.path().join("ran").exists() && !job.close().unwrap());
        assert_eq!(jobs.inspect(&job).await.unwrap(), CalculationState::Running);
    }
}
