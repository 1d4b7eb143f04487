//! The orchestrator's end: one task that listens, answers, and hands on to the reactor.

use std::future::poll_fn;
use std::io;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::sync::{Arc, Mutex, PoisonError};

use iceoryx2::port::ReceiveError;
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::FileDescriptorBased;
use tokio::io::unix::AsyncFd;
use tokio::sync::mpsc;

use super::config::{self, ServerPort, Service};
use super::connections::{Connections, Traffic};
use super::session::ServerSession;
use super::{ConnectInfo, IpcError, Sizes};
use crate::mixture::SharedMixture;
use crate::protocol::message::SenderId;
use crate::shm_dir::{self, ShmDir};
use crate::transport::Incoming;

/// Messages that are taken in before the server looks at anything else.
const BATCH: usize = 64;

/// The orchestrator's end of the transport. Walkers can connect as soon as it is open and are heard when it runs.
pub struct Server {
    port: ServerPort,
    wakeup: Listener<Service>,
    connections: Connections,
    commands: mpsc::UnboundedReceiver<Command>,
    handle: ServerHandle,
}

/// Speaks to the server's task.
#[derive(Clone, Debug)]
pub struct ServerHandle {
    connect_info: ConnectInfo,
    commands: mpsc::UnboundedSender<Command>,
    traffic: Arc<Mutex<Traffic>>,
}

#[derive(Debug)]
enum Command {
    Expect { walker: u32, incarnation: u32 },
    Lost { walker: u32, incarnation: u32, crashed: bool },
    Close,
}

impl ServerHandle {
    /// What the walker's process needs to connect.
    pub fn connect_info(&self, walker: u32, incarnation: u32) -> ConnectInfo {
        let sender = SenderId { walker, incarnation, ..self.connect_info.sender };
        ConnectInfo { sender, ..self.connect_info.clone() }
    }

    /// From now on this incarnation of the walker is heard and no other. To be called before its process is started and
    /// after another, if there was one, has ended: if [`ServerHandle::lost`] has not said so, this does.
    pub fn expect(&self, walker: u32, incarnation: u32) {
        self.command(Command::Expect { walker, incarnation });
    }

    /// The walker's process is dead and has been waited for: what it held is freed, and the reactor hears of it, and
    /// whether that was its own crashed. Nothing happens if this incarnation is not the expected one any more: what it
    /// held has been freed, and what is held now belongs to its successor.
    pub fn lost(&self, walker: u32, incarnation: u32, crashed: bool) {
        self.command(Command::Lost { walker, incarnation, crashed });
    }

    /// No walker will come any more, and none is alive: [`Server::run`] ends.
    pub fn close(&self) {
        self.command(Command::Close);
    }

    /// What came so far.
    pub fn traffic(&self) -> Traffic {
        self.traffic.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn command(&self, command: Command) {
        // After the server's end there is nothing to be done about it.
        let _ = self.commands.send(command);
    }
}

impl Server {
    /// Opens the transport in a place that has been prepared. `session` tells this run of the orchestrator from others.
    ///
    /// # Errors
    /// Whatever iceoryx2 says.
    pub fn open(shm_dir: &ShmDir, sizes: Sizes, session: u64) -> Result<Self, IpcError> {
        let node = config::node(shm_dir.directory(), shm_dir.prefix())?;
        let wakeup = config::create_server_wakeup(&node, &sizes, session)?;
        let port = config::server_port(&config::create_requests(&node, &sizes, session)?, &sizes)?;
        shm_dir.restrict_permissions().map_err(|e| IpcError::new("close its files to other users", e))?;
        shm_dir::reserve(shm_dir.prefix(), None).map_err(|e| IpcError::new("reserve its memory", e))?;
        let (sender, commands) = mpsc::unbounded_channel();
        let traffic = Arc::default();
        let connect_info = ConnectInfo {
            directory: shm_dir.directory().to_owned(),
            prefix: shm_dir.prefix().to_owned(),
            mixture: shm_dir.mixture(),
            message_bytes: sizes.message_bytes,
            sender: SenderId { session, walker: 0, incarnation: 0 },
        };
        let handle = ServerHandle { connect_info, commands: sender, traffic: Arc::clone(&traffic) };
        Ok(Self {
            port,
            wakeup,
            connections: Connections::new(node, traffic, sizes.message_bytes),
            commands,
            handle,
        })
    }

    /// For whoever starts and ends walkers.
    pub fn handle(&self) -> ServerHandle {
        self.handle.clone()
    }

    /// Listens to walkers and hands on to the reactor until [`ServerHandle::close`]. `heard` is told of each walker's messages, and
    /// whether they brought a report.
    ///
    /// # Errors
    /// Shared memory or sockets that fail, a mixture that cannot be shared.
    pub async fn run(
        mut self,
        mixtures: SharedMixture,
        to_reactor: mpsc::Sender<Incoming>,
        mut heard: impl FnMut(u32, bool) + Send + 'static,
    ) -> Result<(), IpcError> {
        let mut session =
            ServerSession::new(self.handle.connect_info.sender.session, mixtures, self.connections);
        let wakeup = descriptor(&self.wakeup).map_err(|e| IpcError::new("wait for events", e))?;
        let mut more = false;
        loop {
            tokio::select! {
                biased;
                command = self.commands.recv() => match command {
                    Some(Command::Expect { walker, incarnation }) => session.expect(walker, incarnation),
                    Some(Command::Lost { walker, incarnation, crashed }) => {
                        session.walker_lost(walker, incarnation, crashed);
                        // Lets go of the connection as well.
                        more = receive_batch(&self.port, &mut session, &mut heard)?;
                    }
                    Some(Command::Close) | None => {
                        // The reactor waits for the walkers that are gone, also when others keep its channel open.
                        for incoming in session.outbox.drain(..) {
                            if to_reactor.send(incoming).await.is_err() {
                                break;
                            }
                        }
                        return Ok(());
                    }
                },
                (walker, work) = poll_fn(|context| session.poll_decision(context)) => session.decided(walker, work)?,
                permit = to_reactor.reserve(), if !session.outbox.is_empty() => match permit {
                    Ok(permit) => if let Some(incoming) = session.outbox.pop_front() { permit.send(incoming) },
                    // The reactor has ended: whoever waits is sent home.
                    Err(_) => session.outbox.clear(),
                },
                () = tokio::task::yield_now(), if more => more = receive_batch(&self.port, &mut session, &mut heard)?,
                guard = wakeup.readable() => {
                    let mut guard = guard.map_err(|e| IpcError::new("wait for events", e))?;
                    self.wakeup.try_wait(|_| {}).map_err(|e| IpcError::new("take in events", e))?;
                    guard.clear_ready();
                    more = receive_batch(&self.port, &mut session, &mut heard)?;
                }
            }
        }
    }
}

/// Takes in what has come; whether there may be more.
fn receive_batch(
    port: &ServerPort,
    session: &mut ServerSession,
    heard: &mut impl FnMut(u32, bool),
) -> Result<bool, IpcError> {
    for _ in 0..BATCH {
        match port.receive() {
            Ok(Some(request)) => {
                if let Some((walker, reports)) = session.receive(request) {
                    heard(walker, reports);
                }
            }
            // Of a walker that sends without end, or that died while it connected: the others ring again.
            Ok(None) | Err(ReceiveError::ExceedsMaxBorrows | ReceiveError::ConnectionFailure(_)) => {
                return Ok(false);
            }
        }
    }
    Ok(true)
}

/// The listener's descriptor, to be waited for by tokio.
#[allow(unsafe_code)]
fn descriptor(wakeup: &Listener<Service>) -> io::Result<AsyncFd<OwnedFd>> {
    // SAFETY: the listener, which owns the descriptor, outlives this function; what is kept is a duplicate.
    let duplicate =
        unsafe { BorrowedFd::borrow_raw(wakeup.file_descriptor().native_handle()) }.try_clone_to_owned()?;
    // SAFETY: the duplicate is owned by what is returned, which never gives it away, and is closed with it.
    Ok(unsafe { AsyncFd::register(duplicate) }?)
}
