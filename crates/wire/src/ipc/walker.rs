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
use super::{Door, IpcError};
use crate::block::Candidate;
use crate::control::seal;
use crate::exchange::frame;
use crate::exchange::message::{Answer, Caller, Decision, Letter, Words};
use crate::ids::WalkId;
use crate::messages::{Progress, Report};
use crate::mixture::{MixtureReader, SharedMixtureError};
use crate::place;
use crate::transport::{Transport, Work};

/// A walker that waits for an answer asks this often.
const ASK_EVERY: Duration = Duration::from_secs(2);
/// It gives up when the orchestrator has been silent for this long: it is stopped or hangs …
const PATIENCE: Duration = Duration::from_secs(600);
/// … and earlier when the walker was asked to stop.
const PATIENCE_WHEN_STOPPING: Duration = Duration::from_secs(20);
/// What a predecessor held is free after so long at the latest.
const PATIENCE_FOR_PREDECESSOR: Duration = Duration::from_secs(10);
/// An offer that the orchestrator says it never had is made this often.
const OFFERS: u32 = 5;

/// A walker's end of the transport.
pub struct IpcWalker {
    caller: Caller,
    port: ClientPort,
    bell: Listener<Service>,
    server_bell: Notifier<Service>,
    mixtures: MixtureReader,
    stopping: Arc<AtomicBool>,
    sequence: u64,
    failure: Option<IpcError>,
    encoding: Cell<Duration>,
    message_bytes: usize,
    _node: Node<Service>,
}

/// A message that may be answered.
struct Asked(Pending);

impl Drop for Asked {
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
    pub fn connect(door: &Door, stopping: Arc<AtomicBool>) -> Result<Self, IpcError> {
        let Door { caller, .. } = *door;
        let node = config::node(&door.directory, &door.prefix)?;
        let bell = config::create_walker_bell(&node, caller)?;
        let server_bell = config::server_bell(&node, caller.session)?;
        let port = config::client_port(&config::open_requests(&node, caller.session)?, door.message_bytes)?;
        place::reserve(&door.prefix, Some(port.id().value()))
            .map_err(|e| IpcError::new("reserve its memory", e))?;
        let mixtures = reader(door)?;
        Ok(Self {
            caller,
            port,
            bell,
            server_bell,
            mixtures,
            stopping,
            sequence: 0,
            failure: None,
            encoding: Cell::default(),
            message_bytes: door.message_bytes,
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
    fn converse(&mut self, report: Option<&Report<Candidate>>) -> Result<Option<Work>, IpcError> {
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
                Some(Decision::Wait) => heard = Instant::now(),
                Some(Decision::Home) => return Ok(None),
                Some(Decision::Turn { mixture_version, assignment }) => {
                    let mixture = self.mixtures.pin(mixture_version)?;
                    return Ok(Some(Work { assignment: assignment.into_owned(), mixture }));
                }
                Some(Decision::Unknown) if offers == OFFERS => {
                    return Err(IpcError::Refused { times: OFFERS });
                }
                Some(Decision::Unknown) => {
                    (offer, question) = (self.offer(report)?, None);
                    (offers, heard) = (offers + 1, Instant::now());
                }
            }
            if asked.elapsed() >= ASK_EVERY {
                asked = Instant::now();
                question = self.send(Words::Ask { sequence: self.sequence }, None)?;
            }
        }
    }

    /// Sleeps until the server rings or it is time to ask again. A signal may end it earlier.
    fn wait_for(&self, asked: Instant, heard: Instant) -> Result<(), IpcError> {
        let patience = if self.stopping() { PATIENCE_WHEN_STOPPING } else { PATIENCE };
        if heard.elapsed() > patience {
            return Err(IpcError::Silence { seconds: patience.as_secs() });
        }
        let due = ASK_EVERY.saturating_sub(asked.elapsed());
        let _ = self.bell.timed_wait(|_| {}, due);
        Ok(())
    }

    fn offer(&self, report: Option<&Report<Candidate>>) -> Result<Option<Asked>, IpcError> {
        let (offer, candidate) = Words::offer(self.sequence, report);
        self.send(offer, candidate)
    }

    /// Sends a message and wakes the server; `None` if it could not be delivered.
    fn send(&self, words: Words<'_>, candidate: Option<&Candidate>) -> Result<Option<Asked>, IpcError> {
        let begin = Instant::now();
        let control = seal(&Letter { caller: self.caller, words });
        let length = frame::length(control.len(), candidate);
        config::check_room(length, self.message_bytes)?;
        let mut memory = self
            .port
            .loan_slice_uninit(length / 8)
            .map_err(|e| IpcError::new("find memory for a message", e))?;
        frame::fill(initialised(memory.payload_mut()).as_mut_bytes(), &control, candidate);
        // SAFETY: every word of shared memory has a value.
        #[allow(unsafe_code)]
        let memory = unsafe { memory.assume_init() };
        self.encoding.set(self.encoding.get() + begin.elapsed());
        let pending = memory.send().map_err(|e| IpcError::new("send a message", e))?;
        if pending.number_of_server_connections() == 0 {
            return Ok(None);
        }
        // A bell that cannot be rung because its buffer is full rings already.
        let _ = self.server_bell.notify();
        Ok(Some(Asked(pending)))
    }

    /// What has been answered to the present offer.
    fn answer(&self, asked: Option<&Asked>) -> Result<Option<Decision<'static>>, IpcError> {
        let Some(Asked(pending)) = asked else { return Ok(None) };
        let received = pending.receive().map_err(|e| IpcError::new("receive an answer", e))?;
        let Some(received) = received else { return Ok(None) };
        let unreadable = |why: &dyn Display| IpcError::new("read an answer", why);
        let (control, _) = frame::split(received.payload().as_bytes()).map_err(|e| unreadable(&e))?;
        let answer = Answer::decode(control).map_err(|e| unreadable(&e))?;
        Ok((answer.sequence == self.sequence).then_some(answer.decision))
    }
}

/// Opens the mixture. What a predecessor held, the server frees when it hears of its end, which may be a moment later
/// than the start of this process.
fn reader(door: &Door) -> Result<MixtureReader, SharedMixtureError> {
    let begun = Instant::now();
    loop {
        match MixtureReader::open(&door.mixture, door.caller.walker) {
            Err(SharedMixtureError::Taken { .. }) if begun.elapsed() < PATIENCE_FOR_PREDECESSOR => {
                sleep(Duration::from_millis(20));
            }
            opened => return opened,
        }
    }
}

impl Transport for IpcWalker {
    fn exchange(&mut self, report: Option<Report<Candidate>>) -> Option<Work> {
        let answer = self.converse(report.as_ref());
        answer.unwrap_or_else(|failure| {
            self.failure = Some(failure);
            None
        })
    }

    fn progress(&self, walk: WalkId, progress: Progress) {
        // May be lost: whoever watches can do without this one.
        let _ = self.send(Words::Progress(walk, Cow::Owned(progress)), None);
    }

    fn stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }
}

/// Lent memory, to be written to.
#[allow(unsafe_code)]
fn initialised(memory: &mut [MaybeUninit<u64>]) -> &mut [u64] {
    // SAFETY: the memory is a file that is mapped: the kernel gave each byte its first value, a zero or what was
    // written there before.
    unsafe { &mut *(std::ptr::from_mut(memory) as *mut [u64]) }
}
