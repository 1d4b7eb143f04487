//! The jobs of a campaign in a custom batch system.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use ::batch::{CustomClient, CustomError, CustomScheduler, JobId, PolledState};
use futures_util::future::try_join_all;

use super::error::BatchError;
use super::job::{CampaignJob, JobNames, Role};
use super::plan::Submission;
use super::records::{JobRecord, JobRecords};
use super::slurm_commands::JobOptions;

/// Number of jobs whose states are asked for at the same time.
const POLLS_AT_ONCE: usize = 16;
/// A batch system may not know a job for this long after it was submitted, s.
const SETTLE_TIME: u64 = 60;
/// The file that keeps jobs from submitting themselves again.
const STOPPED: &str = "stopped";
/// Environment variable in which a job has its role.
const JOB_VARIABLE: &str = "CALMWALK_JOB";

/// A custom batch system, and the folder with the file of its jobs. One process at a time may submit jobs: callers hold a lock.
#[derive(Clone, Debug)]
pub struct CustomCommands {
    client: CustomClient,
    folder: PathBuf,
}

impl CustomCommands {
    /// With a timeout for each command.
    pub fn new(scheduler: CustomScheduler, folder: &Path, timeout: Duration) -> Self {
        Self { client: CustomClient::new(scheduler, timeout), folder: folder.to_owned() }
    }

    /// The batch system.
    pub fn client(&self) -> &CustomClient {
        &self.client
    }

    /// The recorded jobs of a campaign that the batch system knows.
    ///
    /// # Errors
    /// See [`BatchError`], also for the following functions.
    pub async fn jobs(&self, names: &JobNames) -> Result<Vec<CampaignJob>, BatchError> {
        let records = JobRecords::read(&self.folder)?.map(|records| records.jobs).unwrap_or_default();
        let mut jobs = Vec::new();
        for some in records.chunks(POLLS_AT_ONCE) {
            let polls = some.iter().filter_map(|record| Some(self.job(names.role(&record.name)?, record)));
            jobs.extend(try_join_all(polls).await?.into_iter().flatten());
        }
        Ok(jobs)
    }

    /// A job, if the batch system knows it.
    async fn job(&self, role: Role, record: &JobRecord) -> Result<Option<CampaignJob>, CustomError> {
        let state = match self.client.poll(&record.id).await? {
            PolledState::Vanished if now() < record.submitted + SETTLE_TIME => PolledState::Pending,
            PolledState::Vanished => return Ok(None),
            state => state,
        };
        Ok(Some(CampaignJob {
            id: record.id.clone(),
            role,
            state: state.name().to_owned(),
            nodes: String::new(),
            start: "N/A".to_owned(),
            time_left: String::new(),
            walkers: record.walkers,
            reason: None,
        }))
    }

    /// Submits a job, records it and returns its id. Waits while the batch system accepts no further job, and calls `on_full` when
    /// it starts to wait.
    pub async fn submit(
        &self,
        names: &JobNames,
        submission: &Submission,
        request: &JobOptions<'_>,
        on_full: impl FnOnce(&CustomError),
    ) -> Result<JobId, BatchError> {
        let role = submission.role;
        let after = request.orchestrator.as_ref().filter(|_| role != Role::Orchestrator);
        let id = self.client.submit(&request.script, after, on_full).await?;
        let walkers = matches!(role, Role::Agent(_)).then_some(request.walkers);
        self.record(JobRecord { id: id.clone(), name: names.job_name(role), walkers, submitted: now() })?;
        Ok(id)
    }

    fn record(&self, job: JobRecord) -> Result<(), BatchError> {
        let scheduler = self.client.scheduler().clone();
        let known = JobRecords::read(&self.folder)?.map(|records| records.jobs);
        let mut records = JobRecords { scheduler, jobs: known.unwrap_or_default() };
        records.put(job);
        records.write(&self.folder)
    }

    /// Submits the job again in which this process runs, with the same script. `None` if the campaign's jobs were stopped.
    pub async fn submit_again(
        &self,
        names: &JobNames,
        script: impl FnOnce(Role) -> PathBuf,
    ) -> Result<Option<JobId>, BatchError> {
        let own = self.own_record(names)?;
        let Some((role, record)) = own.filter(|_| !self.folder.join(STOPPED).exists()) else {
            return Ok(None);
        };
        let id = self.client.submit(&script(role), None, |_| ()).await?;
        self.record(JobRecord { id: id.clone(), submitted: now(), ..record })?;
        Ok(Some(id))
    }

    /// Cancels jobs. Those that have ended are not an error.
    pub async fn cancel(&self, ids: &[JobId]) -> Result<(), BatchError> {
        for some in ids.chunks(POLLS_AT_ONCE) {
            try_join_all(some.iter().map(|id| self.client.cancel(id))).await?;
        }
        Ok(())
    }

    /// The job in which this process runs, if it is one of the campaign.
    pub fn own_job(&self, names: &JobNames) -> Option<JobId> {
        Some(self.own_record(names).ok().flatten()?.1.id)
    }

    fn own_record(&self, names: &JobNames) -> Result<Option<(Role, JobRecord)>, BatchError> {
        let Ok(own) = std::env::var(JOB_VARIABLE) else { return Ok(None) };
        let records = JobRecords::read(&self.folder)?.map(|records| records.jobs).unwrap_or_default();
        let mut roles = records.into_iter().filter_map(|record| Some((names.role(&record.name)?, record)));
        Ok(roles.find(|(role, _)| role.name() == own))
    }

    /// Keeps jobs that end from submitting themselves again, until [`Self::allow`].
    pub fn forbid(&self) -> Result<(), BatchError> {
        let path = self.folder.join(STOPPED);
        let written = fs::create_dir_all(&self.folder).and_then(|()| fs::write(&path, ""));
        written.map_err(BatchError::records(&path))
    }

    /// Lets jobs submit themselves again.
    pub fn allow(&self) -> Result<(), BatchError> {
        let path = self.folder.join(STOPPED);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != ErrorKind::NotFound => Err(BatchError::records(&path)(error)),
            _ => Ok(()),
        }
    }
}

/// Seconds since 1970.
fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A batch system of files: the file `ID` has the state of a job.
    fn commands(folder: &Path) -> CustomCommands {
        let here = folder.display();
        let scheduler = serde_json::json!({
            "name": "files",
            "submit": format!("cat > {here}/last; echo 41.a; echo R > {here}/41.a"),
            "poll": format!("cat {here}/{{id}}"),
            "states": { "pending": ["Q"], "running": ["R"], "completed": ["F"] },
            "vanished": ["No such file"],
            "cancel": format!("echo F > {here}/{{id}}"),
            "script": "{command}",
        });
        let scheduler = serde_json::from_value(scheduler).unwrap();
        CustomCommands::new(scheduler, folder, Duration::from_secs(60))
    }

    fn record(id: u64, name: &str, submitted: u64) -> JobRecord {
        JobRecord { id: id.into(), name: name.to_owned(), walkers: Some(4), submitted }
    }

    #[tokio::test]
    async fn recorded_jobs_have_the_states_of_the_batch_system() {
        let (folder, names) = (tempfile::tempdir().unwrap(), JobNames::new("1a"));
        let commands = commands(folder.path());
        assert!(commands.jobs(&names).await.unwrap().is_empty());
        for (id, role, submitted) in [
            (1, Role::Orchestrator, 0),
            (2, Role::Agent(0), 0),
            (3, Role::Agent(1), 0),
            (4, Role::Agent(2), now()),
        ] {
            commands.record(record(id, &names.job_name(role), submitted)).unwrap();
        }
        commands.record(record(5, "calmwalk-other-agent-0", 0)).unwrap();
        for (id, state) in [(1, "R"), (2, "F")] {
            fs::write(folder.path().join(id.to_string()), state).unwrap();
        }
        // The third job is unknown, the fourth one not yet known.
        let jobs = commands.jobs(&names).await.unwrap();
        let found: Vec<_> =
            jobs.iter().map(|job| (job.id.to_string(), job.role, job.state.as_str())).collect();
        let expected = [
            ("1".to_owned(), Role::Orchestrator, "RUNNING"),
            ("2".to_owned(), Role::Agent(0), "COMPLETED"),
            ("4".to_owned(), Role::Agent(2), "PENDING"),
        ];
        assert_eq!(found, expected);
        commands.cancel(&[1.into()]).await.unwrap();
        assert_eq!(commands.jobs(&names).await.unwrap()[0].state, "COMPLETED");
    }

    #[tokio::test]
    async fn a_submitted_job_replaces_the_record_with_its_name() {
        let (folder, names) = (tempfile::tempdir().unwrap(), JobNames::new("1a"));
        let commands = commands(folder.path());
        let script = folder.path().join("agent-0.job");
        fs::write(&script, "true\n").unwrap();
        let submission = Submission { role: Role::Agent(0), after_end_of: Vec::new() };
        let request = JobOptions {
            script,
            log: PathBuf::new(),
            directory: folder.path(),
            walkers: 8,
            orchestrator: None,
            options: &[],
        };
        commands.record(record(7, &names.job_name(Role::Agent(0)), 0)).unwrap();
        commands.submit(&names, &submission, &request, |_| ()).await.unwrap();
        let jobs = commands.jobs(&names).await.unwrap();
        assert_eq!((jobs.len(), jobs[0].id.to_string(), jobs[0].walkers), (1, "41.a".to_owned(), Some(8)));
        assert_eq!(fs::read_to_string(folder.path().join("last")).unwrap(), "true\n");
    }
}
