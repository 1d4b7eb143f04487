//! `calmwalk launch`

mod commands;
mod cores_of_jobs;
mod custom_scripts;
mod job_specs;
mod templates;
mod time_limit;

use std::fmt::Display;
use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use orchestrator::batch::{
    BatchError, BatchScheduler, CustomCommands, DesiredJobs, JobNames, JobPhase, Plan, SlurmCommands, plan,
};
use store::Location;

use self::job_specs::JobSpecs;
use self::time_limit::TimeLimit;
use super::{CommandError, ExitStatus, block_on, campaign_location};
use crate::campaign::LoadedCampaign;
use crate::config::Config;
use crate::output::{count, log_and_print, log_and_warn, print};

/// How long to wait for one command of the batch system; Slurm's wait for a busy slurmctld.
const COMMAND_TIMEOUT: Duration = Duration::from_secs(60);

/// Submit a campaign to a batch system, as jobs for orchestrator, agents and labellers
///
/// Safe to repeat: keeps the existing jobs, submits missing ones, and cancels agents and labellers that exceed the requested
/// numbers. Each job checkpoints and exits before its time limit, and is requeued until the campaign is finished. `calmwalk
/// status` shows the jobs. The batch system is Slurm, or one whose commands are in the table `launch.custom` of CONFIG, such as PBS
/// or LSF. See docs/slurm.md and docs/batch-systems.md.
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
    /// Accept CONFIG for a campaign that was started with another configuration file [default: refuse it]
    #[arg(long)]
    adopt: bool,
    /// Start walks although the current reference check failed (see `calmwalk run --help`). If protocol, structures or bounds change, the
    /// check must pass again
    #[arg(long)]
    accept_reference_check: bool,
    /// Number of agents, one per job
    #[arg(long, value_name = "N", required_unless_present_any = ["stop", "resubmit"], value_parser = clap::value_parser!(u32).range(0..=10_000))]
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
    /// Number of labels that each labelling job computes at the same time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    concurrency: u32,
    /// Number of GPUs of each job with walkers: the orchestrator's and the agents' (`--gres=gpu:N`, or {gpus} in a script)
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=1024))]
    gpus: u32,
    /// Memory of each job, GB [default: that of the batch system]
    #[arg(long, value_name = "GB", value_parser = bytes)]
    memory: Option<u64>,
    /// Time limit of each job, such as 24h or 24:00:00 [default: that of the partition]
    #[arg(long, value_name = "TIME")]
    time: Option<TimeLimit>,
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
    /// Submit the job again that runs this command (custom batch systems; for job scripts)
    #[arg(long, hide = true, conflicts_with = "stop")]
    resubmit: bool,
    /// Print the job scripts and the commands of the batch system without running them
    #[arg(long)]
    dry_run: bool,
    /// Cancel the campaign's jobs, so that they checkpoint and exit; launch the campaign again to resume
    #[arg(long)]
    stop: bool,
    /// With --stop: cancel only pending jobs
    #[arg(long, requires = "stop")]
    pending: bool,
    /// Additional options of sbatch for every job, after --
    #[arg(last = true, value_name = "OPTION")]
    options: Vec<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum System {
    Slurm,
    /// The batch system that the table `launch.custom` describes
    Custom,
}

/// Subdirectory of the campaign with the scripts and logs of its Slurm jobs.
pub const FOLDER: &str = "slurm";
/// The same for jobs of a custom batch system, with the file of its jobs.
pub const CUSTOM_FOLDER: &str = "jobs";

impl System {
    /// The subdirectory of the campaign.
    fn folder(self) -> &'static str {
        match self {
            Self::Slurm => FOLDER,
            Self::Custom => CUSTOM_FOLDER,
        }
    }
}

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
        let directory = self.directory()?;
        if self.stop || self.resubmit {
            let config = Config::load(&self.config)?.config;
            let names = job_names(&config.location(&directory)?);
            let scheduler = self.scheduler(&config, &directory)?;
            match self.stop {
                true => block_on(self.stop(&scheduler, &names))??,
                false => block_on(self.submit_again(&scheduler, &names, &directory))??,
            }
        } else {
            self.check_options()?;
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
            let scheduler = self.scheduler(&campaign.config, &directory)?;
            let specs = JobSpecs::new(&self, &campaign, &directory, wanted, &names, &scheduler)?;
            block_on(self.launch(&scheduler, &names, &specs, wanted))??;
        }
        Ok(ExitStatus::Done)
    }

    /// The batch system on this host.
    fn scheduler(&self, config: &Config, directory: &Path) -> Result<BatchScheduler, CommandError> {
        match self.on {
            System::Slurm => Ok(BatchScheduler::Slurm(SlurmCommands::with_timeout(COMMAND_TIMEOUT))),
            System::Custom => {
                let custom = config.launch.as_ref().and_then(|launch| launch.custom.clone());
                let custom = custom.ok_or_else(|| {
                    CommandError::Input(format!(
                        "--on custom: {} has no table [launch.custom] with the commands of the batch system; configs/pbs.toml \
                         and configs/lsf.toml have one (docs/batch-systems.md)",
                        self.config.display()
                    ))
                })?;
                let folder = directory.join(CUSTOM_FOLDER);
                let commands = CustomCommands::new(custom, &folder, COMMAND_TIMEOUT);
                Ok(BatchScheduler::Custom(Box::new(commands)))
            }
        }
    }

    /// Refuses options that only Slurm has.
    fn check_options(&self) -> Result<(), CommandError> {
        if self.on == System::Slurm {
            return Ok(());
        }
        let of_slurm = [
            ("--partition", self.partition.is_some()),
            ("--account", self.account.is_some()),
            ("--template", self.template.is_some()),
            ("an option after --", !self.options.is_empty()),
        ];
        match of_slurm.iter().find(|(_, given)| *given) {
            Some((option, _)) => Err(CommandError::Input(format!(
                "{option} is for --on slurm; with --on custom, write what it says into launch.custom.script of {}",
                self.config.display()
            ))),
            None => Ok(()),
        }
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
        scheduler: &BatchScheduler,
        names: &JobNames,
        specs: &JobSpecs,
        wanted: DesiredJobs,
    ) -> Result<(), CommandError> {
        let jobs = |error: BatchError| match self.dry_run && error.is_missing() {
            true => Ok(Vec::new()),
            false => Err(CommandError::failed(error)),
        };
        if self.dry_run {
            let jobs = scheduler.jobs(names).await.or_else(jobs)?;
            let shown = specs.shown(scheduler, names, &plan(&wanted, &jobs), &jobs)?;
            return print(|out| out.write_all(shown.as_bytes()));
        }
        let _lock = job_specs::lock(specs.folder())?;
        specs.write()?;
        if let BatchScheduler::Custom(commands) = scheduler {
            commands.allow().map_err(CommandError::failed)?;
        }
        let jobs = scheduler.jobs(names).await.or_else(jobs)?;
        let Plan { cancel, submit } = plan(&wanted, &jobs);
        for job in jobs.iter().filter(|job| job.phase() != JobPhase::Over) {
            let action = if cancel.contains(&job.id) { "cancelled" } else { "kept" };
            print(|out| writeln!(out, "{}: job {} ({}) {action}", job.role, job.id, job.state))?;
        }
        scheduler.cancel(&cancel).await.map_err(CommandError::failed)?;
        let mut orchestrator = specs.orchestrator_job(&jobs, &cancel);
        if let Some(id) = orchestrator.as_ref().filter(|_| self.accept_reference_check) {
            log_and_warn(format_args!(
                "WARNING: --accept-reference-check does not reach job {id}, the orchestrator's, which exists already: end it with calmwalk \
                 launch --stop, then launch again"
            ));
        }
        for submission in &submit {
            if orchestrator.is_none() {
                specs.remove_endpoint()?;
            }
            let request = specs.request(submission.role, orchestrator.clone());
            let role = submission.role;
            let on_full = |full: &dyn Display| {
                log_and_print(format_args!(
                    "{role}: {full}; waiting until it does. To stop waiting, press Ctrl-C and launch again later"
                ));
            };
            let submitted = scheduler.submit(names, submission, &request, on_full).await;
            let id = submitted.map_err(CommandError::failed)?;
            print(|out| writeln!(out, "{}: job {id} submitted", submission.role))?;
            orchestrator = orchestrator.or(Some(id));
        }
        Ok(())
    }

    async fn stop(&self, scheduler: &BatchScheduler, names: &JobNames) -> Result<(), CommandError> {
        // A job of the campaign that runs this command must not wait for its own end.
        let own = scheduler.own_job(names);
        if let BatchScheduler::Custom(commands) = scheduler
            && (!self.pending || own.is_some())
        {
            commands.forbid().map_err(CommandError::failed)?;
        }
        let cancelled =
            if self.pending { scheduler.withdraw(names).await } else { scheduler.stop(names, own).await };
        let cancelled = cancelled.map_err(CommandError::failed)?;
        print(|out| writeln!(out, "{} cancelled", count(cancelled, "job")))
    }

    /// Submits the job again in which this command runs.
    async fn submit_again(
        &self,
        scheduler: &BatchScheduler,
        names: &JobNames,
        directory: &Path,
    ) -> Result<(), CommandError> {
        let own = scheduler.own_job(names);
        let BatchScheduler::Custom(commands) = scheduler else {
            return Err(CommandError::Input("--resubmit is for --on custom: Slurm requeues jobs".to_owned()));
        };
        if own.is_none() {
            let message =
                "--resubmit: this is no job of the campaign, expected the name of one in CALMWALK_JOB";
            return Err(CommandError::Input(message.to_owned()));
        }
        let folder = directory.join(CUSTOM_FOLDER);
        let _lock = job_specs::lock(&folder)?;
        let script = |role| folder.join(custom_scripts::job_file(role));
        let submitted = commands.submit_again(names, script).await.map_err(CommandError::failed)?;
        print(|out| match submitted {
            Some(id) => writeln!(out, "submitted again as job {id}"),
            None => writeln!(out, "not submitted again: the campaign's jobs were stopped"),
        })
    }
}

/// Bytes of a number of GB.
fn bytes(text: &str) -> Result<u64, String> {
    const GIGABYTE: f64 = 1e9;
    let number = text.parse::<f64>().ok().filter(|number| *number > 0.0 && *number <= 1e6);
    let number = number.ok_or("expected a number of GB, above 0, at most 1e6")?;
    Ok((number * GIGABYTE).ceil() as u64)
}

/// An absolute path, valid in any working directory of a job.
fn absolute(path: &Path) -> Result<PathBuf, CommandError> {
    std::path::absolute(path).map_err(CommandError::failed)
}
