//! `calmwalk launch`

mod job_specs;
mod templates;

use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use orchestrator::slurm::{DesiredJobs, JobNames, JobPhase, Plan, SlurmCommands, SlurmError, plan};
use store::Location;

use self::job_specs::JobSpecs;
use super::{CommandError, ExitStatus, block_on, campaign_location};
use crate::campaign::LoadedCampaign;
use crate::config::Config;
use crate::output::{count, log_and_print, log_and_warn, print};

/// How long to wait for one command of Slurm, which itself waits for a busy slurmctld.
const COMMAND_TIMEOUT: Duration = Duration::from_secs(60);

/// Submit a campaign to a batch system, as jobs for orchestrator, agents and labellers
///
/// Safe to repeat: keeps the existing jobs, submits missing ones, and cancels agents and labellers that exceed the requested
/// numbers. Each job checkpoints and exits before its time limit, and is requeued until the campaign is finished. `calmwalk
/// status` shows the jobs. See docs/slurm.md.
#[derive(Debug, clap::Args)]
pub struct LaunchArgs {
    /// Configuration of the campaign (TOML), on a file system that all nodes share
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// Batch system
    #[arg(long, value_name = "SYSTEM", value_enum)]
    on: System,
    /// Directory of the campaign, on a file system that all nodes share [default: path of the configuration without its
    /// extension]
    #[arg(long, value_name = "DIR")]
    directory: Option<PathBuf>,
    /// Accept CONFIG for a campaign that was started with another configuration file (calmwalk refuses it otherwise)
    #[arg(long)]
    adopt: bool,
    /// As `calmwalk run --accept-reference-check`, for the check as it is now; if the protocol, the structures or the bounds
    /// change later, it must pass again
    #[arg(long)]
    accept_reference_check: bool,
    /// Number of agents, one per job
    #[arg(long, value_name = "N", required_unless_present = "stop", value_parser = clap::value_parser!(u32).range(0..=10_000))]
    agents: Option<u32>,
    /// Number of walkers per agent
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=4096))]
    walkers: u32,
    /// Number of threads per walker
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=256))]
    threads: u32,
    /// Number of jobs that compute labels; only for campaigns with a PostgreSQL store
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=10_000))]
    labellers: u32,
    /// Number of labels that each of these jobs computes at the same time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    concurrency: u32,
    /// Time limit of each job in the format of sbatch, such as 24:00:00 [default: that of the partition]
    #[arg(long, value_name = "TIME")]
    time: Option<String>,
    /// Partition of the jobs [default: that of the batch system]
    #[arg(long, value_name = "NAME")]
    partition: Option<String>,
    /// Account to charge [default: that of the user]
    #[arg(long, value_name = "NAME")]
    account: Option<String>,
    /// Directory with the certificates of the orchestrator in orchestrator/ and of the agents in agent/; required for jobs on
    /// more than one node
    #[arg(long, value_name = "DIR")]
    tls: Option<PathBuf>,
    /// Directory with your own job templates, adapted from configs/slurm [default: built-in templates]
    #[arg(long, value_name = "DIR")]
    template: Option<PathBuf>,
    /// Print the job scripts and the commands of the batch system without running them
    #[arg(long)]
    dry_run: bool,
    /// Cancel the campaign's jobs instead, so that they checkpoint and exit; launch it again to resume
    #[arg(long)]
    stop: bool,
    /// With --stop: cancel only pending jobs
    #[arg(long, requires = "stop")]
    pending: bool,
    /// Additional options of sbatch for every job, after --
    #[arg(last = true, value_name = "OPTION")]
    options: Vec<String>,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum System {
    Slurm,
}

/// Subdirectory of the campaign with the scripts and logs of its jobs.
pub const FOLDER: &str = "slurm";

/// The names of a campaign's jobs. They follow from its location, which is known before it starts.
pub fn job_names(location: &Location) -> JobNames {
    let location = match location {
        Location::Directory(directory) => directory.display().to_string(),
        Location::Server(url) => url.campaign_key(),
    };
    JobNames::new(&blake3::hash(location.as_bytes()).to_hex()[..12])
}

impl LaunchArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let System::Slurm = self.on;
        let directory = self.directory()?;
        let slurm = SlurmCommands::with_timeout(COMMAND_TIMEOUT);
        if self.stop {
            let config = Config::load(&self.config)?.config;
            let names = job_names(&config.location(&directory)?);
            block_on(self.stop(&slurm, &names))??;
        } else {
            let campaign = LoadedCampaign::load(&self.config)?;
            campaign.print_warnings();
            if self.directory.is_none() {
                block_on(campaign_location::check_former_locations(&campaign, &directory))??;
            }
            let location = campaign.config.location(&directory)?;
            if let Location::Directory(directory) = &location {
                store::check_directory(directory)?;
            }
            let (names, wanted) = (job_names(&location), self.wanted(&location));
            if wanted.labellers == 0 && campaign.config.label.concurrency == 0 {
                log_and_print(
                    "label.concurrency = 0 and no labeller jobs: start labellers with calmwalk label",
                );
            }
            let specs = JobSpecs::new(&self, &campaign, &directory, wanted)?;
            block_on(self.launch(&slurm, &names, &specs, wanted))??;
        }
        Ok(ExitStatus::Done)
    }

    /// The canonical path of the campaign's directory, from which the names of its jobs follow.
    fn directory(&self) -> Result<PathBuf, CommandError> {
        let directory =
            self.directory.clone().unwrap_or_else(|| campaign_location::default_directory(&self.config));
        let created = DirBuilder::new().recursive(true).mode(0o700).create(&directory);
        let canonical = created.and_then(|()| directory.canonicalize());
        canonical.map_err(|error| {
            CommandError::Input(format!("cannot create the directory {}: {error}", directory.display()))
        })
    }

    fn wanted(&self, location: &Location) -> DesiredJobs {
        let mut labellers = self.labellers;
        if let Location::Directory(_) = location
            && labellers > 0
        {
            log_and_print(
                "--labellers is ignored: the SQLite store of the campaign is limited to one node, where the orchestrator starts \
                 label.concurrency labellers; set run.store to a PostgreSQL database for labellers on other nodes",
            );
            labellers = 0;
        }
        DesiredJobs { agents: self.agents.unwrap_or(0), walkers: self.walkers, labellers }
    }

    async fn launch(
        &self,
        slurm: &SlurmCommands,
        names: &JobNames,
        specs: &JobSpecs,
        wanted: DesiredJobs,
    ) -> Result<(), CommandError> {
        let jobs = |error: SlurmError| match self.dry_run && error.is_missing() {
            true => Ok(Vec::new()),
            false => Err(CommandError::failed(error)),
        };
        if self.dry_run {
            let jobs = slurm.jobs(names).await.or_else(jobs)?;
            return print(|out| specs.print(out, names, &plan(&wanted, &jobs), &jobs));
        }
        let _lock = specs.lock()?;
        specs.write()?;
        let jobs = slurm.jobs(names).await.or_else(jobs)?;
        let Plan { cancel, submit } = plan(&wanted, &jobs);
        for job in jobs.iter().filter(|job| job.phase() != JobPhase::Over) {
            let action = if cancel.contains(&job.id) { "cancelled" } else { "kept" };
            print(|out| writeln!(out, "{}: job {} ({}) {action}", job.role, job.id, job.state))?;
        }
        slurm.cancel(&cancel).await.map_err(CommandError::failed)?;
        let mut orchestrator = specs.orchestrator_job(&jobs, &cancel);
        if let Some(id) = orchestrator.filter(|_| self.accept_reference_check) {
            log_and_warn(format_args!(
                "WARNING: --accept-reference-check does not reach job {id}, the orchestrator's, which exists already: end it with calmwalk \
                 launch --stop, then launch again"
            ));
        }
        for submission in &submit {
            if orchestrator.is_none() {
                specs.remove_endpoint()?;
            }
            let request = specs.request(submission.role, orchestrator);
            let role = submission.role;
            let on_full = |full: &SlurmError| {
                log_and_print(format_args!(
                    "{role}: {full}; waiting until it does. To stop waiting, press Ctrl-C and launch again later"
                ));
            };
            let id =
                slurm.submit(names, submission, &request, on_full).await.map_err(CommandError::failed)?;
            orchestrator = orchestrator.or(Some(id));
            print(|out| writeln!(out, "{}: job {id} submitted", submission.role))?;
        }
        Ok(())
    }

    async fn stop(&self, slurm: &SlurmCommands, names: &JobNames) -> Result<(), CommandError> {
        // A job of the campaign that runs this command must not wait for its own end.
        let own = std::env::var("SLURM_JOB_ID").ok().and_then(|id| id.parse().ok());
        let cancelled = if self.pending { slurm.withdraw(names).await } else { slurm.stop(names, own).await };
        let cancelled = cancelled.map_err(CommandError::failed)?;
        print(|out| writeln!(out, "{} cancelled", count(cancelled, "job")))
    }
}

/// An absolute path, valid in any working directory of a job.
fn absolute(path: &Path) -> Result<PathBuf, CommandError> {
    std::path::absolute(path).map_err(CommandError::failed)
}
