//! Runs an agent: starts walkers as processes on this host and connects them to the orchestrator on another.

use std::fs;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use calm::Mixture;
use futures_util::FutureExt;
use orchestrator::launcher::{self, Children, Launch};
use orchestrator::supervisor::{ChildState, Limits};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;
use wire::ipc::{self, IpcError, IpcServer, Sizes, space_needed};
use wire::mixture::SharedMixture;
use wire::net::{self, Address, AgentClient, LinkError, Membership, NetError, Tls};
use wire::shm_dir::ShmDir;
use wire::transport::Incoming;
use workers::agent::{self, Agent, OrchestratorEvent};

use super::process_manager::all_failed_message;
use super::{CHANNEL, STOP_MESSAGE};
use crate::exit_status::{CommandError, ExitStatus};
use crate::file_hash::verify_hash;
use crate::log;
use crate::output::{count, log_and_print, log_and_warn};
use crate::process_config::{self, AgentConfig, HashedFile, ModelFiles, WalkerConfig, WalkerModel};
use crate::signals::cancel_on_signal;
use crate::web::agent_metrics::AgentState;

/// Interval at which the walkers' states are published for the agent's metrics.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);

/// How an agent works.
#[derive(Clone, Debug)]
pub struct AgentSettings<'a> {
    /// Where the orchestrator is.
    pub address: &'a Address,
    /// Certificates.
    pub tls: Option<&'a Tls>,
    /// This agent.
    pub agent: net::AgentInfo,
    /// Threads of each walker.
    pub threads: usize,
    /// How long it waits for an orchestrator.
    pub timeout: Duration,
    /// Where temporary files are kept.
    pub directory: &'a Path,
}

/// Works for a campaign until it is over or this process is asked to stop, with one version of the potential after the other.
///
/// Await this on the main thread: the walkers end with the thread that starts them.
pub async fn run(settings: &AgentSettings<'_>, state: &AgentState) -> Result<ExitStatus, CommandError> {
    let stop = CancellationToken::new();
    cancel_on_signal(stop.clone(), STOP_MESSAGE)?;
    loop {
        let (ended, has_versions) = run_version(settings, state, &stop).await?;
        if ended != ExitStatus::Done || !has_versions {
            return Ok(ended);
        }
        log_and_print("no more walks with this version of the potential: waiting for the next one");
    }
}

/// Works with one version of the potential. Returns whether there may be another one.
async fn run_version(
    settings: &AgentSettings<'_>,
    state: &AgentState,
    stop: &CancellationToken,
) -> Result<(ExitStatus, bool), CommandError> {
    let AgentSettings { address, tls, agent, threads, timeout, directory } = settings;
    let (agent, threads, timeout) = (agent.clone(), *threads, *timeout);
    let walkers = agent.walkers;
    let (client, joined, setup) = tokio::select! {
        joined = join(address, *tls, agent, directory) => joined?,
        () = stop.cancelled() => return Ok((ExitStatus::Interrupted, false)),
        () = address.wait_until_over() => {
            log_and_print("the campaign is over");
            return Ok((ExitStatus::Done, false));
        }
        () = tokio::time::sleep(timeout) => {
            let minutes = timeout.as_secs_f64() / 60.0;
            return Err(CommandError::Failed(format!("no orchestrator has answered at {address} for {minutes:.1} min")));
        }
    };
    log_and_print(format_args!(
        "joined: {}, mixture version {}",
        count(walkers, "walker"),
        joined.newest().await.version()
    ));
    let shm_dir = ShmDir::for_campaign(directory).map_err(CommandError::failed)?;
    let mixture = joined.newest().await;
    let (stopping, asked) = (stop.clone(), stop.clone());
    let metrics = Arc::clone(&state.metrics);
    let dispatch = |incoming| {
        tokio::spawn(Agent { client, joined, incoming, stopping, orchestrator_timeout: timeout, metrics }.run(move |event| match event {
            OrchestratorEvent::Stop => asked.cancel(),
            OrchestratorEvent::Unresponsive { unsent, idle } => log_and_warn(format_args!(
                "the orchestrator does not answer: {unsent} unsent reports, {idle} of {walkers} walkers idle"
            )),
            OrchestratorEvent::Recovered => log_and_print("the orchestrator answers again"),
        }))
    };
    let ended = run_in(&shm_dir, &setup, (walkers, threads), &mixture, dispatch, stop, state).await;
    let removed = shm_dir.remove().map_err(CommandError::failed);
    let ended = ended?;
    removed?;
    Ok((ended, setup.has_versions))
}

/// Waits until the orchestrator admits this agent, and loads what the walkers need.
async fn join(
    address: &Address,
    tls: Option<&Tls>,
    agent: net::AgentInfo,
    directory: &Path,
) -> Result<(Arc<AgentClient>, Membership, AgentConfig), CommandError> {
    let waiting = |why: &NetError| log_and_warn(format_args!("waiting for the orchestrator: {why}"));
    let client = AgentClient::open(address, tls, agent, waiting).await.map_err(CommandError::input)?;
    let client = Arc::new(client);
    loop {
        let joined = client.join().await.map_err(CommandError::failed)?;
        let setup: AgentConfig = serde_json::from_slice(&joined.setup).map_err(|error| {
            CommandError::Failed(format!(
                "the orchestrator's configuration: {error}: run the same version of calmwalk on all hosts"
            ))
        })?;
        match model(&joined, &setup.model, directory).await? {
            Some(model) => return Ok((client, joined, AgentConfig { model, ..setup })),
            None => log_and_print("the orchestrator has restarted: joining again"),
        }
    }
}

/// The files of the model: the orchestrator's if this host can read them, otherwise downloaded copies. `None` if this agent
/// lost its membership before the download finished.
async fn model(
    joined: &Membership,
    model: &ModelFiles,
    directory: &Path,
) -> Result<Option<ModelFiles>, CommandError> {
    let Some(export) = file(joined, &model.export, directory.join("kokkos.npz")).await? else {
        return Ok(None);
    };
    let mut found = ModelFiles { export, ..model.clone() };
    if let Some(artifact) = &mut found.artifact {
        let Some(copy) = file(joined, artifact, directory.join("gmm_artifacts.npz")).await? else {
            return Ok(None);
        };
        *artifact = copy;
    }
    Ok(Some(found))
}

/// A file of the orchestrator, or its copy, which is downloaded to `path`.
async fn file(
    joined: &Membership,
    file: &HashedFile,
    path: PathBuf,
) -> Result<Option<HashedFile>, CommandError> {
    let hash = &file.hash;
    if verify_hash(&file.path, hash).is_ok() {
        return Ok(Some(file.clone()));
    }
    log_and_print("the orchestrator's model file is not on this host: downloading the model …");
    let bytes = match joined.fetch_file(hash).await {
        Err(LinkError::RejoinRequired(_)) => return Ok(None),
        bytes => bytes.map_err(CommandError::failed)?,
    };
    fs::write(&path, bytes)
        .map_err(|error| CommandError::Failed(format!("cannot write {}: {error}", path.display())))?;
    verify_hash(&path, hash).map_err(CommandError::failed)?;
    Ok(Some(HashedFile { path, hash: hash.clone() }))
}

/// The walkers of this host and the task that dispatches assignments to them.
struct AgentHost {
    walkers: Children,
    state: AgentState,
    line: ipc::ServerHandle,
    dispatching: DispatchTask,
    serving: JoinHandle<Result<(), IpcError>>,
    /// How the last walker failed, if all have failed for good.
    failed: Option<String>,
}

type DispatchTask = JoinHandle<Result<agent::AgentExit, LinkError>>;

async fn run_in(
    shm_dir: &ShmDir,
    setup: &AgentConfig,
    (walkers, threads): (u32, usize),
    mixture: &Mixture,
    dispatch: impl FnOnce(mpsc::Receiver<Incoming>) -> DispatchTask,
    stop: &CancellationToken,
    state: &AgentState,
) -> Result<ExitStatus, CommandError> {
    let sizes = Sizes { walkers, message_bytes: setup.message_bytes };
    let needed =
        SharedMixture::space_needed(mixture, walkers).map_err(CommandError::failed)? + space_needed(&sizes);
    let _prepared = shm_dir.prepare(needed).map_err(CommandError::failed)?;
    let shared = SharedMixture::create(&shm_dir.mixture(), mixture, walkers).map_err(CommandError::failed)?;
    let server =
        IpcServer::open(shm_dir, sizes, u64::from(std::process::id())).map_err(CommandError::failed)?;
    let line = server.handle();
    let limits = Limits {
        heartbeat_timeout: Duration::from_secs_f64(setup.heartbeat_timeout),
        max_restarts: setup.max_restarts,
        ..Limits::default()
    };
    let walkers = Children::new(walkers, limits, launch(setup, threads, line.clone()));
    let (to_agent, incoming) = mpsc::channel(CHANNEL);
    let signs = walkers.heartbeats();
    let heard = move |walker, useful| if useful { signs.delivered(walker) } else { signs.heartbeat(walker) };
    let serving = tokio::spawn(server.run(shared, to_agent, heard));
    let dispatching = dispatch(incoming);
    AgentHost { walkers, state: state.clone(), line, dispatching, serving, failed: None }
        .supervise(stop)
        .await
}

/// Returns the function that launches a walker.
fn launch(
    setup: &AgentConfig,
    threads: usize,
    line: ipc::ServerHandle,
) -> impl FnMut(u32, u32) -> Launch + Send + 'static {
    let (setup, parent) = (setup.clone(), std::process::id());
    move |number, incarnation| {
        line.expect(number, incarnation);
        let setup = WalkerConfig {
            parent,
            connect_info: line.connect_info(number, incarnation),
            model: WalkerModel::Grace(setup.model.clone()),
            threads,
            settings: setup.settings.clone(),
            log: log::child_config(),
        };
        Launch::this_program(["walker"], process_config::to_bytes(&setup)).without_database()
    }
}

impl AgentHost {
    /// Runs until every walker has ended and every report is delivered.
    async fn supervise(mut self, stop: &CancellationToken) -> Result<ExitStatus, CommandError> {
        let (mut dispatched, mut gone) = (None, false);
        let mut stop_requested = pin!(stop.cancelled().fuse());
        let mut ticks = interval(STATUS_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        while dispatched.is_none() || !gone {
            tokio::select! {
                event = self.walkers.next() => gone |= self.handle(event),
                _ = ticks.tick() => {
                    let walkers = self.walkers.status();
                    *self.state.walkers.lock().unwrap_or_else(PoisonError::into_inner) = walkers;
                }
                () = &mut stop_requested => self.walkers.stop(),
                ended = &mut self.dispatching, if dispatched.is_none() => {
                    let ended = ended.map_err(CommandError::failed)?;
                    match ended {
                        Ok(agent::AgentExit::Done) => self.walkers.close(),
                        _ => self.walkers.stop(),
                    }
                    dispatched = Some(ended.map_err(CommandError::failed));
                }
            }
        }
        self.serving.await.map_err(CommandError::failed)?.map_err(CommandError::failed)?;
        match dispatched.transpose()? {
            Some(agent::AgentExit::Done) => Ok(ExitStatus::Done),
            _ => match self.failed {
                Some(how) => Err(CommandError::Failed(format!("no walker is left: {how}"))),
                None => Ok(ExitStatus::Interrupted),
            },
        }
    }

    /// Handles an event of a walker process. Returns whether all walkers have ended.
    fn handle(&mut self, event: launcher::ChildEvent) -> bool {
        match event {
            launcher::ChildEvent::Started { .. } => {}
            launcher::ChildEvent::Stderr { number, line } => {
                log_and_print(format_args!("walker {number}: {line}"))
            }
            launcher::ChildEvent::Ended { number, ended } => {
                self.line.lost(number, ended.incarnation, ended.reason.is_crash());
                if ended.then == ChildState::Exited {
                    self.walkers.close();
                } else {
                    log_and_warn(format_args!("walker {number}: {}; {}", ended.reason, ended.then));
                }
            }
            launcher::ChildEvent::AllExited => {
                self.line.close();
                self.failed = all_failed_message(&mut self.walkers);
                return true;
            }
        }
        false
    }
}
