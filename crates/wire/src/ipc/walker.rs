//! The walker's end.

use std::borrow::Cow;
use std::cell::Cell;
use std::fmt::Display;
use std::mem::MaybeUninit;
use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use calm::Mixture;
use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use tokio_util::sync::CancellationToken;
use zerocopy::IntoBytes;

use super::config::{self, ClientPort, Pending, Service};
use super::{ConnectInfo, IpcError};
use crate::block::Candidate;
use crate::control::encode;
use crate::ids::WalkId;
use crate::messages::{AssignmentReport, WalkProgress};
use crate::mixture::{MixtureReader, ORIGINAL, SharedMixtureError};
use crate::protocol::frame;
use crate::protocol::message::{Answer, AnswerBody, Envelope, Payload, SenderId};
use crate::shm_dir;
use crate::transport::{Transport, WorkItem};

/// Interval between polls while waiting for an answer.
const POLL_INTERVAL: Duration = Duration::from_secs(2);
/// Timeout for the orchestrator, which may be stopped or hang.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(600);
/// The timeout after the walker was asked to stop.
const STOPPING_TIMEOUT: Duration = Duration::from_secs(20);
/// Timeout for the server to free the slot of the previous process.
const SLOT_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum number of times to send the same offer.
const MAX_OFFERS: u32 = 5;

/// The walker's end of the transport.
pub struct IpcWalker {
    sender: SenderId,
    port: ClientPort,
    wakeup: Listener<Service>,
    server_wakeup: Notifier<Service>,
    mixtures: MixtureReader,
    original: Arc<Mixture>,
    stopping: CancellationToken,
    sequence: u64,
    failure: Option<IpcError>,
    encoding: Cell<Duration>,
    message_bytes: usize,
    _node: Node<Service>,
}

/// A request that may be answered.
struct PendingAnswer(Pending);

impl Drop for PendingAnswer {
    fn drop(&mut self) {
        // Unread answers would occupy slots that later answers need (see `config::ANSWER_BUFFERS`).
        while let Ok(Some(_)) = self.0.receive() {}
    }
}

impl IpcWalker {
    /// Connects to the orchestrator. Cancelling `stopping` asks the walker to stop.
    ///
    /// # Errors
    /// The orchestrator is not running, or an error of iceoryx2.
    pub fn connect(connect_info: &ConnectInfo, stopping: CancellationToken) -> Result<Self, IpcError> {
        let ConnectInfo { sender, .. } = *connect_info;
        let node = config::node(&connect_info.directory, &connect_info.prefix)?;
        let wakeup = config::create_walker_wakeup(&node, sender)?;
        let server_wakeup = config::open_server_wakeup(&node, sender.session)?;
        let port =
            config::client_port(&config::open_requests(&node, sender.session)?, connect_info.message_bytes)?;
        shm_dir::reserve(&connect_info.prefix, Some(port.id().value()))
            .map_err(|e| IpcError::new("reserve its memory", e))?;
        let mut mixtures = open_mixture(connect_info)?;
        let original = mixtures.pin(ORIGINAL)?;
        Ok(Self {
            sender,
            port,
            wakeup,
            server_wakeup,
            mixtures,
            original,
            stopping,
            sequence: 0,
            failure: None,
            encoding: Cell::default(),
            message_bytes: connect_info.message_bytes,
            _node: node,
        })
    }

    /// The original mixture.
    pub fn original(&self) -> &Arc<Mixture> {
        &self.original
    }

    /// Why the last exchange returned no assignment; `None` if the walker was shut down.
    pub fn failure(&self) -> Option<&IpcError> {
        self.failure.as_ref()
    }

    /// Total time spent encoding messages.
    pub fn encoding(&self) -> Duration {
        self.encoding.get()
    }

    /// Sends the report until it is answered.
    fn exchange_report(
        &mut self,
        report: Option<&AssignmentReport<Candidate>>,
    ) -> Result<Option<WorkItem>, IpcError> {
        self.sequence += 1;
        let (mut offer, mut poll) = (self.offer(report)?, None);
        let (mut attempts, mut last_poll, mut last_answer) = (1, Instant::now(), Instant::now());
        loop {
            let decision = match self.answer(offer.as_ref())? {
                None => self.answer(poll.as_ref())?,
                decision => decision,
            };
            match decision {
                None => self.wait(last_poll, last_answer)?,
                Some(AnswerBody::Pending) => last_answer = Instant::now(),
                Some(AnswerBody::Shutdown) => return Ok(None),
                Some(AnswerBody::Assignment { mixture_version, assignment }) => {
                    let mixture = self.mixtures.pin(mixture_version)?;
                    return Ok(Some(WorkItem { assignment: assignment.into_owned(), mixture }));
                }
                Some(AnswerBody::Unknown) if attempts == MAX_OFFERS => {
                    return Err(IpcError::Rejected { times: MAX_OFFERS });
                }
                Some(AnswerBody::Unknown) => {
                    (offer, poll) = (self.offer(report)?, None);
                    (attempts, last_answer) = (attempts + 1, Instant::now());
                }
            }
            if last_poll.elapsed() >= POLL_INTERVAL {
                last_poll = Instant::now();
                poll = self.send(Payload::Poll { sequence: self.sequence }, None)?;
            }
        }
    }

    /// Sleeps until the server wakes this walker or the next poll is due. A signal may end the sleep early.
    fn wait(&self, last_poll: Instant, last_answer: Instant) -> Result<(), IpcError> {
        let timeout = if self.stopping() { STOPPING_TIMEOUT } else { ANSWER_TIMEOUT };
        if last_answer.elapsed() > timeout {
            return Err(IpcError::Timeout { seconds: timeout.as_secs() });
        }
        let due = POLL_INTERVAL.saturating_sub(last_poll.elapsed());
        let _ = self.wakeup.timed_wait(|_| {}, due);
        Ok(())
    }

    fn offer(&self, report: Option<&AssignmentReport<Candidate>>) -> Result<Option<PendingAnswer>, IpcError> {
        let (offer, candidate) = Payload::offer(self.sequence, report);
        self.send(offer, candidate)
    }

    /// Sends a message and wakes the server; `None` if it could not be delivered.
    fn send(
        &self,
        payload: Payload<'_>,
        candidate: Option<&Candidate>,
    ) -> Result<Option<PendingAnswer>, IpcError> {
        let begin = Instant::now();
        let control = encode(&Envelope { sender: self.sender, payload });
        let length = frame::length(control.len(), candidate);
        config::check_free_space(length, self.message_bytes)?;
        let mut memory =
            self.port.loan_slice_uninit(length / 8).map_err(|e| IpcError::new("allocate a message", e))?;
        frame::write(initialised(memory.payload_mut()).as_mut_bytes(), &control, candidate);
        // SAFETY: every word of shared memory is initialized.
        #[allow(unsafe_code)]
        let memory = unsafe { memory.assume_init() };
        self.encoding.set(self.encoding.get() + begin.elapsed());
        let pending = memory.send().map_err(|e| IpcError::new("send a message", e))?;
        if pending.number_of_server_connections() == 0 {
            return Ok(None);
        }
        // If notifying fails because the buffer is full, the server is already about to wake.
        let _ = self.server_wakeup.notify();
        Ok(Some(PendingAnswer(pending)))
    }

    /// The answer to the current offer, if it has arrived.
    fn answer(&self, request: Option<&PendingAnswer>) -> Result<Option<AnswerBody<'static>>, IpcError> {
        let Some(PendingAnswer(pending)) = request else { return Ok(None) };
        let received = pending.receive().map_err(|e| IpcError::new("receive an answer", e))?;
        let Some(received) = received else { return Ok(None) };
        let unreadable = |why: &dyn Display| IpcError::new("read an answer", why);
        let (control, _) = frame::split(received.payload().as_bytes()).map_err(|e| unreadable(&e))?;
        let answer = Answer::decode(control).map_err(|e| unreadable(&e))?;
        Ok((answer.sequence == self.sequence).then_some(answer.body))
    }
}

/// Opens the shared mixture. The server frees the slot of the previous process when it learns of its exit, which may be
/// shortly after this process starts.
fn open_mixture(connect_info: &ConnectInfo) -> Result<MixtureReader, SharedMixtureError> {
    let start = Instant::now();
    loop {
        match MixtureReader::open(&connect_info.mixture, connect_info.sender.walker) {
            Err(SharedMixtureError::SlotTaken { .. }) if start.elapsed() < SLOT_TIMEOUT => {
                sleep(Duration::from_millis(20));
            }
            opened => return opened,
        }
    }
}

impl Transport for IpcWalker {
    fn exchange(&mut self, report: Option<AssignmentReport<Candidate>>) -> Option<WorkItem> {
        let answer = self.exchange_report(report.as_ref());
        answer.unwrap_or_else(|failure| {
            self.failure = Some(failure);
            None
        })
    }

    fn progress(&self, walk: WalkId, progress: WalkProgress) {
        // May be lost.
        let _ = self.send(Payload::Progress(walk, Cow::Owned(progress)), None);
    }

    fn stopping(&self) -> bool {
        self.stopping.is_cancelled()
    }
}

/// The same memory as initialized words.
#[allow(unsafe_code)]
pub(super) fn initialised(memory: &mut [MaybeUninit<u64>]) -> &mut [u64] {
    // SAFETY: the memory is a mapped file, so the kernel has initialized every byte, with zero or with what was written
    // there before.
    unsafe { &mut *(std::ptr::from_mut(memory) as *mut [u64]) }
}
