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
use super::desk::Desk;
use super::lines::{Lines, Traffic};
use super::{Door, IpcError, Sizes};
use crate::exchange::message::Caller;
use crate::mixture::SharedMixture;
use crate::place::{self, Place};
use crate::transport::Incoming;

/// Messages that are taken in before the server looks at anything else.
const BATCH: usize = 64;

/// The orchestrator's end of the transport. Walkers can connect as soon as it is open and are heard when it runs.
pub struct Server {
    port: ServerPort,
    bell: Listener<Service>,
    lines: Lines,
    orders: mpsc::UnboundedReceiver<Order>,
    handle: Handle,
}

/// Speaks to the server's task.
#[derive(Clone, Debug)]
pub struct Handle {
    door: Door,
    orders: mpsc::UnboundedSender<Order>,
    traffic: Arc<Mutex<Traffic>>,
}

#[derive(Debug)]
enum Order {
    Expect { walker: u32, incarnation: u32 },
    Gone { walker: u32, incarnation: u32, fault: bool },
    Close,
}

impl Handle {
    /// What the walker's process needs to connect.
    pub fn door(&self, walker: u32, incarnation: u32) -> Door {
        let caller = Caller { walker, incarnation, ..self.door.caller };
        Door { caller, ..self.door.clone() }
    }

    /// From now on this incarnation of the walker is heard and no other. To be called before its process is started and
    /// after another, if there was one, has ended: if [`Handle::gone`] has not said so, this does.
    pub fn expect(&self, walker: u32, incarnation: u32) {
        self.order(Order::Expect { walker, incarnation });
    }

    /// The walker's process is dead and has been waited for: what it held is freed, and the reactor hears of it, and
    /// whether that was its own fault. Nothing happens if this incarnation is not the expected one any more: what it
    /// held has been freed, and what is held now belongs to its successor.
    pub fn gone(&self, walker: u32, incarnation: u32, fault: bool) {
        self.order(Order::Gone { walker, incarnation, fault });
    }

    /// No walker will come any more, and none is alive: [`Server::run`] ends.
    pub fn close(&self) {
        self.order(Order::Close);
    }

    /// What came so far.
    pub fn traffic(&self) -> Traffic {
        self.traffic.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn order(&self, order: Order) {
        // After the server's end there is nothing to be done about it.
        let _ = self.orders.send(order);
    }
}

impl Server {
    /// Opens the transport in a place that has been prepared. `session` tells this run of the orchestrator from others.
    ///
    /// # Errors
    /// Whatever iceoryx2 says.
    pub fn open(place: &Place, sizes: Sizes, session: u64) -> Result<Self, IpcError> {
        let node = config::node(place.directory(), place.prefix())?;
        let bell = config::create_server_bell(&node, &sizes, session)?;
        let port = config::server_port(&config::create_requests(&node, &sizes, session)?, &sizes)?;
        place.close_to_others().map_err(|e| IpcError::new("close its files to other users", e))?;
        place::reserve(place.prefix(), None).map_err(|e| IpcError::new("reserve its memory", e))?;
        let (sender, orders) = mpsc::unbounded_channel();
        let traffic = Arc::default();
        let door = Door {
            directory: place.directory().to_owned(),
            prefix: place.prefix().to_owned(),
            mixture: place.mixture(),
            message_bytes: sizes.message_bytes,
            caller: Caller { session, walker: 0, incarnation: 0 },
        };
        let handle = Handle { door, orders: sender, traffic: Arc::clone(&traffic) };
        Ok(Self { port, bell, lines: Lines::new(node, traffic, sizes.message_bytes), orders, handle })
    }

    /// For whoever starts and ends walkers.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }

    /// Listens to walkers and hands on to the reactor until [`Handle::close`]. `heard` is told of each walker's messages, and
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
        let mut desk = Desk::new(self.handle.door.caller.session, mixtures, self.lines);
        let rung = descriptor(&self.bell).map_err(|e| IpcError::new("wait for events", e))?;
        let mut more = false;
        loop {
            tokio::select! {
                biased;
                order = self.orders.recv() => match order {
                    Some(Order::Expect { walker, incarnation }) => desk.expect(walker, incarnation),
                    Some(Order::Gone { walker, incarnation, fault }) => {
                        desk.gone(walker, incarnation, fault);
                        // Lets go of the connection as well.
                        more = take_in(&self.port, &mut desk, &mut heard)?;
                    }
                    Some(Order::Close) | None => {
                        // The reactor waits for the walkers that are gone, also when others keep its channel open.
                        for incoming in desk.outbox.drain(..) {
                            if to_reactor.send(incoming).await.is_err() {
                                break;
                            }
                        }
                        return Ok(());
                    }
                },
                (walker, work) = poll_fn(|context| desk.poll_decision(context)) => desk.decided(walker, work)?,
                permit = to_reactor.reserve(), if !desk.outbox.is_empty() => match permit {
                    Ok(permit) => if let Some(incoming) = desk.outbox.pop_front() { permit.send(incoming) },
                    // The reactor has ended: whoever waits is sent home.
                    Err(_) => desk.outbox.clear(),
                },
                () = tokio::task::yield_now(), if more => more = take_in(&self.port, &mut desk, &mut heard)?,
                guard = rung.readable() => {
                    let mut guard = guard.map_err(|e| IpcError::new("wait for events", e))?;
                    self.bell.try_wait(|_| {}).map_err(|e| IpcError::new("take in events", e))?;
                    guard.clear_ready();
                    more = take_in(&self.port, &mut desk, &mut heard)?;
                }
            }
        }
    }
}

/// Takes in what has come; whether there may be more.
fn take_in(port: &ServerPort, desk: &mut Desk, heard: &mut impl FnMut(u32, bool)) -> Result<bool, IpcError> {
    for _ in 0..BATCH {
        match port.receive() {
            Ok(Some(request)) => {
                if let Some((walker, reports)) = desk.receive(request) {
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
fn descriptor(bell: &Listener<Service>) -> io::Result<AsyncFd<OwnedFd>> {
    // SAFETY: the listener, which owns the descriptor, outlives this function; what is kept is a duplicate.
    let duplicate =
        unsafe { BorrowedFd::borrow_raw(bell.file_descriptor().native_handle()) }.try_clone_to_owned()?;
    // SAFETY: the duplicate is owned by what is returned, which never gives it away, and is closed with it.
    Ok(unsafe { AsyncFd::register(duplicate) }?)
}
