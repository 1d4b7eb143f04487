//! Runs a campaign: walkers and labellers in separate processes, or everything in one process.

pub mod agent_host;
pub mod agent_model;
mod agent_service;
pub mod campaign_watch;
mod db_status;
mod device_watch;
mod label_order;
pub mod label_pool;
mod labellers;
mod listen;
mod multi_process;
pub mod notify;
mod process_manager;
mod process_records;
pub mod reference_check;
pub mod refit_process;
pub mod scratch_dir;
mod single_process;
mod spawn;
mod throughput;
pub mod time_budget;
pub mod version_loop;
mod walker_host;

use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::thread;

use monitor::walk_ends::WalkEnds;
use orchestrator::reactor::{self, Notice, Reactor};
use orchestrator::selector::{CampaignMode, Selector};
use store::{ProcessRecord, SERVER_RECONNECT_TIMEOUT, Store, unix_milliseconds};
use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;
use wire::transport::Incoming;

use self::label_order::{CompletionModels, LabelOrderTask};
use self::throughput::Throughput;
use crate::campaign::LoadedCampaign;
use crate::config::{Config, QueueFull};
use crate::exit_status::CommandError;
use crate::forgetting::ForgettingRule;
use crate::label_line::LabelLine;
use crate::output::count;
use crate::progress::RunDisplay;
use crate::python_model;
pub use listen::Listen;
pub use multi_process::shared_memory_needed;

/// Capacity of the channel of reports from walkers to the reactor.
const CHANNEL: usize = 64;

/// What a run of a campaign needs.
#[derive(Clone, Copy)]
pub struct RunContext<'a> {
    /// The configuration and the files that it names, loaded.
    pub campaign: &'a LoadedCampaign,
    /// The campaign's database.
    pub store: &'a Store,
    /// The database record of this process.
    pub process: &'a ProcessRecord,
    /// The campaign's directory.
    pub directory: &'a Path,
    /// Where agents of other hosts may join.
    pub listen: Option<&'a Listen>,
    /// The line about labels that are being made.
    pub labels: &'a LabelLine,
    /// Cancelled to stop the run: by a signal, or when a time limit is reached.
    pub stop: &'a CancellationToken,
    /// Cancelled when walks make room for those of a newer version of the potential, which do not wait for labels.
    pub superseded: &'a CancellationToken,
    /// Cancelled with [`Self::superseded`], and when the last version is there, with which no walk starts: biased walks end.
    pub walks_end: &'a CancellationToken,
}

/// How a campaign is run, besides its [`RunContext`].
#[derive(Clone, Copy, Debug)]
pub struct RunMode<'a> {
    /// Everything in one process.
    pub in_process: bool,
    /// The reference check whose differences from the reference the user accepts.
    pub accepted_check: Option<&'a str>,
}

/// Printed when a campaign is asked to stop.
const STOP_MESSAGE: &str = "stopping: walks are checkpointed …";

/// Checks the reference, and runs the walks with one version of the potential until all have ended, each structure has its label,
/// or a stop is requested.
///
/// Await this on the main thread: the walkers end with the thread that starts them.
async fn run_walks(
    run: RunContext<'_>,
    selector: Selector,
    mode: RunMode<'_>,
) -> Result<reactor::RunOutcome, CommandError> {
    let go_on = tokio::select! {
        go_on = reference_check::run(run, mode.accepted_check) => go_on?,
        never = single_process::write_heartbeats(run.store.clone(), run.process.clone()) => match never {},
    };
    if !go_on {
        return Ok(reactor::RunOutcome::Stopped);
    }
    let RunContext { campaign, .. } = run;
    let devices = campaign.model.devices();
    if let Some(largest) = campaign.largest_seed_structure() {
        let (skin, walkers) = (campaign.config.walk.skin.get(), wanted_walkers(&campaign.config));
        let max_batch = campaign.config.potential.python.as_ref().map_or(1, |python| python.max_batch.get());
        let same_bits = campaign.config.campaign.mode == CampaignMode::Reproducible && max_batch > 1;
        python_model::warm_up(devices, largest, skin, walkers, same_bits).await?;
    }
    let order = LabelOrderTask::start(run).await?;
    let completion = order.completion.clone();
    let ended = match mode.in_process {
        true => single_process::run(run, selector, completion).await,
        false => multi_process::run(run, selector, completion).await,
    };
    match device_watch::last_failure(devices) {
        Some(failure) => Err(CommandError::Failed(format!(
            "walks ended because {failure}\nwalks keep their checkpoints: run the same command to continue the campaign"
        ))),
        None => ended,
    }
}

/// The task that runs the reactor.
type ReactorTask = tokio::task::JoinHandle<Result<reactor::RunOutcome, reactor::ReactorError>>;

/// Starts the reactor and displays its progress.
fn start_reactor(
    run: RunContext<'_>,
    mut selector: Selector,
    incoming: mpsc::Receiver<Incoming>,
    stopping: CancellationToken,
    completion: CompletionModels,
) -> ReactorTask {
    let config = &run.campaign.config;
    let walk_steps = config.walk.equilibration_steps + config.walk.biased_steps.get();
    let mut ends = WalkEnds::default();
    selector.ended_walks().for_each(|(walk, end, reason)| ends.add(walk.0, end, reason));
    let (walks, forgetting) = (selector.walk_progress(walk_steps), ForgettingRule::new(&config.calm));
    let mut display =
        RunDisplay::new(walk_steps, walks, ends, forgetting, run.stop.clone(), run.labels.clone());
    let queue_limit = u64::from(config.label.queue_limit.get());
    if config.label.on_queue_full == QueueFull::Raise {
        selector.raise_threshold_above(queue_limit);
    }
    if let Some(least) = config.collect.min_completion_probability {
        selector.decline_unlikely(least.get());
    }
    let reactor = Reactor {
        selector,
        store: run.store.clone().with_reconnect_timeout(SERVER_RECONNECT_TIMEOUT),
        incoming,
        stopping,
        walks_end: run.walks_end.clone(),
        queue_limit,
        completion,
    };
    let (store, throughput) = (run.store.clone(), Mutex::new(Throughput::default()));
    tokio::spawn(async move {
        let watch = |notice: Notice<'_>| {
            throughput.lock().unwrap_or_else(PoisonError::into_inner).notice(&notice, unix_milliseconds());
            display.notice(&notice);
        };
        let ended = tokio::select! {
            ended = reactor.run(watch) => ended,
            never = throughput::record(&store, &throughput) => match never {},
        };
        display.finish();
        ended
    })
}

/// Number of walkers to run in parallel, from the configuration.
pub fn wanted_walkers(config: &Config) -> u32 {
    match config.run.walkers {
        0 => (cores() / config.run.threads_per_walker.get() as u32).max(1),
        wanted => wanted as u32,
    }
}

/// A sentence about walkers that can have nothing to do, if there are any: rounds, or the campaign, have too few walks for
/// them. A control walk begins after its biased walk, so never more walks are under way than there are biased ones.
pub fn idle_walkers(campaign: &LoadedCampaign) -> Option<String> {
    let Config { campaign: section, run, .. } = &campaign.config;
    let walkers = wanted_walkers(&campaign.config) as usize;
    let biased: usize = campaign.seed_structures.iter().map(|named| named.plan.walks.len()).sum();
    let of_round = match section.mode {
        CampaignMode::Reproducible => {
            run.walks_per_round.get().saturating_mul(1 + usize::from(section.control))
        }
        CampaignMode::Live => usize::MAX,
    };
    let (walks, limit) = if biased < of_round {
        let control = if section.control { ", each followed by its control walk" } else { "" };
        (biased, format!("the campaign has {}{control}", count(biased, "biased walk")))
    } else {
        let control = if section.control { ", and as many control walks" } else { "" };
        let round = count(run.walks_per_round.get(), "biased walk");
        (of_round, format!("a round has {round} (run.walks_per_round){control}"))
    };
    (walkers > walks)
        .then(|| format!("at most {walks} of the {walkers} walkers have something to do at a time: {limit}"))
}

/// Number of processor cores that this process may use.
pub fn cores() -> u32 {
    let there = thread::available_parallelism().map_or(1, |cores| cores.get()) as u32;
    // Not every batch system confines a job to its allocated cores.
    let given = std::env::var("SLURM_CPUS_PER_TASK").ok().and_then(|text| text.parse().ok());
    given.map_or(there, |given: u32| given.clamp(1, there))
}
