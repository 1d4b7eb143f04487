//! Configuration of iceoryx2. Replaces every default that loses messages, blocks on a dead process, or uses files
//! outside the campaign's directory. The creator of a service sets all its limits.

use std::path::Path;
use std::sync::Mutex;

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::config::Config;
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy, FileName, SignalHandlingMode};
use iceoryx2::prelude::{SemanticString, ServiceName, ipc_threadsafe};
use iceoryx2::service::port_factory::request_response;

use super::{IpcError, Sizes};
use crate::protocol::message::SenderId;
use crate::shm_dir;

pub(super) type Service = ipc_threadsafe::Service;
// Messages are arrays of 8-byte words: iceoryx2 reserves eight times the space for bytes aligned to 8.
pub(super) type ServerPort = Server<Service, [u64], (), [u64], ()>;
pub(super) type ClientPort = Client<Service, [u64], (), [u64], ()>;
pub(super) type IpcRequest = ActiveRequest<Service, [u64], (), [u64], ()>;
pub(super) type Pending = PendingResponse<Service, [u64], (), [u64], ()>;
type Requests = request_response::PortFactory<Service, [u64], (), [u64], ()>;

/// Maximum number of candidates of one walker that the server reads in place. The server copies further ones (in a
/// reproducible round of many walks), which frees the walker's memory.
pub(super) const MAX_IN_PLACE: usize = 4;
/// Maximum number of candidates read in place in total, including those of dead walkers, whose memory is kept as long.
pub(super) const MAX_IN_PLACE_TOTAL: usize = 256;
/// Maximum number of active requests of one walker: candidates in place, an offer, polls, progress.
const ACTIVE_REQUESTS: usize = MAX_IN_PLACE + 4;
/// Number of request buffers of a walker. If it needs more or larger ones, iceoryx2 adds a segment.
const REQUEST_BUFFERS: usize = ACTIVE_REQUESTS + 2;
/// Number of response channels of one walker, each with one slot. An unread response stays in its channel when the
/// channel is closed, until the channel is used again.
const CHANNELS: usize = 2 * ACTIVE_REQUESTS + 1;
/// Number of answer buffers of the server for one walker: one for each channel, and one that is being written. The
/// server must never need more: iceoryx2 0.10 would add a segment with more slots than counters, and panic.
const ANSWER_BUFFERS: usize = CHANNELS + 1;
/// Overhead of a message, bytes: header of iceoryx2 and frame.
const MESSAGE_MARGIN: usize = 4096;
/// Memory of iceoryx2 for the connection with one walker (measured: 270 kB), and for everything else (100 kB).
const CONNECTION_BYTES: u64 = 1 << 19;
const TABLE_BYTES: u64 = 1 << 20;

/// Upper bound of the shared memory for the messages of a campaign, bytes. Each end reserves its part when it opens.
pub fn space_needed(sizes: &Sizes) -> u64 {
    let message = (sizes.message_bytes + 2 * MESSAGE_MARGIN) as u64;
    let messages = REQUEST_BUFFERS * sizes.walkers as usize + answer_buffers(sizes);
    TABLE_BYTES + messages as u64 * message + u64::from(sizes.walkers) * CONNECTION_BYTES
}

/// Checks that a message is no larger than expected, or that there is free space for it. Writing it without free space
/// would kill the process with SIGBUS.
pub(super) fn check_free_space(length: usize, message_bytes: usize) -> Result<(), IpcError> {
    if length > message_bytes {
        let free = shm_dir::free_space().map_err(|e| IpcError::new("query the free space", e))?;
        if free < 2 * length as u64 {
            let why =
                format!("its {length} bytes are more than expected, and /dev/shm has only {free} bytes free");
            return Err(IpcError::new("carry a message", why));
        }
    }
    Ok(())
}

/// Number of answer buffers of the server.
fn answer_buffers(sizes: &Sizes) -> usize {
    ANSWER_BUFFERS * sizes.walkers as usize + 1
}

/// Maximum number of words of a message of the expected length.
fn words(message_bytes: usize) -> usize {
    (message_bytes + MESSAGE_MARGIN).div_ceil(8)
}

/// Maximum number of connected processes: live ones, and dead ones until they are cleaned up.
fn processes(sizes: &Sizes) -> usize {
    2 * sizes.walkers as usize + 16
}

/// The iceoryx2 node of this process. Only the server cleans up dead nodes, since only it knows which processes are
/// dead.
pub(super) fn node(directory: &Path, prefix: &str) -> Result<Node<Service>, IpcError> {
    let root = directory.to_str().and_then(|path| iceoryx2::prelude::Path::new(path.as_bytes()).ok());
    let prefix = FileName::new(prefix.as_bytes()).ok();
    let (Some(root), Some(prefix)) = (root, prefix) else {
        return Err(IpcError::new("name its files in", directory.display()));
    };
    let mut config = Config::default();
    config.global.set_root_path(&root);
    config.global.prefix = prefix;
    // The path of a socket has at most 107 bytes.
    config.global.service.event_connection_suffix =
        FileName::new(b".e").map_err(|e| IpcError::new("name a socket", e))?;
    config.global.service.cleanup_dead_nodes_on_open = false;
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    let messages = &mut config.defaults.request_response;
    messages.server_expired_connection_buffer = MAX_IN_PLACE_TOTAL;
    messages.client_expired_connection_buffer = 4;
    NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create()
        .map_err(|e| IpcError::new("begin", e))
}

pub(super) fn name(text: &str) -> Result<ServiceName, IpcError> {
    text.try_into().map_err(|e| IpcError::new("name a service", e))
}

/// Creates the request service of a session; called by the server.
pub(super) fn create_requests(
    node: &Node<Service>,
    sizes: &Sizes,
    session: u64,
) -> Result<Requests, IpcError> {
    node.service_builder(&name(&requests_name(session))?)
        .request_response::<[u64], [u64]>()
        .enable_safe_overflow_for_requests(false)
        .enable_safe_overflow_for_responses(false)
        // Allows progress messages without an answer.
        .enable_fire_and_forget_requests(true)
        .max_active_requests_per_client(ACTIVE_REQUESTS)
        .max_loaned_requests(1)
        .max_response_buffer_size(1)
        .max_borrowed_responses_per_pending_response(1)
        .max_servers(1)
        .max_clients(processes(sizes))
        .max_nodes(processes(sizes))
        .create()
        .map_err(|e| IpcError::new("create the requests of the session", e))
}

pub(super) fn open_requests(node: &Node<Service>, session: u64) -> Result<Requests, IpcError> {
    node.service_builder(&name(&requests_name(session))?).request_response::<[u64], [u64]>().open().map_err(
        |e| IpcError::new("find the orchestrator: it has exited, or this walker belongs to another run", e),
    )
}

/// Drops an answer if the buffer is full, so that the server never blocks; the walker's next poll gets it.
pub(super) fn server_port(requests: &Requests, sizes: &Sizes) -> Result<ServerPort, IpcError> {
    let buffers = answer_buffers(sizes);
    requests
        .server_builder()
        .backpressure_strategy(BackpressureStrategy::DiscardData)
        .max_loaned_responses_per_request(1)
        .override_response_preallocation(move |_| buffers)
        .initial_max_slice_len(words(sizes.message_bytes))
        .allocation_strategy(AllocationStrategy::PowerOfTwo)
        .create()
        .map_err(|e| IpcError::new("open the orchestrator's end", e))
}

/// Drops a request if the buffer is full; the walker notices and sends it again.
pub(super) fn client_port(requests: &Requests, message_bytes: usize) -> Result<ClientPort, IpcError> {
    requests
        .client_builder()
        .backpressure_strategy(BackpressureStrategy::DiscardData)
        .override_request_preallocation(|_| REQUEST_BUFFERS)
        .initial_max_slice_len(words(message_bytes))
        .allocation_strategy(AllocationStrategy::PowerOfTwo)
        .create()
        .map_err(|e| IpcError::new("open a walker's end", e))
}

/// Creates the event that wakes the server; called by the server.
pub(super) fn create_server_wakeup(
    node: &Node<Service>,
    sizes: &Sizes,
    session: u64,
) -> Result<Listener<Service>, IpcError> {
    create_wakeup(node, &server_wakeup_name(session), processes(sizes))
}

pub(super) fn open_server_wakeup(node: &Node<Service>, session: u64) -> Result<Notifier<Service>, IpcError> {
    open_wakeup(node, &server_wakeup_name(session))
}

/// Creates the event that wakes a walker. Each process creates its own, so that a process that dies here affects no
/// other.
pub(super) fn create_walker_wakeup(
    node: &Node<Service>,
    sender: SenderId,
) -> Result<Listener<Service>, IpcError> {
    create_wakeup(node, &walker_wakeup_name(sender), 4)
}

pub(super) fn open_walker_wakeup(
    node: &Node<Service>,
    sender: SenderId,
) -> Result<Notifier<Service>, IpcError> {
    open_wakeup(node, &walker_wakeup_name(sender))
}

pub(super) fn create_wakeup(
    node: &Node<Service>,
    wakeup: &str,
    processes: usize,
) -> Result<Listener<Service>, IpcError> {
    let events = node
        .service_builder(&name(wakeup)?)
        .event()
        .max_listeners(1)
        .max_notifiers(processes)
        .max_nodes(processes)
        .event_id_max_value(1)
        .disable_deadline()
        .disable_notifier_created_event()
        .disable_notifier_dropped_event()
        .disable_notifier_dead_event()
        .create()
        .map_err(|e| IpcError::new("create the events", e))?;
    // iceoryx2 sets the umask of the process while it binds a listener's socket. Two threads that do so at once would leave
    // it set for good: directories that are made later could not be entered.
    static UMASK: Mutex<()> = Mutex::new(());
    let _one_at_a_time = UMASK.lock();
    events.listener_builder().create().map_err(|e| IpcError::new("listen to events", e))
}

pub(super) fn open_wakeup(node: &Node<Service>, wakeup: &str) -> Result<Notifier<Service>, IpcError> {
    let events = node.service_builder(&name(wakeup)?).event().open();
    let events = events.map_err(|e| IpcError::new("open the events", e))?;
    events.notifier_builder().create().map_err(|e| IpcError::new("open the events", e))
}

fn requests_name(session: u64) -> String {
    format!("{session:016x}/requests")
}

fn server_wakeup_name(session: u64) -> String {
    format!("{session:016x}/server")
}

fn walker_wakeup_name(SenderId { session, walker, incarnation }: SenderId) -> String {
    format!("{session:016x}/walker/{walker}/{incarnation}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A walker that received its answer by another request does not read the answers to its polls.
    #[test]
    fn unread_answers_leave_room_for_others() {
        let directory = tempfile::tempdir().unwrap();
        let sizes = Sizes { walkers: 1, message_bytes: 64 };
        let node = node(directory.path(), "unread").unwrap();
        let server = server_port(&create_requests(&node, &sizes, 1).unwrap(), &sizes).unwrap();
        let client = client_port(&open_requests(&node, 1).unwrap(), sizes.message_bytes).unwrap();
        let ask = |number: u64| {
            let pending = client.loan_slice_uninit(1).unwrap().write_from_slice(&[number]).send().unwrap();
            let request = server.receive().unwrap().unwrap();
            request.loan_slice_uninit(1).unwrap().write_from_slice(&[number]).send().unwrap();
            pending
        };
        for number in 0..20 * CHANNELS as u64 {
            drop(ask(number));
        }
        // Reading a channel frees it, so each channel loses at most one answer.
        let received = (0..2 * CHANNELS as u64).filter(|number| {
            let pending = ask(*number);
            pending.receive().unwrap().is_some_and(|answer| answer.payload() == [*number])
        });
        assert!(received.count() >= CHANNELS);
    }
}
