//! An agent at work: walkers in processes of their own on this host, and a line to the orchestrator on another.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use calm::Mixture;
use orchestrator::launcher::{self, Children, Launch};
use orchestrator::supervisor::{ChildState, Limits};
use tokio::sync::{Notify, mpsc};
use tokio::task::JoinHandle;
use tokio::time::{MissedTickBehavior, interval};
use wire::ipc::{self, IpcError, Server, Sizes, space_needed};
use wire::mixture::SharedMixture;
use wire::net::{self, Address, AgentClient, LinkError, Membership, NetError, Tls};
use wire::shm_dir::ShmDir;
use wire::transport::Incoming;
use workers::agent::{self, Agent, News};

use super::crew::all_given_up;
use super::{CHANNEL, STOPPING, asked_to_stop};
use crate::log;
use crate::outcome::{Ended, Failure};
use crate::output::{count, say, warn};
use crate::setup::{self, AgentSetup, WalkerSetup};
use crate::web::agent::Watched;

/// Between two looks at the walkers, for those who watch.
const LOOK: Duration = Duration::from_secs(1);

/// Works for a campaign until it is over or this process is asked to stop. What is needed in the meantime lies in
/// `directory`. To be awaited on the main thread: the walkers end with the thread that starts them.
pub async fn work(
    address: &Address,
    tls: Option<&Tls>,
    agent: net::Agent,
    threads: usize,
    patience: Duration,
    directory: &Path,
    watched: &Watched,
) -> Result<Ended, Failure> {
    let (stopping, stop) = asked_to_stop(STOPPING)?;
    let walkers = agent.walkers;
    let (uplink, joined, setup) = tokio::select! {
        joined = join(address, tls, agent, directory) => joined?,
        () = stop.notified() => return Ok(Ended::Interrupted),
        () = address.wait_until_over() => {
            say("the campaign is over");
            return Ok(Ended::Done);
        }
        () = tokio::time::sleep(patience) => {
            let minutes = patience.as_secs_f64() / 60.0;
            return Err(Failure::Failed(format!("no orchestrator has answered at {address} for {minutes:.1} min")));
        }
    };
    say(format_args!(
        "joined: {}, mixture version {}",
        count(walkers, "walker"),
        joined.newest().await.version()
    ));
    let place = ShmDir::for_campaign(directory).map_err(Failure::failed)?;
    let mixture = joined.newest().await;
    let (flag, asked) = (Arc::clone(&stopping), Arc::clone(&stop));
    let numbers = Arc::clone(&watched.numbers);
    let deal = |incoming| {
        tokio::spawn(Agent { uplink, joined, incoming, stopping, patience, numbers }.run(move |news| match news {
            News::Stop => {
                flag.store(true, Ordering::Relaxed);
                asked.notify_one();
            }
            News::Silent { untold, idle } => warn(format_args!(
                "the orchestrator does not answer: {untold} reports are kept for it, {idle} of {walkers} walkers wait"
            )),
            News::Back => say("the orchestrator answers again"),
        }))
    };
    let ended = work_in(&place, &setup, (walkers, threads), &mixture, deal, &stop, watched).await;
    let removed = place.remove().map_err(Failure::failed);
    let ended = ended?;
    removed?;
    Ok(ended)
}

/// Waits until there is an orchestrator, a place with it, and what its walkers need.
async fn join(
    address: &Address,
    tls: Option<&Tls>,
    agent: net::Agent,
    directory: &Path,
) -> Result<(Arc<AgentClient>, Membership, AgentSetup), Failure> {
    let waiting = |why: &NetError| warn(format_args!("waiting for the orchestrator: {why}"));
    let uplink = AgentClient::open(address, tls, agent, waiting).await.map_err(Failure::input)?;
    let uplink = Arc::new(uplink);
    loop {
        let joined = uplink.join().await.map_err(Failure::failed)?;
        let setup: AgentSetup = serde_json::from_slice(&joined.setup).map_err(|error| {
            Failure::Failed(format!("the orchestrator's setup: {error}: run the same program everywhere"))
        })?;
        match model(&joined, &setup, directory).await? {
            Some(model) => return Ok((uplink, joined, AgentSetup { model, ..setup })),
            None => say("the orchestrator was started again meanwhile: joining anew"),
        }
    }
}

/// The model's file: the orchestrator's own where this host sees it, else a copy; `None` if the place was lost before it was
/// here.
async fn model(
    joined: &Membership,
    setup: &AgentSetup,
    directory: &Path,
) -> Result<Option<PathBuf>, Failure> {
    let hash = &setup.model_hash;
    if setup::unchanged(&setup.model, hash).is_ok() {
        return Ok(Some(setup.model.clone()));
    }
    say("this host does not see the orchestrator's model: fetching the model …");
    let path = directory.join("kokkos.npz");
    let bytes = match joined.fetch_file(hash).await {
        Err(LinkError::RejoinRequired(_)) => return Ok(None),
        bytes => bytes.map_err(Failure::failed)?,
    };
    fs::write(&path, bytes)
        .map_err(|error| Failure::Failed(format!("cannot write {}: {error}", path.display())))?;
    setup::unchanged(&path, hash).map_err(Failure::failed)?;
    Ok(Some(path))
}

/// The walkers of this host, and the task that deals turns to them.
struct Host {
    walkers: Children,
    watched: Watched,
    line: ipc::ServerHandle,
    dealing: Dealing,
    serving: JoinHandle<Result<(), IpcError>>,
    /// How the last of them failed, if all were given up.
    given_up: Option<String>,
}

type Dealing = JoinHandle<Result<agent::Ended, LinkError>>;

async fn work_in(
    place: &ShmDir,
    setup: &AgentSetup,
    (walkers, threads): (u32, usize),
    mixture: &Mixture,
    deal: impl FnOnce(mpsc::Receiver<Incoming>) -> Dealing,
    stop: &Notify,
    watched: &Watched,
) -> Result<Ended, Failure> {
    let sizes = Sizes { walkers, message_bytes: setup.message_bytes };
    let needed =
        SharedMixture::space_needed(mixture, walkers).map_err(Failure::failed)? + space_needed(&sizes);
    let _prepared = place.prepare(needed).map_err(Failure::failed)?;
    let shared = SharedMixture::create(&place.mixture(), mixture, walkers).map_err(Failure::failed)?;
    let server = Server::open(place, sizes, u64::from(std::process::id())).map_err(Failure::failed)?;
    let line = server.handle();
    let limits = Limits {
        heartbeat_timeout: Duration::from_secs_f64(setup.silence_limit),
        max_restarts: setup.restarts,
        ..Limits::default()
    };
    let walkers = Children::new(walkers, limits, launch(setup, threads, line.clone()));
    let (to_agent, incoming) = mpsc::channel(CHANNEL);
    let signs = walkers.heartbeats();
    let heard = move |walker, useful| if useful { signs.delivered(walker) } else { signs.heartbeat(walker) };
    let serving = tokio::spawn(server.run(shared, to_agent, heard));
    let dealing = deal(incoming);
    Host { walkers, watched: watched.clone(), line, dealing, serving, given_up: None }.lead(stop).await
}

/// How walkers are started.
fn launch(
    setup: &AgentSetup,
    threads: usize,
    line: ipc::ServerHandle,
) -> impl FnMut(u32, u32) -> Launch + Send + 'static {
    let (setup, parent) = (setup.clone(), std::process::id());
    move |number, incarnation| {
        line.expect(number, incarnation);
        let setup = WalkerSetup {
            parent,
            door: line.connect_info(number, incarnation),
            model: setup.model.clone(),
            model_hash: setup.model_hash.clone(),
            precision: setup.precision,
            threads,
            settings: setup.settings.clone(),
            log: log::for_children(),
        };
        Launch::this_program(["walker"], setup::bytes(&setup)).without_database()
    }
}

impl Host {
    /// Until every walker is gone and everything is told.
    async fn lead(mut self, stop: &Notify) -> Result<Ended, Failure> {
        let (mut dealt, mut gone) = (None, false);
        let mut look = interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        while dealt.is_none() || !gone {
            tokio::select! {
                event = self.walkers.next() => gone |= self.walker(event),
                _ = look.tick() => {
                    let walkers = self.walkers.status();
                    *self.watched.walkers.lock().unwrap_or_else(PoisonError::into_inner) = walkers;
                }
                () = stop.notified() => self.walkers.stop(),
                ended = &mut self.dealing, if dealt.is_none() => {
                    let ended = ended.map_err(Failure::failed)?;
                    match ended {
                        Ok(agent::Ended::Done) => self.walkers.close(),
                        _ => self.walkers.stop(),
                    }
                    dealt = Some(ended.map_err(Failure::failed));
                }
            }
        }
        self.serving.await.map_err(Failure::failed)?.map_err(Failure::failed)?;
        match dealt.transpose()? {
            Some(agent::Ended::Done) => Ok(Ended::Done),
            _ => match self.given_up {
                Some(how) => Err(Failure::Failed(format!("no walker is left: {how}"))),
                None => Ok(Ended::Interrupted),
            },
        }
    }

    /// Whether nobody is left.
    fn walker(&mut self, event: launcher::ChildEvent) -> bool {
        match event {
            launcher::ChildEvent::Started { .. } => {}
            launcher::ChildEvent::Stderr { number, line } => say(format_args!("walker {number}: {line}")),
            launcher::ChildEvent::Ended { number, ended } => {
                self.line.lost(number, ended.incarnation, ended.reason.is_crash());
                if ended.then == ChildState::Exited {
                    self.walkers.close();
                } else {
                    warn(format_args!("walker {number}: {}; {}", ended.reason, ended.then));
                }
            }
            launcher::ChildEvent::AllExited => {
                self.line.close();
                self.given_up = all_given_up(&mut self.walkers);
                return true;
            }
        }
        false
    }
}
