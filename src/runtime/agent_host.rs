//! Runs an agent: starts walkers as processes on this host and connects them to the orchestrator on another.

use std::path::Path;
use std::pin::pin;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use bridge::Device;
use futures_util::FutureExt;
use orchestrator::launcher::{self, Children};
use orchestrator::supervisor::{ChildState, Limits};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::{MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;
use wire::ipc::{self, IpcError};
use wire::net::{self, Address, AgentClient, LinkError, Membership, NetError, Tls};
use wire::shm_dir::ShmDir;
use wire::transport::Incoming;
use workers::agent::{self, Agent, OrchestratorEvent};

use super::agent_model::{self, HostPython};
use super::device_watch::{self, DeviceWatch};
use super::process_manager::all_failed_message;
use super::walker_host::{HostMemory, HostMixtures, HostSizes, walker_launcher};
use super::{CHANNEL, STOP_MESSAGE};
use crate::exit_status::{CommandError, ExitStatus};
use crate::output::{count, log_and_print, log_and_warn};
use crate::process_config::AgentConfig;
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
    /// What is another one on this host than on the orchestrator's.
    pub python: HostPython,
}

/// Works for a campaign until it is over or this process is asked to stop, with one version of the potential after the other.
///
/// Await this on the main thread: the walkers end with the thread that starts them.
pub async fn run(settings: &AgentSettings<'_>, state: &AgentState) -> Result<ExitStatus, CommandError> {
    let stop = CancellationToken::new();
    cancel_on_signal(stop.clone(), STOP_MESSAGE)?;
    loop {
        let (ended, goes_on) = run_version(settings, state, &stop).await?;
        if ended != ExitStatus::Done || !goes_on {
            return Ok(ended);
        }
    }
}

/// Works with one version of the potential. Returns whether there may be another one, or the orchestrator has other settings.
async fn run_version(
    settings: &AgentSettings<'_>,
    state: &AgentState,
    stop: &CancellationToken,
) -> Result<(ExitStatus, bool), CommandError> {
    let AgentSettings { address, tls, agent, threads, timeout, directory, python } = settings;
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
    let skin = setup.settings.skin;
    let start = stop.child_token();
    let mut started = pin!(agent_model::start_devices(&setup.model, python, skin, walkers, &start));
    let (devices, end) = tokio::select! {
        devices = &mut started => (devices, ExitStatus::Interrupted),
        end = called_off(&joined, address) => {
            start.cancel();
            (started.await, end)
        }
    };
    let devices = match devices {
        Ok(devices) if !start.is_cancelled() => devices,
        ended => {
            joined.leave().await;
            return ended.map(|_| (end, false));
        }
    };
    let shm_dir = ShmDir::for_campaign(directory).map_err(CommandError::failed)?;
    let (mixture, original) = (joined.newest().await, Arc::clone(&joined.original));
    // The walkers end with a device, too.
    let (host_stop, asked) = (stop.child_token(), stop.clone());
    let _watch = DeviceWatch::start(&devices, None, &host_stop, "assignments go back to the orchestrator");
    let stopping = host_stop.clone();
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
    let host = HostPlan { setup: &setup, walkers, threads, devices: &devices, stop: &host_stop, state };
    let ended = host.run_in(&shm_dir, HostMixtures { newest: &mixture, original: &original }, dispatch).await;
    let removed = shm_dir.remove().map_err(CommandError::failed);
    let ended = ended?;
    removed?;
    let HostEnd::Exit(ended) = ended else {
        log_and_print("the orchestrator has other settings now: joining again");
        return Ok((ExitStatus::Done, true));
    };
    match device_watch::last_failure(&devices) {
        Some(failure) if ended != ExitStatus::Done && !stop.is_cancelled() => {
            Err(CommandError::Failed(format!(
                "{failure}\nthe assignments of this host went back to the orchestrator: fix the cause and start the agent again"
            )))
        }
        _ => {
            if ended == ExitStatus::Done && setup.has_versions {
                log_and_print("no more walks with this version of the potential: waiting for the next one");
            }
            Ok((ended, setup.has_versions))
        }
    }
}

/// Waits until the orchestrator asks its agents to stop, or the campaign is over, and returns how the agent ends then.
async fn called_off(joined: &Membership, address: &Address) -> ExitStatus {
    let asked = async {
        loop {
            tokio::time::sleep(STATUS_INTERVAL).await;
            if matches!(joined.is_stopping().await, Ok(Some(true))) {
                return ExitStatus::Interrupted;
            }
        }
    };
    tokio::select! {
        end = asked => end,
        () = address.wait_until_over() => ExitStatus::Done,
    }
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
        match agent_model::with_files(&joined, setup.model.clone(), directory).await? {
            Some(model) => return Ok((client, joined, AgentConfig { model, ..setup })),
            None => log_and_print("the orchestrator has restarted: joining again"),
        }
    }
}

/// The walkers of this host and the task that dispatches assignments to them.
struct AgentHost {
    walkers: Children,
    state: AgentState,
    devices: Vec<Arc<Device>>,
    line: ipc::ServerHandle,
    dispatching: DispatchTask,
    serving: JoinHandle<Result<(), IpcError>>,
    /// How the last walker failed, if all have failed for good.
    failed: Option<String>,
}

/// How the work of a host with one setup ended.
enum HostEnd {
    Exit(ExitStatus),
    /// The orchestrator came back with another one.
    SetupChanged,
}

type DispatchTask = JoinHandle<Result<agent::AgentExit, LinkError>>;

/// What an agent runs on its host.
struct HostPlan<'a> {
    setup: &'a AgentConfig,
    walkers: u32,
    threads: usize,
    devices: &'a [Arc<Device>],
    stop: &'a CancellationToken,
    state: &'a AgentState,
}

impl HostPlan<'_> {
    async fn run_in(
        self,
        shm_dir: &ShmDir,
        mixtures: HostMixtures<'_>,
        dispatch: impl FnOnce(mpsc::Receiver<Incoming>) -> DispatchTask,
    ) -> Result<HostEnd, CommandError> {
        let Self { setup, walkers, threads, devices, stop, state } = self;
        let sizes = HostSizes { walkers, message_bytes: setup.message_bytes, devices: devices.len() };
        let session = u64::from(std::process::id());
        let memory = HostMemory::open(shm_dir, sizes, mixtures, session, devices)?;
        let (model, addresses) = (setup.model.for_walkers(), memory.addresses());
        let HostMemory { prepared: _prepared, mixture: shared, server, calls: _calls } = memory;
        let line = server.handle();
        let limits = Limits {
            heartbeat_timeout: Duration::from_secs_f64(setup.heartbeat_timeout),
            max_restarts: setup.max_restarts,
            ..Limits::default()
        };
        let launch = walker_launcher(model, addresses, threads, setup.settings.clone(), line.clone());
        let walkers = Children::new(walkers, limits, launch);
        let (to_agent, incoming) = mpsc::channel(CHANNEL);
        let signs = walkers.heartbeats();
        let heard =
            move |walker, useful| if useful { signs.delivered(walker) } else { signs.heartbeat(walker) };
        let serving = tokio::spawn(server.run(shared, to_agent, heard));
        let dispatching = dispatch(incoming);
        let (state, devices) = (state.clone(), devices.to_vec());
        AgentHost { walkers, state, devices, line, dispatching, serving, failed: None }.supervise(stop).await
    }
}

impl AgentHost {
    /// Runs until every walker has ended and every report is delivered.
    async fn supervise(mut self, stop: &CancellationToken) -> Result<HostEnd, CommandError> {
        let (mut dispatched, mut gone) = (None, false);
        let mut stop_requested = pin!(stop.cancelled().fuse());
        let mut ticks = interval(STATUS_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        while dispatched.is_none() || !gone {
            tokio::select! {
                event = self.walkers.next() => gone |= self.handle(event),
                _ = ticks.tick() => self.publish(),
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
            Some(agent::AgentExit::Done) => Ok(HostEnd::Exit(ExitStatus::Done)),
            Some(agent::AgentExit::SetupChanged) if !stop.is_cancelled() => Ok(HostEnd::SetupChanged),
            _ => match self.failed {
                Some(how) => Err(CommandError::Failed(format!("no walker is left: {how}"))),
                None => Ok(HostEnd::Exit(ExitStatus::Interrupted)),
            },
        }
    }

    /// Publishes the states of walkers and devices for the agent's metrics.
    fn publish(&mut self) {
        *self.state.walkers.lock().unwrap_or_else(PoisonError::into_inner) = self.walkers.status();
        let devices = device_watch::statistics(&self.devices);
        *self.state.devices.lock().unwrap_or_else(PoisonError::into_inner) = devices;
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
