//! The orchestrator's end: a task that receives messages, answers them, and forwards them to the reactor.

use std::future::poll_fn;
use std::io;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use iceoryx2::port::ReceiveError;
use iceoryx2::port::listener::Listener;
use iceoryx2::prelude::FileDescriptorBased;
use tokio::io::unix::AsyncFd;
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval};

use super::config::{self, ServerPort, Service};
use super::connections::{Traffic, WalkerConnections};
use super::session::IpcSession;
use super::{ConnectInfo, IpcError, Sizes};
use crate::mixture::SharedMixture;
use crate::protocol::message::SenderId;
use crate::shm_dir::{self, ShmDir};
use crate::transport::Incoming;

/// Maximum number of messages handled before other events.
const BATCH: usize = 64;
/// Interval at which the server looks for messages that no event has told of (see [`take_events`]).
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// The orchestrator's end of the transport. Walkers can connect as soon as it is open; [`IpcServer::run`] handles their
/// messages.
pub struct IpcServer {
    port: ServerPort,
    wakeup: Listener<Service>,
    connections: WalkerConnections,
    commands: mpsc::UnboundedReceiver<ServerCommand>,
    handle: ServerHandle,
}

/// Controls the server's task.
#[derive(Clone, Debug)]
pub struct ServerHandle {
    connect_info: ConnectInfo,
    commands: mpsc::UnboundedSender<ServerCommand>,
    traffic: Arc<Mutex<Traffic>>,
}

#[derive(Debug)]
enum ServerCommand {
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

    /// Accepts messages only of this incarnation of the walker from now on. Call it before the process is started and
    /// after the previous process has exited; it implies [`ServerHandle::lost`] for the previous one.
    pub fn expect(&self, walker: u32, incarnation: u32) {
        self.command(ServerCommand::Expect { walker, incarnation });
    }

    /// Reports that the walker's process has exited and was waited for, and whether it crashed. Frees its resources and
    /// informs the reactor. Does nothing if another incarnation is expected, since the resources then belong to the
    /// successor.
    pub fn lost(&self, walker: u32, incarnation: u32, crashed: bool) {
        self.command(ServerCommand::Lost { walker, incarnation, crashed });
    }

    /// Makes [`IpcServer::run`] return. Call it when no walker is alive and none will be started.
    pub fn close(&self) {
        self.command(ServerCommand::Close);
    }

    /// Statistics of received messages.
    pub fn traffic(&self) -> Traffic {
        self.traffic.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn command(&self, command: ServerCommand) {
        // Fails only if the server has already ended.
        let _ = self.commands.send(command);
    }
}

impl IpcServer {
    /// Opens the transport in a prepared directory. `session` distinguishes this run of the orchestrator from others.
    ///
    /// # Errors
    /// Errors of iceoryx2 and of the operating system.
    pub fn open(shm_dir: &ShmDir, sizes: Sizes, session: u64) -> Result<Self, IpcError> {
        let node = config::node(shm_dir.directory(), shm_dir.prefix())?;
        let wakeup = config::create_server_wakeup(&node, &sizes, session)?;
        let port = config::server_port(&config::create_requests(&node, &sizes, session)?, &sizes)?;
        shm_dir
            .restrict_permissions()
            .map_err(|e| IpcError::new("restrict the permissions of its files", e))?;
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
            connections: WalkerConnections::new(node, traffic, sizes.message_bytes),
            commands,
            handle,
        })
    }

    /// Handle for the code that starts and stops walkers.
    pub fn handle(&self) -> ServerHandle {
        self.handle.clone()
    }

    /// Handles messages of walkers and forwards them to the reactor until [`ServerHandle::close`]. Calls `on_message` for
    /// each message with the walker's number and whether it contains a report.
    ///
    /// # Errors
    /// Errors of shared memory or sockets, or a mixture that cannot be shared.
    pub async fn run(
        mut self,
        mixtures: SharedMixture,
        to_reactor: mpsc::Sender<Incoming>,
        mut on_message: impl FnMut(u32, bool) + Send + 'static,
    ) -> Result<(), IpcError> {
        let mut session =
            IpcSession::new(self.handle.connect_info.sender.session, mixtures, self.connections);
        let wakeup = descriptor(&self.wakeup).map_err(|e| IpcError::new("wait for events", e))?;
        let mut poll = interval(POLL_INTERVAL);
        poll.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut more = false;
        loop {
            tokio::select! {
                biased;
                command = self.commands.recv() => match command {
                    Some(ServerCommand::Expect { walker, incarnation }) => session.expect(walker, incarnation),
                    Some(ServerCommand::Lost { walker, incarnation, crashed }) => {
                        session.walker_lost(walker, incarnation, crashed);
                        // This also drops the connection.
                        more = receive_batch(&self.port, &mut session, &mut on_message)?;
                    }
                    Some(ServerCommand::Close) | None => {
                        // The reactor waits for the exits, even if other senders keep its channel open.
                        for incoming in session.walkers.outbox.drain(..) {
                            if to_reactor.send(incoming).await.is_err() {
                                break;
                            }
                        }
                        return Ok(());
                    }
                },
                decision = poll_fn(|context| session.walkers.poll_decision(context)) => session.handle_decision(decision)?,
                permit = to_reactor.reserve(), if !session.walkers.outbox.is_empty() => match permit {
                    Ok(permit) => if let Some(incoming) = session.walkers.outbox.pop_front() { permit.send(incoming) },
                    // The reactor has ended: all waiting walkers shut down.
                    Err(_) => session.walkers.outbox.clear(),
                },
                () = tokio::task::yield_now(), if more => more = receive_batch(&self.port, &mut session, &mut on_message)?,
                guard = wakeup.readable() => {
                    let mut guard = guard.map_err(|e| IpcError::new("wait for events", e))?;
                    take_events(&self.wakeup)?;
                    guard.clear_ready();
                    more = receive_batch(&self.port, &mut session, &mut on_message)?;
                }
                _ = poll.tick() => {
                    take_events(&self.wakeup)?;
                    more = receive_batch(&self.port, &mut session, &mut on_message)?;
                }
            }
        }
    }
}

/// Takes in events, until there are none.
///
/// A notifier of iceoryx2 0.10 writes to the socket only if its listener has taken in what was notified before. What is notified while events
/// are taken in may lose its datagram to that, and then no notifier writes again: the socket stays silent. Taking in events once more ends
/// that. A notification between the last look and its mark is left to the poll.
fn take_events(wakeup: &Listener<Service>) -> Result<(), IpcError> {
    for _ in 0..BATCH {
        if wakeup.try_wait(|_| {}).map_err(|e| IpcError::new("take in events", e))? == 0 {
            break;
        }
    }
    Ok(())
}

/// Handles received messages. Returns whether there may be more.
fn receive_batch(
    port: &ServerPort,
    session: &mut IpcSession,
    on_message: &mut impl FnMut(u32, bool),
) -> Result<bool, IpcError> {
    for _ in 0..BATCH {
        match port.receive() {
            Ok(Some(request)) => {
                if let Some((walker, reports)) = session.receive(request) {
                    on_message(walker, reports);
                }
            }
            // The walker sends without pause, or died while connecting. Other walkers will wake the server again.
            Ok(None) | Err(ReceiveError::ExceedsMaxBorrows | ReceiveError::ConnectionFailure(_)) => {
                return Ok(false);
            }
        }
    }
    Ok(true)
}

/// The listener's file descriptor, for tokio.
#[allow(unsafe_code)]
fn descriptor(wakeup: &Listener<Service>) -> io::Result<AsyncFd<OwnedFd>> {
    // SAFETY: the listener owns the descriptor and outlives this function; only a duplicate is kept.
    let duplicate =
        unsafe { BorrowedFd::borrow_raw(wakeup.file_descriptor().native_handle()) }.try_clone_to_owned()?;
    // SAFETY: the returned value owns the duplicate, never gives it away, and closes it.
    Ok(unsafe { AsyncFd::register(duplicate) }?)
}
