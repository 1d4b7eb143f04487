//! What a labeller does whose calculations are jobs of another batch system: the shell around the decisions of
//! `workers::labeller`, step by step.

use std::time::Duration;

use batch::{CommandOutput, JobId, PolledState};
use workers::labeller::decisions::{
    AfterFailure, CalculationEnd, CalculationState, CustomInspection, CustomStep, CustomSubmission,
    SubmissionFailure, WaitStep, infer_custom_end,
};

use super::super::fault::Time;
use super::super::planted::PlantedBug;
use super::dialect::Dialect;
use super::files::SETTLE_TIME;
use super::labeller::{Answer, FULL_PAUSES, Failing, LabellerIo, POLL_INTERVALS, RETRY_INTERVAL, Request};

/// Time between two questions about a job.
const QUESTION_INTERVAL: Time = 30_000;
/// Time within which a job ends after it has begun.
const TIME_LIMIT: Duration = Duration::from_secs(90);
/// How long a cancelled job may take to end.
const CANCEL_TIMEOUT: Time = 5_000;

impl LabellerIo {
    /// What a command printed, if it answered in time.
    async fn output(&self, request: Request) -> Option<CommandOutput> {
        match self.request(request).await {
            Answer::Output(output) => Some(output),
            Answer::Done | Answer::Text(_) | Answer::Full | Answer::Past(_) => None,
        }
    }

    async fn polled(&self, dialect: &Dialect, id: &JobId) -> Option<PolledState> {
        let output = self.output(Request::Poll(id.clone())).await?;
        dialect.scheduler.polled_state(&output)
    }

    pub(super) async fn inspect_custom(&self, dialect: &Dialect, name: &str) -> CalculationState {
        let mut inspection = CustomInspection::new(TIME_LIMIT);
        let look = || self.files.borrow().look_custom(name, self.bug);
        let mut step = inspection.looked(look());
        loop {
            step = match step {
                CustomStep::Ask(id) => inspection.answered(self.polled_at_last(dialect, &id).await),
                CustomStep::Settle => {
                    if self.bug != Some(PlantedBug::FilesBelievedAtOnce) {
                        self.sleep(SETTLE_TIME).await;
                    }
                    inspection.looked(look())
                }
                CustomStep::InferEnd { id, state, .. } => {
                    let traces = self.files.borrow().traces(name);
                    let end = infer_custom_end(&dialect.scheduler, id.as_ref(), state, &traces);
                    self.files.borrow_mut().record_inferred(name, end.clone());
                    return CalculationState::Ended(end);
                }
                CustomStep::Close => {
                    let closed = self.files.borrow_mut().close(name);
                    return if closed { CalculationState::Gone } else { CalculationState::Running };
                }
                CustomStep::Is(state) => return state,
            };
        }
    }

    /// Asks until the batch system answers.
    async fn polled_at_last(&self, dialect: &Dialect, id: &JobId) -> PolledState {
        loop {
            match self.polled(dialect, id).await {
                Some(state) => return state,
                None => self.sleep(QUESTION_INTERVAL).await,
            }
        }
    }

    pub(super) async fn submit_custom(&self, dialect: &Dialect, name: &str) -> Failing<()> {
        let mut submission = CustomSubmission::default();
        loop {
            let number = self.files.borrow_mut().begin_submission(name, self.bug);
            let Some(number) = number else { return Err(format!("no submission of {name} is left")) };
            let failure = match self.try_to_submit(dialect, name, number).await {
                Ok(id) => {
                    self.files.borrow_mut().end_submission(name, number, id);
                    return Ok(());
                }
                Err(failure) => failure,
            };
            let AfterFailure { forget, again } = submission.failed(failure);
            if forget {
                self.files.borrow_mut().forget_submission(name, number);
            }
            if !again {
                return Err(format!("the batch system refuses {name}"));
            }
            self.sleep(RETRY_INTERVAL).await;
        }
    }

    async fn try_to_submit(
        &self,
        dialect: &Dialect,
        name: &str,
        number: u32,
    ) -> Result<JobId, SubmissionFailure> {
        let mut pause = FULL_PAUSES[0];
        loop {
            let output = self.output(Request::Submit(name.to_owned(), number)).await;
            let output = output.ok_or(SubmissionFailure::NoAnswer)?;
            if dialect.scheduler.full_queue(&output).is_none() {
                return match output.success {
                    true => dialect.scheduler.submitted_id(&output).ok_or(SubmissionFailure::NoId),
                    false => Err(SubmissionFailure::Refused),
                };
            }
            self.sleep(pause).await;
            pause = (2 * pause).min(FULL_PAUSES[1]);
        }
    }

    pub(super) async fn wait_custom(&self, dialect: &Dialect, name: &str) -> Failing<Option<CalculationEnd>> {
        let (mut pause, mut asked) = (POLL_INTERVALS[0], self.now());
        loop {
            if let Some(end) = self.files.borrow().seen_end(name) {
                return Ok(Some(end));
            }
            if self.now() - asked >= QUESTION_INTERVAL {
                match self.inspect_custom(dialect, name).await.while_waiting() {
                    WaitStep::Read(end) => return Ok(Some(end)),
                    WaitStep::Submit => {
                        self.files.borrow_mut().check_not_begun(name);
                        self.submit_custom(dialect, name).await?;
                    }
                    WaitStep::Wait => {}
                    WaitStep::Abandon if self.files.borrow().is_closed(name) => {
                        return Err(format!("no submission of {name} is left"));
                    }
                    WaitStep::Abandon => return Ok(None),
                }
                asked = self.now();
            }
            self.sleep(pause).await;
            pause = (pause * 5 / 4).min(POLL_INTERVALS[1]);
        }
    }

    /// Cancels the jobs of a calculation, and waits briefly for their end.
    pub(super) async fn cancel_custom(&self, dialect: &Dialect, name: &str) -> Failing<()> {
        let away = || "the batch system does not answer".to_owned();
        let mut living = Vec::new();
        let ids = self.files.borrow().submitted_ids(name);
        for id in ids {
            if self.polled(dialect, &id).await.ok_or_else(away)?.is_alive() {
                self.output(Request::Delete(id.clone()))
                    .await
                    .filter(|output| output.success)
                    .ok_or_else(away)?;
                living.push(id);
            }
        }
        let started = self.now();
        while let Some(id) = living.pop() {
            while self.polled(dialect, &id).await.ok_or_else(away)?.is_alive() {
                if self.now() - started > CANCEL_TIMEOUT {
                    return Ok(());
                }
                self.sleep(200).await;
            }
        }
        Ok(())
    }
}
