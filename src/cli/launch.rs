//! `calmwalk launch`

mod order;
mod scripts;

use std::fs::DirBuilder;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use orchestrator::slurm::{DesiredJobs, JobNames, Phase, Plan, Slurm, SlurmError, plan};
use store::Location;

use self::order::Order;
use super::{Ended, Failure, block_on, place};
use crate::campaign::Campaign;
use crate::config::Config;
use crate::output::{count, print, say};

/// Slurm's commands wait for a busy slurmctld themselves; longer than this is of no use.
const PATIENCE: Duration = Duration::from_secs(60);

/// Submit a whole campaign to a batch system: orchestrator, agents, labellers
///
/// Safe to repeat: what is there already stays, what is missing is submitted, agents and labellers that are not asked for any
/// more are cancelled. Jobs leave in order before their time is over and are requeued, until the campaign is done.
/// docs/slurm.md has it all; calmwalk status shows the jobs.
#[derive(Debug, clap::Args)]
pub struct Launch {
    /// Configuration of the campaign, on a file system that all nodes see
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// The batch system
    #[arg(long, value_name = "SYSTEM", value_enum)]
    on: System,
    /// Directory of the campaign, also seen by all nodes [default: beside the configuration, with its name but no extension]
    #[arg(long, value_name = "DIR")]
    directory: Option<PathBuf>,
    /// Go on with a campaign that belongs to another configuration file: this one takes its place
    #[arg(long)]
    adopt: bool,
    /// Jobs with an agent
    #[arg(long, value_name = "N", required_unless_present = "stop", value_parser = clap::value_parser!(u32).range(0..=10_000))]
    agents: Option<u32>,
    /// Walkers of each agent
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=4096))]
    walkers: u32,
    /// Threads of each walker
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=256))]
    threads: u32,
    /// Jobs with labellers, for a campaign whose store is PostgreSQL
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=10_000))]
    labellers: u32,
    /// Labels that each of them makes side by side
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    slots: u32,
    /// Time limit of a job, as sbatch takes it: 24:00:00
    #[arg(long, value_name = "TIME")]
    time: Option<String>,
    /// Partition to submit to
    #[arg(long, value_name = "NAME")]
    partition: Option<String>,
    /// Account to charge
    #[arg(long, value_name = "NAME")]
    account: Option<String>,
    /// Directory with the certificates of orchestrator and agents, in orchestrator/ and agent/: needed for more than one node
    #[arg(long, value_name = "DIR")]
    tls: Option<PathBuf>,
    /// A copy of configs/slurm with what your site needs
    #[arg(long, value_name = "DIR")]
    template: Option<PathBuf>,
    /// Print what would be written and submitted, and do nothing
    #[arg(long)]
    dry_run: bool,
    /// End the campaign's jobs in order instead; the same launch goes on with it
    #[arg(long)]
    stop: bool,
    /// With --stop: only jobs that have not begun
    #[arg(long, requires = "stop")]
    waiting: bool,
    /// Further options of sbatch, for every job
    #[arg(last = true, value_name = "OPTION")]
    options: Vec<String>,
}

#[derive(Clone, Copy, Debug, clap::ValueEnum)]
enum System {
    Slurm,
}

/// Scripts and logs of a campaign's jobs, in its directory.
pub const FOLDER: &str = "slurm";

/// How the jobs of a campaign are called: after the place where it is kept, which is there before it begins.
pub fn job_names(location: &Location) -> JobNames {
    let place = match location {
        Location::Directory(directory) => directory.display().to_string(),
        Location::Server(url) => url.place(),
    };
    JobNames::new(&blake3::hash(place.as_bytes()).to_hex()[..12])
}

impl Launch {
    pub fn run(self) -> Result<Ended, Failure> {
        let System::Slurm = self.on;
        let directory = self.directory()?;
        let slurm = Slurm::with_timeout(PATIENCE);
        if self.stop {
            let config = Config::load(&self.config)?.config;
            let names = job_names(&config.location(&directory)?);
            block_on(self.stop(&slurm, &names))??;
        } else {
            let campaign = Campaign::load(&self.config)?;
            if self.directory.is_none() {
                block_on(place::refuse_if_kept_elsewhere(&campaign, &directory))??;
            }
            let location = campaign.config.location(&directory)?;
            if let Location::Directory(directory) = &location {
                store::check_directory(directory)?;
            }
            let (names, wanted) = (job_names(&location), self.wanted(&location));
            if wanted.labellers == 0 && campaign.config.label.slots == 0 {
                say("label.slots = 0 and no job for labellers: labels have to come from calmwalk label");
            }
            let order = Order::new(&self, &campaign, &directory, wanted)?;
            block_on(self.launch(&slurm, &names, &order, wanted))??;
        }
        Ok(Ended::Done)
    }

    /// The campaign's directory, by its one true name, since jobs are known by it.
    fn directory(&self) -> Result<PathBuf, Failure> {
        let directory = self.directory.clone().unwrap_or_else(|| place::default_directory(&self.config));
        let made = DirBuilder::new().recursive(true).mode(0o700).create(&directory);
        let made = made.and_then(|()| directory.canonicalize());
        made.map_err(|error| {
            Failure::Input(format!("cannot make the directory {}: {error}", directory.display()))
        })
    }

    fn wanted(&self, location: &Location) -> DesiredJobs {
        let mut labellers = self.labellers;
        if let Location::Directory(_) = location
            && labellers > 0
        {
            say(
                "the campaign is kept in SQLite, which serves one node: labels are made beside the orchestrator \
                 (label.slots of them side by side), and no job for labellers is submitted; PostgreSQL (run.store) \
                 serves many",
            );
            labellers = 0;
        }
        DesiredJobs { agents: self.agents.unwrap_or(0), walkers: self.walkers, labellers }
    }

    async fn launch(
        &self,
        slurm: &Slurm,
        names: &JobNames,
        order: &Order,
        wanted: DesiredJobs,
    ) -> Result<(), Failure> {
        let jobs = |error: SlurmError| match self.dry_run && error.is_missing() {
            true => Ok(Vec::new()),
            false => Err(Failure::failed(error)),
        };
        if self.dry_run {
            let jobs = slurm.jobs(names).await.or_else(jobs)?;
            return print(|out| order.show(out, names, &plan(&wanted, &jobs), &jobs));
        }
        let _lock = order.lock()?;
        order.write()?;
        let jobs = slurm.jobs(names).await.or_else(jobs)?;
        let Plan { cancel, submit } = plan(&wanted, &jobs);
        for job in jobs.iter().filter(|job| job.phase() != Phase::Over) {
            let becomes = if cancel.contains(&job.id) { "is cancelled" } else { "is there" };
            print(|out| writeln!(out, "{}: job {} ({}) {becomes}", job.role, job.id, job.state))?;
        }
        slurm.cancel(&cancel).await.map_err(Failure::failed)?;
        let mut leader = order.leader(&jobs, &cancel);
        for submission in &submit {
            if leader.is_none() {
                order.forget_the_end()?;
            }
            let request = order.request(submission.role, leader);
            let id = slurm.submit(names, submission, &request).await.map_err(Failure::failed)?;
            leader = leader.or(Some(id));
            print(|out| writeln!(out, "{}: job {id} submitted", submission.role))?;
        }
        Ok(())
    }

    async fn stop(&self, slurm: &Slurm, names: &JobNames) -> Result<(), Failure> {
        // Called from a job of the campaign it does not wait for its own end.
        let own = std::env::var("SLURM_JOB_ID").ok().and_then(|id| id.parse().ok());
        let ended = if self.waiting { slurm.withdraw(names).await } else { slurm.stop(names, own).await };
        let ended = ended.map_err(Failure::failed)?;
        print(|out| writeln!(out, "{} cancelled", count(ended, "job")))
    }
}

/// A path that holds for jobs, wherever they begin.
fn absolute(path: &Path) -> Result<PathBuf, Failure> {
    std::path::absolute(path).map_err(Failure::failed)
}
