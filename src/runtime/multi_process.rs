//! Runs a campaign with walkers and labellers in separate processes, and restarts them when they fail.
//!
//! Walkers end with this process. Labellers outlive it, and the next run adopts them.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use calm::Mixture;
use orchestrator::launcher::Children;
use orchestrator::reactor;
use orchestrator::selector::Selector;
use orchestrator::supervisor::Limits;
use store::ProcessRecord;
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinHandle};
use tokio::time::{Sleep, sleep};
use tokio_util::sync::CancellationToken;
use wire::net::StopTokens;
use wire::shm_dir::ShmDir;

use super::agent_service::AgentService;
use super::device_watch::{self, DeviceWatch, LABELS_GO_ON};
use super::label_order::CompletionModels;
use super::process_manager::{self, ProcessManager};
use super::walker_host::{HostMemory, HostMixtures, HostSizes, walker_launcher};
use super::{CHANNEL, ReactorTask, RunContext, spawn, start_reactor, wanted_walkers};
use crate::campaign::LoadedCampaign;
use crate::exit_status::CommandError;

/// Time that the last writes to the database may take after all processes have ended.
const DATABASE_TIMEOUT: Duration = Duration::from_secs(60);
/// Heartbeat timeout of labellers: they write heartbeats to the database, which may be busy for a while.
pub const LABELLER_TIMEOUT: Duration = Duration::from_secs(60);

/// Runs the campaign until it is finished or stopped.
///
/// Await this on the main thread: the walkers end with the thread that starts them.
pub async fn run(
    run: RunContext<'_>,
    selector: Selector,
    completion: CompletionModels,
) -> Result<reactor::RunOutcome, CommandError> {
    let place = ShmDir::for_campaign(run.directory).map_err(CommandError::failed)?;
    let ended = run_in(&place, run, selector, completion).await;
    // No process needs the shared memory any more. The next start removes what cannot be removed now.
    let removed = place.remove().map_err(CommandError::failed);
    let ended = ended?;
    removed?;
    Ok(ended)
}

/// Shared memory that a campaign needs when it starts, bytes.
pub fn shared_memory_needed(campaign: &LoadedCampaign, mixture: &Mixture) -> Result<u64, CommandError> {
    host_sizes(campaign).space_needed(mixture)
}

fn host_sizes(campaign: &LoadedCampaign) -> HostSizes {
    HostSizes {
        walkers: wanted_walkers(&campaign.config),
        message_bytes: campaign.largest_message(),
        devices: campaign.model.devices().len(),
    }
}

async fn run_in(
    place: &ShmDir,
    run: RunContext<'_>,
    selector: Selector,
    completion: CompletionModels,
) -> Result<reactor::RunOutcome, CommandError> {
    let RunContext { campaign, store, process, .. } = run;
    let (mixture, original) = (Arc::clone(selector.mixture()), Arc::clone(selector.original()));
    let (devices, mixtures) =
        (campaign.model.devices(), HostMixtures { newest: &mixture, original: &original });
    let session = new_session(process);
    let memory = HostMemory::open(place, host_sizes(campaign), mixtures, session, devices)?;
    let (model, addresses) = (campaign.walker_model()?, memory.addresses());
    let HostMemory { prepared: _prepared, mixture: shared, server, calls: _calls } = memory;
    // The manager cancels it too, when the run cannot continue.
    let stopping = run.stop.child_token();
    let limits = Limits {
        heartbeat_timeout: campaign.config.walker_heartbeat_timeout(),
        max_restarts: campaign.config.run.max_restarts,
        ..Limits::default()
    };
    let line = server.handle();
    let threads = campaign.config.run.threads_per_walker.get();
    let launch = walker_launcher(model, addresses, threads, campaign.walk_settings(), line.clone());
    let walkers = Children::new(wanted_walkers(&campaign.config), limits, launch);
    let limits = Limits {
        heartbeat_timeout: campaign.config.run.heartbeat_timeout.get().max(LABELLER_TIMEOUT),
        detached: true,
        ..limits
    };
    let labellers = spawn::start_labellers(run, limits).await?;
    let manager = ProcessManager::new(store, process.clone(), line, walkers, labellers, stopping.clone());

    let (to_reactor, incoming) = mpsc::channel(CHANNEL);
    let local = server.run(shared, to_reactor.clone(), manager.listener());
    let agents = AgentService::open(run, session, mixtures).await?;
    let no_more_work = CancellationToken::new();
    let walks = stopping.child_token();
    // Agents stop too when walks cannot continue here: with a later run, they join again.
    let tokens = StopTokens { stopping: walks.clone(), closing: no_more_work.clone() };
    let remote = agents.run(tokens, to_reactor);
    let serving = tokio::spawn(async {
        tokio::try_join!(async { local.await.map_err(CommandError::failed) }, remote).map(|_| ())
    });
    let _watch = DeviceWatch::start(devices, Some(store), &walks, LABELS_GO_ON);
    let reactor = start_reactor(run, selector, incoming, walks, completion);
    supervise(manager, reactor, no_more_work, serving, run).await
}

/// Distinguishes the walkers of this run, with one version of the potential, from those of any other run and version. An agent that was
/// lost with one version may return with the next: its slots have the numbers of those that another agent has got meanwhile.
fn new_session(process: &ProcessRecord) -> u64 {
    static SESSIONS: AtomicU64 = AtomicU64::new(0);
    let number = SESSIONS.fetch_add(1, Ordering::Relaxed);
    let hash = blake3::hash(format!("{} {number}", process.id).as_bytes());
    let [a, b, c, d, e, f, g, h, ..] = *hash.as_bytes();
    u64::from_le_bytes([a, b, c, d, e, f, g, h])
}

/// An event of the main loop.
enum ManagerEvent {
    /// From a child process.
    Process(process_manager::Event),
    /// A stop was requested.
    StopRequested,
    /// The reactor has ended.
    ReactorEnded(Result<reactor::RunOutcome, CommandError>),
    /// The transport has ended.
    TransportEnded(Result<(), CommandError>),
}

/// Supervises the processes until all walks are over and every structure has its label, or until a stop is requested.
/// Then waits until all processes have ended.
async fn supervise(
    mut manager: ProcessManager<'_>,
    mut reactor: ReactorTask,
    no_more_work: CancellationToken,
    mut serving: JoinHandle<Result<(), CommandError>>,
    RunContext { stop, superseded, campaign, .. }: RunContext<'_>,
) -> Result<reactor::RunOutcome, CommandError> {
    let (mut reactor_result, mut transport_result, mut stop_requested) = (None, None, false);
    let mut database_deadline = None;
    while reactor_result.is_none() || transport_result.is_none() || !manager.has_ended() {
        if stop_requested && reactor_result.is_none() && manager.has_ended() {
            database_deadline.get_or_insert_with(|| Box::pin(sleep(DATABASE_TIMEOUT)));
        }
        let event = tokio::select! {
            () = expired(&mut database_deadline) => return Err(database_unreachable()),
            event = manager.next_event() => ManagerEvent::Process(event),
            () = stop.cancelled(), if !stop_requested => ManagerEvent::StopRequested,
            ended = &mut reactor, if reactor_result.is_none() => ManagerEvent::ReactorEnded(flatten(ended)),
            ended = &mut serving, if transport_result.is_none() => ManagerEvent::TransportEnded(flatten(ended)),
        };
        match event {
            ManagerEvent::Process(event) => manager.handle(event).await,
            ManagerEvent::StopRequested => {
                stop_requested = true;
                manager.stop();
            }
            ManagerEvent::ReactorEnded(ended) => {
                no_more_work.cancel();
                match ended {
                    // The walks of the newer version do not wait for the labels of those that made room.
                    Ok(reactor::RunOutcome::Finished) if !superseded.is_cancelled() => {
                        manager.wait_for_labels();
                    }
                    Ok(reactor::RunOutcome::Stopped)
                        if !stop_requested
                            && device_watch::last_failure(campaign.model.devices()).is_some() =>
                    {
                        manager.wait_for_labels();
                    }
                    _ => manager.stop(),
                }
                reactor_result = Some(ended);
            }
            ManagerEvent::TransportEnded(ended) => {
                if ended.is_err() {
                    manager.stop();
                }
                transport_result = Some(ended);
            }
        }
    }
    transport_result.transpose()?;
    manager.failure()?;
    match reactor_result.transpose()? {
        Some(reactor::RunOutcome::Finished) if !stop_requested => Ok(reactor::RunOutcome::Finished),
        // Every walk may be over, but the labellers were asked to stop and may have left jobs.
        _ => Ok(reactor::RunOutcome::Stopped),
    }
}

/// Waits until the deadline, if there is one.
async fn expired(time: &mut Option<Pin<Box<Sleep>>>) {
    match time {
        Some(time) => time.await,
        None => std::future::pending().await,
    }
}

fn database_unreachable() -> CommandError {
    CommandError::Failed(format!(
        "stopping, but the database has not answered for {} s: walks keep their last checkpoints; run the same command to continue the campaign",
        DATABASE_TIMEOUT.as_secs()
    ))
}

/// The result of a task. A panic is a failure too.
fn flatten<T>(ended: Result<Result<T, impl ToString>, JoinError>) -> Result<T, CommandError> {
    ended.map_err(CommandError::failed)?.map_err(CommandError::failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn walks_of_each_version_have_a_session_of_their_own() {
        let process = ProcessRecord::new(ProcessRecord::ORCHESTRATOR, None, 7, 0);
        assert_ne!(new_session(&process), new_session(&process));
    }
}
