//! A walker's end.

use std::borrow::Cow;
use std::cell::Cell;
use std::fmt::Display;
use std::mem::MaybeUninit;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use iceoryx2::node::Node;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use zerocopy::IntoBytes;

use super::config::{self, ClientPort, Pending, Service};
use super::{ConnectInfo, IpcError};
use crate::block::Candidate;
use crate::control::encode;
use crate::ids::WalkId;
use crate::messages::{Progress, Report};
use crate::mixture::{MixtureReader, SharedMixtureError};
use crate::protocol::frame;
use crate::protocol::message::{Answer, AnswerBody, Envelope, Payload, SenderId};
use crate::shm_dir;
use crate::transport::{Transport, WorkItem};

/// A walker that waits for an answer asks this often.
const POLL_INTERVAL: Duration = Duration::from_secs(2);
/// It gives up when the orchestrator has been silent for this long: it is stopped or hangs …
const ANSWER_TIMEOUT: Duration = Duration::from_secs(600);
/// … and earlier when the walker was asked to stop.
const STOPPING_TIMEOUT: Duration = Duration::from_secs(20);
/// What a predecessor held is free after so long at the latest.
const SLOT_TIMEOUT: Duration = Duration::from_secs(10);
/// An offer that the orchestrator says it never had is made this often.
const MAX_OFFERS: u32 = 5;

/// A walker's end of the transport.
pub struct IpcWalker {
    sender: SenderId,
    port: ClientPort,
    wakeup: Listener<Service>,
    server_wakeup: Notifier<Service>,
    mixtures: MixtureReader,
    stopping: Arc<AtomicBool>,
    sequence: u64,
    failure: Option<IpcError>,
    encoding: Cell<Duration>,
    message_bytes: usize,
    _node: Node<Service>,
}

/// A message that may be answered.
struct PendingAnswer(Pending);

impl Drop for PendingAnswer {
    fn drop(&mut self) {
        // What nobody reads would keep its place, which a later answer needs (see `config::ANSWER_BUFFERS`).
        while let Ok(Some(_)) = self.0.receive() {}
    }
}

impl IpcWalker {
    /// Connects to the orchestrator. Setting `stopping` asks the walker to stop.
    ///
    /// # Errors
    /// An orchestrator that is not there, or whatever iceoryx2 says.
    pub fn connect(connect_info: &ConnectInfo, stopping: Arc<AtomicBool>) -> Result<Self, IpcError> {
        let ConnectInfo { sender, .. } = *connect_info;
        let node = config::node(&connect_info.directory, &connect_info.prefix)?;
        let wakeup = config::create_walker_wakeup(&node, sender)?;
        let server_wakeup = config::open_server_wakeup(&node, sender.session)?;
        let port =
            config::client_port(&config::open_requests(&node, sender.session)?, connect_info.message_bytes)?;
        shm_dir::reserve(&connect_info.prefix, Some(port.id().value()))
            .map_err(|e| IpcError::new("reserve its memory", e))?;
        let mixtures = reader(connect_info)?;
        Ok(Self {
            sender,
            port,
            wakeup,
            server_wakeup,
            mixtures,
            stopping,
            sequence: 0,
            failure: None,
            encoding: Cell::default(),
            message_bytes: connect_info.message_bytes,
            _node: node,
        })
    }

    /// Why the last exchange ended without a turn; none if the walker was sent home.
    pub fn failure(&self) -> Option<&IpcError> {
        self.failure.as_ref()
    }

    /// Time spent so far on encoding messages.
    pub fn encoding(&self) -> Duration {
        self.encoding.get()
    }

    /// Offers the report until there is an answer.
    fn converse(&mut self, report: Option<&Report<Candidate>>) -> Result<Option<WorkItem>, IpcError> {
        self.sequence += 1;
        let (mut offer, mut question) = (self.offer(report)?, None);
        let (mut offers, mut asked, mut heard) = (1, Instant::now(), Instant::now());
        loop {
            let decision = match self.answer(offer.as_ref())? {
                None => self.answer(question.as_ref())?,
                decision => decision,
            };
            match decision {
                None => self.wait_for(asked, heard)?,
                Some(AnswerBody::Pending) => heard = Instant::now(),
                Some(AnswerBody::Shutdown) => return Ok(None),
                Some(AnswerBody::Assignment { mixture_version, assignment }) => {
                    let mixture = self.mixtures.pin(mixture_version)?;
                    return Ok(Some(WorkItem { assignment: assignment.into_owned(), mixture }));
                }
                Some(AnswerBody::Unknown) if offers == MAX_OFFERS => {
                    return Err(IpcError::Rejected { times: MAX_OFFERS });
                }
                Some(AnswerBody::Unknown) => {
                    (offer, question) = (self.offer(report)?, None);
                    (offers, heard) = (offers + 1, Instant::now());
                }
            }
            if asked.elapsed() >= POLL_INTERVAL {
                asked = Instant::now();
                question = self.send(Payload::Poll { sequence: self.sequence }, None)?;
            }
        }
    }

    /// Sleeps until the server rings or it is time to ask again. A signal may end it earlier.
    fn wait_for(&self, asked: Instant, heard: Instant) -> Result<(), IpcError> {
        let timeout = if self.stopping() { STOPPING_TIMEOUT } else { ANSWER_TIMEOUT };
        if heard.elapsed() > timeout {
            return Err(IpcError::Timeout { seconds: timeout.as_secs() });
        }
        let due = POLL_INTERVAL.saturating_sub(asked.elapsed());
        let _ = self.wakeup.timed_wait(|_| {}, due);
        Ok(())
    }

    fn offer(&self, report: Option<&Report<Candidate>>) -> Result<Option<PendingAnswer>, IpcError> {
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
        let mut memory = self
            .port
            .loan_slice_uninit(length / 8)
            .map_err(|e| IpcError::new("find memory for a message", e))?;
        frame::write(initialised(memory.payload_mut()).as_mut_bytes(), &control, candidate);
        // SAFETY: every word of shared memory has a value.
        #[allow(unsafe_code)]
        let memory = unsafe { memory.assume_init() };
        self.encoding.set(self.encoding.get() + begin.elapsed());
        let pending = memory.send().map_err(|e| IpcError::new("send a message", e))?;
        if pending.number_of_server_connections() == 0 {
            return Ok(None);
        }
        // A wakeup that cannot be wakeup because its buffer is full rings already.
        let _ = self.server_wakeup.notify();
        Ok(Some(PendingAnswer(pending)))
    }

    /// What has been answered to the present offer.
    fn answer(&self, asked: Option<&PendingAnswer>) -> Result<Option<AnswerBody<'static>>, IpcError> {
        let Some(PendingAnswer(pending)) = asked else { return Ok(None) };
        let received = pending.receive().map_err(|e| IpcError::new("receive an answer", e))?;
        let Some(received) = received else { return Ok(None) };
        let unreadable = |why: &dyn Display| IpcError::new("read an answer", why);
        let (control, _) = frame::split(received.payload().as_bytes()).map_err(|e| unreadable(&e))?;
        let answer = Answer::decode(control).map_err(|e| unreadable(&e))?;
        Ok((answer.sequence == self.sequence).then_some(answer.body))
    }
}

/// Opens the mixture. What a predecessor held, the server frees when it hears of its end, which may be a moment later
/// than the start of this process.
fn reader(connect_info: &ConnectInfo) -> Result<MixtureReader, SharedMixtureError> {
    let begun = Instant::now();
    loop {
        match MixtureReader::open(&connect_info.mixture, connect_info.sender.walker) {
            Err(SharedMixtureError::SlotTaken { .. }) if begun.elapsed() < SLOT_TIMEOUT => {
                sleep(Duration::from_millis(20));
            }
            opened => return opened,
        }
    }
}

impl Transport for IpcWalker {
    fn exchange(&mut self, report: Option<Report<Candidate>>) -> Option<WorkItem> {
        let answer = self.converse(report.as_ref());
        answer.unwrap_or_else(|failure| {
            self.failure = Some(failure);
            None
        })
    }

    fn progress(&self, walk: WalkId, progress: Progress) {
        // May be lost: whoever watches can do without this one.
        let _ = self.send(Payload::Progress(walk, Cow::Owned(progress)), None);
    }

    fn stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }
}

/// BorrowedRequest memory, to be written to.
#[allow(unsafe_code)]
fn initialised(memory: &mut [MaybeUninit<u64>]) -> &mut [u64] {
    // SAFETY: the memory is a file that is mapped: the kernel gave each byte its first value, a zero or what was
    // written there before.
    unsafe { &mut *(std::ptr::from_mut(memory) as *mut [u64]) }
}
