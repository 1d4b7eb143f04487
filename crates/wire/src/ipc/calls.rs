//! Calls to a service of the same host, through shared memory: a client sends words and sleeps until the answer comes. Several
//! clients wait at the same time; the service answers in any order.

use std::collections::HashMap;
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy};
use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;

use super::IpcError;
use super::config::{self, ClientPort, IpcRequest, Pending, ServerPort, Service};
use super::walker::initialised;
use crate::shm_dir::{self, ShmDir};

/// One call of a client at a time, and one that it gave up.
const ACTIVE: usize = 2;
/// As [`super::config`] explains.
const CHANNELS: usize = 2 * ACTIVE + 1;
/// Interval at which a waiting end looks around, in case an event was lost.
const POLL_INTERVAL: Duration = Duration::from_millis(500);
/// How long an answer may take after the client was asked to stop.
const STOPPING_TIMEOUT: Duration = Duration::from_secs(10);
/// The first word of a request: who asks.
const HEADER: usize = 1;

/// How clients find a service.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CallAddress {
    directory: PathBuf,
    prefix: String,
    session: u64,
    words: usize,
}

/// Shared memory for the calls of a number of clients whose messages have at most this many words, bytes.
pub fn call_space_needed(clients: u32, words: usize) -> u64 {
    let buffers = u64::from(clients) * (CHANNELS + 1 + ACTIVE + 2) as u64;
    (1 << 20) + buffers * (8 * words as u64 + 4096)
}

/// The service's end.
pub struct CallServer {
    port: ServerPort,
    wakeup: Listener<Service>,
    node: Node<Service>,
    address: CallAddress,
    clients: HashMap<u64, Arc<Notifier<Service>>>,
}

/// A call that waits for its answer.
pub struct IncomingCall {
    request: IpcRequest,
    client: Arc<Notifier<Service>>,
}

impl CallServer {
    /// Opens a service in a prepared directory, for a number of clients whose messages usually have at most `words` words.
    ///
    /// # Errors
    /// Errors of iceoryx2 and of the operating system.
    pub fn open(shm_dir: &ShmDir, session: u64, clients: u32, words: usize) -> Result<Self, IpcError> {
        let (directory, prefix) = (shm_dir.directory().to_owned(), shm_dir.prefix().to_owned());
        let node = config::node(&directory, &prefix)?;
        let processes = 2 * clients as usize + 16;
        let wakeup = config::create_wakeup(&node, &server_name(session), processes)?;
        let service = node
            .service_builder(&config::name(&calls_name(session))?)
            .request_response::<[u64], [u64]>()
            .enable_safe_overflow_for_requests(false)
            .enable_safe_overflow_for_responses(false)
            .max_active_requests_per_client(ACTIVE)
            .max_loaned_requests(1)
            .max_response_buffer_size(1)
            .max_borrowed_responses_per_pending_response(1)
            .max_servers(1)
            .max_clients(processes)
            .max_nodes(processes)
            .create()
            .map_err(|e| IpcError::new("create the service for calls", e))?;
        let buffers = (CHANNELS + 1) * clients as usize + 1;
        let port = service
            .server_builder()
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .max_loaned_responses_per_request(1)
            .override_response_preallocation(move |_| buffers)
            .initial_max_slice_len(words)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .create()
            .map_err(|e| IpcError::new("open the service for calls", e))?;
        shm_dir
            .restrict_permissions()
            .map_err(|e| IpcError::new("restrict the permissions of its files", e))?;
        shm_dir::reserve(&prefix, None).map_err(|e| IpcError::new("reserve its memory", e))?;
        let address = CallAddress { directory, prefix, session, words };
        Ok(Self { port, wakeup, node, address, clients: HashMap::new() })
    }

    /// How clients find this service.
    pub fn address(&self) -> &CallAddress {
        &self.address
    }

    /// Waits for calls until `stop` is cancelled, which takes effect within half a second.
    ///
    /// # Errors
    /// Errors of iceoryx2.
    pub fn run(
        mut self,
        stop: &CancellationToken,
        mut on_call: impl FnMut(IncomingCall),
    ) -> Result<(), IpcError> {
        while !stop.is_cancelled() {
            // A signal may end the wait early.
            let _ = self.wakeup.timed_wait(|_| {}, POLL_INTERVAL);
            while let Ok(Some(request)) = self.port.receive() {
                let Some(client) = request.payload().first().copied() else { continue };
                // A client that has died meanwhile has no events.
                if let Ok(client) = self.notifier(client) {
                    on_call(IncomingCall { request, client });
                }
            }
        }
        Ok(())
    }

    fn notifier(&mut self, client: u64) -> Result<Arc<Notifier<Service>>, IpcError> {
        if let Some(known) = self.clients.get(&client) {
            return Ok(Arc::clone(known));
        }
        let opened = Arc::new(config::open_wakeup(&self.node, &client_name(self.address.session, client))?);
        self.clients.insert(client, Arc::clone(&opened));
        Ok(opened)
    }
}

impl IncomingCall {
    /// What the client sent.
    pub fn words(&self) -> &[u64] {
        &self.request.payload()[HEADER..]
    }

    /// Who called. A process has one number for each of its clients.
    pub fn client(&self) -> u64 {
        self.request.payload()[0]
    }

    /// Answers with `length` words, which `write` writes. A client that is gone gets none.
    pub fn answer(self, length: usize, write: impl FnOnce(&mut [u64])) {
        if let Ok(mut memory) = self.request.loan_slice_uninit(length) {
            write(initialised(memory.payload_mut()));
            // SAFETY: every word of shared memory is initialized.
            #[allow(unsafe_code)]
            let memory = unsafe { memory.assume_init() };
            let _ = memory.send();
        }
        let _ = self.client.notify();
    }
}

impl fmt::Debug for IncomingCall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("IncomingCall").field("words", &self.request.payload().len()).finish_non_exhaustive()
    }
}

/// A client's end.
pub struct CallClient {
    number: u64,
    port: ClientPort,
    wakeup: Listener<Service>,
    server: Notifier<Service>,
    stopping: CancellationToken,
    _node: Node<Service>,
}

impl fmt::Debug for CallClient {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("CallClient").field("number", &self.number).finish_non_exhaustive()
    }
}

impl CallClient {
    /// Connects to a service. Cancelling `stopping` ends calls that take longer than ten seconds from then on.
    ///
    /// # Errors
    /// The service is not running, or an error of iceoryx2.
    pub fn connect(address: &CallAddress, stopping: CancellationToken) -> Result<Self, IpcError> {
        let node = config::node(&address.directory, &address.prefix)?;
        let service = node
            .service_builder(&config::name(&calls_name(address.session))?)
            .request_response::<[u64], [u64]>()
            .open()
            .map_err(|e| IpcError::new("find the service for calls: it has exited", e))?;
        let port = service
            .client_builder()
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .override_request_preallocation(|_| ACTIVE + 2)
            .initial_max_slice_len(address.words)
            .allocation_strategy(AllocationStrategy::PowerOfTwo)
            .create()
            .map_err(|e| IpcError::new("open a client's end for calls", e))?;
        shm_dir::reserve(&address.prefix, Some(port.id().value()))
            .map_err(|e| IpcError::new("reserve its memory", e))?;
        let number = unique_number();
        let wakeup = config::create_wakeup(&node, &client_name(address.session, number), 4)?;
        let server = config::open_wakeup(&node, &server_name(address.session))?;
        Ok(Self { number, port, wakeup, server, stopping, _node: node })
    }

    /// Sends `length` words, which `write` writes, and gives the answer to `read`. `None` if the client was asked to stop before the
    /// answer came.
    ///
    /// # Errors
    /// Errors of iceoryx2, or a service that has exited.
    pub fn call<T>(
        &self,
        length: usize,
        write: impl FnOnce(&mut [u64]),
        read: impl FnOnce(&[u64]) -> T,
    ) -> Result<Option<T>, IpcError> {
        let failed = |e: &dyn fmt::Display| IpcError::new("send a call", e);
        let mut memory = self.port.loan_slice_uninit(HEADER + length).map_err(|e| failed(&e))?;
        let words = initialised(memory.payload_mut());
        words[0] = self.number;
        write(&mut words[HEADER..]);
        // SAFETY: every word of shared memory is initialized.
        #[allow(unsafe_code)]
        let memory = unsafe { memory.assume_init() };
        let pending = memory.send().map_err(|e| failed(&e))?;
        if pending.number_of_server_connections() == 0 {
            return Err(IpcError::new("send a call", "the service has exited"));
        }
        let _ = self.server.notify();
        self.wait(&pending, read)
    }

    fn wait<T>(&self, pending: &Pending, read: impl FnOnce(&[u64]) -> T) -> Result<Option<T>, IpcError> {
        let mut stopped = None;
        loop {
            let answer = pending.receive().map_err(|e| IpcError::new("receive an answer to a call", e))?;
            if let Some(answer) = answer {
                return Ok(Some(read(answer.payload())));
            }
            if self.stopping.is_cancelled()
                && stopped.get_or_insert_with(Instant::now).elapsed() > STOPPING_TIMEOUT
            {
                return Ok(None);
            }
            let _ = self.wakeup.timed_wait(|_| {}, POLL_INTERVAL);
        }
    }
}

/// Differs from that of every other client of this host.
fn unique_number() -> u64 {
    use std::sync::atomic::{AtomicU32, Ordering};
    static NEXT: AtomicU32 = AtomicU32::new(0);
    u64::from(std::process::id()) << 32 | u64::from(NEXT.fetch_add(1, Ordering::Relaxed))
}

fn calls_name(session: u64) -> String {
    format!("{session:016x}/calls")
}

fn server_name(session: u64) -> String {
    format!("{session:016x}/calls/server")
}

fn client_name(session: u64, client: u64) -> String {
    format!("{session:016x}/calls/{client:016x}")
}
