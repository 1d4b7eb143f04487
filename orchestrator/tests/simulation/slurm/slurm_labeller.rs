//! What a labeller does whose calculations are Slurm jobs: the shell around the decisions of `workers::labeller`, step by
//! step.

use workers::labeller::decisions::{
    CalculationEnd, CalculationState, Inspection, InspectionStep, JobDirectory, SqueueJob, SubmissionRetry,
    SubmissionStep, Traces, WaitStep, infer_end, is_listed, jobs_to_cancel,
};

use super::super::fault::Time;
use super::super::planted::PlantedBug;
use super::files::SETTLE_TIME;
use super::labeller::{Answer, FULL_PAUSES, Failing, LabellerIo, POLL_INTERVALS, RETRY_INTERVAL, Request};

/// Time between two questions to Slurm.
pub const SQUEUE_INTERVAL: Time = 20_000;
/// How long a cancelled job may take to end.
const CANCEL_TIMEOUT: Time = 5_000;

impl LabellerIo {
    fn look(&self, name: &str) -> JobDirectory {
        match self.files.borrow().look(name) {
            JobDirectory::Own { can_begin, end, .. } if self.bug == Some(PlantedBug::BegunOverlooked) => {
                JobDirectory::Own { begun: false, can_begin, end }
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
    pub(super) async fn inspect_slurm(&self, name: &str) -> Failing<CalculationState> {
        let mut inspection = Inspection::default();
        let first = match self.look(name) {
            JobDirectory::Own { end: None, .. } if self.bug == Some(PlantedBug::OldAnswerBelieved) => {
                JobDirectory::Own { begun: true, can_begin: true, end: None }
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

    pub(super) async fn submit_slurm(&self, name: &str) -> Failing<()> {
        let (mut retry, mut pause) = (SubmissionRetry::default(), FULL_PAUSES[0]);
        loop {
            match self.request(Request::Sbatch(name.to_owned())).await {
                Answer::Text(Some(_)) => return Ok(()),
                Answer::Full => {
                    self.sleep(pause).await;
                    pause = (2 * pause).min(FULL_PAUSES[1]);
                    continue;
                }
                Answer::Text(None) | Answer::Done | Answer::Output(_) | Answer::Past(_) => {}
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

    pub(super) async fn wait_slurm(&self, name: &str) -> Failing<Option<CalculationEnd>> {
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
                    match self.inspect_slurm(name).await?.while_waiting() {
                        WaitStep::Read(end) => return Ok(Some(end)),
                        WaitStep::Submit => {
                            self.files.borrow_mut().check_not_begun(name);
                            self.submit_slurm(name).await?;
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

    /// Cancels the jobs of a calculation, and waits briefly for their end.
    pub(super) async fn cancel_slurm(&self, name: &str) -> Failing<()> {
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
        Ok(())
    }
}
