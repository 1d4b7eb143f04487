//! A calculation as a job of its own in the batch system Slurm.
//!
//! Its directory, which every node sees, has all that it needs: whoever finds it there, and that Slurm does not know its
//! name, submits it (again). Of two jobs of one name the second waits for the end of the first (`singleton`), and only
//! the one that makes the directory [`BEGUN`] calculates, so what was submitted twice, because an answer was lost, is calculated once.
//!
//! The end is what the keeper leaves, as everywhere. Slurm is asked seldom, only to find jobs that cannot leave one any more;
//! as long as it does not answer nothing is concluded. It knows every job that lives, and forgets others after a while
//! (`MinJobAge`): one that it does not know is over, and what Slurm wrote into the job's log before tells why.

mod script;
mod squeue;
mod squeue_cache;

use std::ffi::OsStr;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use ::slurm::{Commands, Phase, SlurmError};
use dft::PassedEnvironment;
use serde::{Deserialize, Serialize};
use store::StoreError;
use tokio::sync::OnceCell;
use tokio::time::sleep;

use super::calculation_handle::CalculationState;
use super::calculation_runner::CalculationEnd;
use super::code::file;
use super::private_directory;
use squeue::{SqueueJob, Traces};

pub(super) use script::{JobRequirements, write};
pub(super) use squeue_cache::remove_cache;

/// Made in the directory by the job that calculates.
const BEGUN: &str = "begun";
/// What the job is told to do.
const SCRIPT: &str = "job.sh";
/// What its keeper reads.
const REQUEST: &str = "order.json";
/// What Slurm and the script say.
const LOG: &str = "slurm.log";

/// No answer is waited for for longer.
const COMMAND_TIMEOUT: Duration = Duration::from_secs(60);
/// Between two looks at the directory of a calculation that has just begun …
const MIN_POLL_INTERVAL: Duration = Duration::from_millis(50);
/// … and of one that has lasted for a while.
const MAX_POLL_INTERVAL: Duration = Duration::from_secs(2);
/// Between two questions to Slurm.
const SQUEUE_INTERVAL: Duration = Duration::from_secs(20);
/// What a node has written may be seen here so much later.
const SETTLE_TIME: Duration = Duration::from_secs(2);
/// Between two tries to submit …
const RETRY_INTERVAL: Duration = Duration::from_secs(3);
/// … of which so many may be refused, though Slurm answers.
const MAX_REFUSALS: u32 = 3;
/// How long a cancelled job may take to end, before its directory is left for later.
const CANCEL_TIMEOUT: Duration = Duration::from_secs(5);

/// What finds a job again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Job {
    /// Elsewhere the name says nothing.
    pub cluster: String,
    pub directory: PathBuf,
    /// That of no other calculation.
    pub name: String,
    /// Who has submitted it: others may not see it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<u32>,
    /// Where it failed, if it may go better on another node.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub node: Option<String>,
}

/// Slurm, as jobs of calculations need it.
pub(super) struct Slurm {
    commands: Commands,
    cluster: OnceCell<String>,
}

impl Slurm {
    /// Slurm's commands, with the variables of this environment that programs get: `sbatch` gives its own to its job.
    pub fn new(passed: &PassedEnvironment) -> Self {
        let is_slurm_variable = |name: &OsStr| {
            let name = name.to_string_lossy();
            name.starts_with("SBATCH_") || name == "SLURM_JWT"
        };
        let own = std::env::vars_os().filter(|(name, _)| is_slurm_variable(name));
        let environment = passed.of_this_process().chain(own).collect();
        let commands = Commands::with_patience(COMMAND_TIMEOUT).with_environment(environment);
        Self { commands, cluster: OnceCell::new() }
    }

    /// The job of the calculation in this directory, below that of its campaign.
    pub async fn job(&self, directory: &Path) -> Result<Job, StoreError> {
        let last = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let campaign = directory.parent().map(last).filter(|name| name.starts_with("calmwalk-"));
        let name = campaign.into_iter().chain([last(directory)]).collect::<Vec<_>>().join("-");
        let cluster = self.cluster(directory).await?.to_owned();
        Ok(Job { cluster, directory: directory.to_owned(), name, user: Some(own_user()), node: None })
    }

    /// Submits a job that Slurm does not know. An answer that was lost is looked for; where Slurm answers, and will not have
    /// the job, that fails the labeller and not the calculation.
    pub async fn submit(&self, job: &Job) -> Result<(), StoreError> {
        let mut refused = 0;
        loop {
            let error = match self.commands.submit(&script::arguments(job)).await {
                Ok(_) => return Ok(()),
                Err(error) => error,
            };
            if !self.jobs(job).await?.is_empty() {
                return Ok(());
            }
            refused += 1;
            // There may be no node beside those that are avoided.
            let again =
                script::clear_excluded_nodes(&job.directory).map_err(|error| file(&job.directory, error))?;
            if refused >= MAX_REFUSALS && !again {
                return Err(cannot(job, format_args!("its job cannot be submitted: {error}")));
            }
            sleep(RETRY_INTERVAL).await;
        }
    }

    pub async fn inspect(&self, job: &Job) -> Result<CalculationState, StoreError> {
        if job.directory.symlink_metadata().is_ok() && !private_directory::is_own(&job.directory) {
            // Another user has made one of that name after it was gone, or has submitted the job.
            return Ok(CalculationState::Elsewhere);
        }
        if let Some(end) = CalculationEnd::read(&job.directory) {
            return Ok(CalculationState::Ended(end));
        }
        let others = job.user.is_some_and(|user| user != own_user());
        if others || self.cluster(&job.directory).await? != job.cluster {
            return Ok(CalculationState::Elsewhere);
        }
        let jobs = self.jobs(job).await?;
        let lives = jobs.iter().any(|reported| reported.phase() != Phase::Over);
        match (lives, job.directory.is_dir()) {
            (true, true) => Ok(CalculationState::Running),
            (true, false) => Err(cannot(
                job,
                format_args!(
                    "job '{}' is at work there, and it cannot be seen from here: {SCRATCH_NOT_SHARED}",
                    job.name
                ),
            )),
            (false, false) => Ok(CalculationState::Gone),
            (false, true) => self.finished_job(job, &jobs).await,
        }
    }

    /// What is left of a job that is over, or that Slurm does not know.
    async fn finished_job(&self, job: &Job, jobs: &[SqueueJob]) -> Result<CalculationState, StoreError> {
        settle(&job.directory).await;
        if let Some(end) = CalculationEnd::read(&job.directory) {
            return Ok(CalculationState::Ended(end));
        }
        let begun = job.directory.join(BEGUN).is_dir();
        let reported = squeue::most_informative(jobs);
        match reported {
            None if !begun => return Ok(CalculationState::Ready),
            Some(reported) if !begun && reported.ran_to_its_end() => {
                let message = format!("{reported}, where that is not seen: {SCRATCH_NOT_SHARED}");
                return Err(cannot(job, message));
            }
            _ => {}
        }
        // Slurm forgets it before long.
        let end = squeue::infer_end(reported, &Traces::read(&job.directory));
        end.write(&job.directory).map_err(|error| file(&job.directory, error))?;
        Ok(CalculationState::Ended(end))
    }

    /// Waits for the end, and submits the job should Slurm not know it; `None` if it was cleared away.
    pub async fn wait(&self, job: &Job) -> Result<Option<CalculationEnd>, StoreError> {
        let (mut pause, mut asked) = (MIN_POLL_INTERVAL, Instant::now());
        loop {
            if let Some(end) = CalculationEnd::read(&job.directory) {
                return Ok(Some(end));
            }
            if asked.elapsed() >= SQUEUE_INTERVAL {
                if !squeue_cache::is_alive(&self.commands, job).await {
                    match self.inspect(job).await? {
                        CalculationState::Ended(end) => return Ok(Some(end)),
                        CalculationState::Ready => self.submit(job).await?,
                        CalculationState::Running => {}
                        CalculationState::Gone | CalculationState::Elsewhere => return Ok(None),
                    }
                }
                asked = Instant::now();
            }
            sleep(pause).await;
            pause = (pause * 5 / 4).min(MAX_POLL_INTERVAL);
        }
    }

    /// Ends a job, and waits a little for that. Where Slurm does not answer that is an error: the job goes on then, and whoever
    /// looks for it finds it.
    pub async fn cancel(&self, job: &Job) -> Result<(), StoreError> {
        let begun = Instant::now();
        loop {
            let jobs = self.ask(job).await.map_err(|error| cannot(job, error))?;
            let living = jobs.iter().filter(|reported| reported.phase() != Phase::Over);
            // What ends was told so before.
            let ids: Vec<_> = living
                .filter(|reported| reported.phase() != Phase::Completing)
                .map(|reported| reported.id)
                .collect();
            self.commands.cancel(&ids).await.map_err(|error| cannot(job, error))?;
            if jobs.iter().all(|reported| reported.phase() == Phase::Over) || begun.elapsed() > CANCEL_TIMEOUT
            {
                return Ok(());
            }
            sleep(MIN_POLL_INTERVAL * 4).await;
        }
    }

    /// What Slurm says of the job, however long it takes to say something.
    async fn jobs(&self, job: &Job) -> Result<Vec<SqueueJob>, StoreError> {
        loop {
            match self.ask(job).await {
                Ok(jobs) => return Ok(jobs),
                Err(error) if error.is_missing() => return Err(cannot(job, error)),
                Err(_) => sleep(SQUEUE_INTERVAL).await,
            }
        }
    }

    async fn ask(&self, job: &Job) -> Result<Vec<SqueueJob>, SlurmError> {
        let name = format!("--name={}", job.name);
        let text = self.commands.queue(SqueueJob::FORMAT, &["--states=all", &name]).await?;
        let jobs: Vec<_> = text.lines().map(SqueueJob::parse).collect::<Result<_, _>>()?;
        Ok(jobs.into_iter().filter(|reported| !reported.was_refused()).collect())
    }

    async fn cluster(&self, directory: &Path) -> Result<&str, StoreError> {
        let ask = async || loop {
            match self.commands.cluster().await {
                Err(error) if error.is_missing() => {
                    return Err(file(directory, io::Error::other(error.to_string())));
                }
                Err(_) => sleep(RETRY_INTERVAL).await,
                Ok(cluster) => return Ok(cluster),
            }
        };
        self.cluster.get_or_try_init(ask).await.map(String::as_str)
    }
}

const SCRATCH_NOT_SHARED: &str =
    "label.scratch has to be a directory that this host and every node see by the same name";

fn own_user() -> u32 {
    rustix::process::getuid().as_raw()
}

fn cannot(job: &Job, why: impl ToString) -> StoreError {
    file(&job.directory, io::Error::other(why.to_string()))
}

/// Lets what other hosts have written into a directory be seen: a network file system looks again where something was made.
async fn settle(directory: &Path) {
    sleep(SETTLE_TIME).await;
    let new = directory.join("look");
    // A program may have left something of that name, and a pipe would hold this up.
    let _ = fs::File::create_new(&new).and_then(|_| fs::remove_file(&new));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_another_user_has_submitted_is_not_looked_for() {
        let directory = tempfile::tempdir().unwrap();
        let job = Job {
            cluster: "any".to_owned(),
            directory: directory.path().to_owned(),
            name: "calmwalk-1".to_owned(),
            user: Some(own_user() + 1),
            node: None,
        };
        assert_eq!(
            Slurm::new(&PassedEnvironment::default()).inspect(&job).await.unwrap(),
            CalculationState::Elsewhere
        );
    }
}
