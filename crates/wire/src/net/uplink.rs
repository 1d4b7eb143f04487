//! An agent's end: one session with the orchestrator, in which everything is asked until it is answered.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex as Lock, PoisonError};
use std::time::Duration;

use calm::Mixture;
use tokio::sync::Mutex;
use tokio::time::{Instant, sleep};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::ConsolidationMode;
use zerocopy::IntoBytes;

use super::NetError;
use super::address::{Address, Announcement};
use super::certificates::Tls;
use super::changes::{Arriving, ChangesError};
use super::door::{self, Endpoint, Side};
use super::handshake;
use super::message::{AGENTS, Agent, ORCHESTRATOR, Reply, Request};
use super::slot::Slot;
use crate::control::{ControlError, seal, unseal};
use crate::exchange::frame;

/// A question without an answer is asked again after this.
const ASK_EVERY: Duration = Duration::from_secs(5);
/// Between two tries while there is no line.
const PAUSE: Duration = Duration::from_millis(300);
/// Between two tries to connect for the first time.
const NEXT_TRY: Duration = Duration::from_secs(1);
/// Between two looks whether the orchestrator is somewhere else.
const LOOK: Duration = Duration::from_secs(1);
/// Versions of the mixture that are kept.
const VERSIONS: usize = 4;

/// An agent's line to the orchestrator.
pub struct Uplink {
    address: Address,
    tls: Option<Tls>,
    agent: Agent,
    line: Lock<Arc<Line>>,
    /// Held by who looks for the orchestrator, with the moment of the last look.
    looked: Mutex<Option<Instant>>,
}

/// A connection to the orchestrator in one place.
struct Line {
    endpoint: Endpoint,
    session: Session,
    /// The sign of life.
    _token: LivelinessToken,
}

/// A place among the walkers of a campaign.
pub struct Joined {
    uplink: Arc<Uplink>,
    /// Of this run of the orchestrator.
    pub(super) session: u64,
    first_slot: u32,
    /// The newest version last; taken in by one slot at a time.
    mixtures: Mutex<VecDeque<Arc<Mixture>>>,
    /// What walkers are to be started with.
    pub setup: Vec<u8>,
}

/// Why an agent has no place any more, or gets none.
#[derive(Debug, thiserror::Error)]
pub enum Parted {
    /// It was taken for dead, or the orchestrator was started again: it may join anew, with what it has to tell.
    #[error("{0}")]
    Stranger(String),
    /// The orchestrator does not understand what this program says.
    #[error("the orchestrator refuses a message: {0}")]
    Refused(String),
    /// Nothing has been heard of it.
    #[error("the orchestrator has not answered for {minutes:.1} min")]
    Silence {
        /// How long.
        minutes: f64,
    },
    /// This program does not understand what the orchestrator says: another version of it, in the first place.
    #[error("an answer of the orchestrator cannot be read: {0}")]
    Unreadable(String),
}

impl From<ControlError> for Parted {
    fn from(why: ControlError) -> Self {
        Self::Unreadable(why.to_string())
    }
}

impl From<ChangesError> for Parted {
    fn from(why: ChangesError) -> Self {
        Self::Unreadable(why.to_string())
    }
}

impl Line {
    /// Connects to where the orchestrator is said to be.
    async fn find(address: &Address, tls: Option<&Tls>, agent: &Agent) -> Result<Self, NetError> {
        match address.look()? {
            Announcement::At(endpoint) => Self::open(endpoint, tls, agent).await,
            Announcement::Over => Err(NetError::Over),
        }
    }

    async fn open(endpoint: Endpoint, tls: Option<&Tls>, agent: &Agent) -> Result<Self, NetError> {
        let session = door::open(Side::Agent, &endpoint, tls).await?;
        let token = session.liveliness().declare_token(format!("{AGENTS}/{}", agent.id));
        let _token = token.await.map_err(|why| NetError::open(&endpoint, why))?;
        Ok(Self { endpoint, session, _token })
    }

    /// Asks once; `None` if there was no answer in time, or no line.
    async fn ask(&self, payload: Vec<u8>) -> Option<Vec<u8>> {
        let query = self.session.get(ORCHESTRATOR).payload(payload).timeout(ASK_EVERY);
        let replies = query.consolidation(ConsolidationMode::None).await.ok()?;
        let reply = replies.recv_async().await.ok()?;
        Some(reply.result().ok()?.payload().to_bytes().into_owned())
    }
}

impl Uplink {
    /// Waits until an orchestrator listens at the address, and makes itself known there.
    ///
    /// `waiting` is told why the first try did not succeed.
    ///
    /// # Errors
    /// An endpoint off loopback without certificates, files that cannot be read or that say something else, certificates
    /// that one of the two sides does not accept.
    pub async fn open(
        address: &Address,
        tls: Option<&Tls>,
        agent: Agent,
        waiting: impl FnOnce(&NetError),
    ) -> Result<Self, NetError> {
        let mut waiting = Some(waiting);
        let line = loop {
            match Line::find(address, tls, &agent).await {
                Err(error @ (NetError::Open { .. } | NetError::Nobody { .. } | NetError::Over)) => {
                    if let (NetError::Open { endpoint, .. }, Some(tls)) = (&error, tls) {
                        can_agree(endpoint, tls).await?;
                    }
                    waiting.take().into_iter().for_each(|waiting| waiting(&error));
                    sleep(NEXT_TRY).await;
                }
                found => break found?,
            }
        };
        let (address, tls) = (address.clone(), tls.cloned());
        Ok(Self { address, tls, agent, line: Lock::new(Arc::new(line)), looked: Mutex::default() })
    }

    /// Where it looks for the orchestrator.
    pub fn address(&self) -> &Address {
        &self.address
    }

    fn line(&self) -> Arc<Line> {
        Arc::clone(&self.line.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Goes to where the orchestrator is said to be, if that is not where the line leads.
    async fn follow(&self, line: &Arc<Line>) {
        // One of many who have no answer looks for all of them.
        let Ok(mut looked) = self.looked.try_lock() else { return };
        if looked.is_some_and(|looked| looked.elapsed() < LOOK) || !Arc::ptr_eq(line, &self.line()) {
            return;
        }
        if let Ok(Announcement::At(endpoint)) = self.address.look()
            && endpoint != line.endpoint
            && let Ok(found) = Line::open(endpoint, self.tls.as_ref(), &self.agent).await
        {
            *self.line.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(found);
        }
        *looked = Some(Instant::now());
    }

    /// Asks for a place until it is given one.
    ///
    /// # Errors
    /// A place is refused.
    pub async fn join(self: &Arc<Self>) -> Result<Joined, Parted> {
        loop {
            match self.try_to_join().await {
                // Another orchestrator has taken its place in the meantime.
                Err(Parted::Stranger(_)) => {}
                joined => return joined,
            }
        }
    }

    async fn try_to_join(self: &Arc<Self>) -> Result<Joined, Parted> {
        let answer = self.insist(&Request::Join(self.agent.clone())).await?;
        let Reply::Joined(place) = read(&answer)? else { return Err(unexpected("join")) };
        let joined = Joined {
            uplink: Arc::clone(self),
            session: place.session,
            first_slot: place.first_slot,
            mixtures: Mutex::default(),
            setup: place.setup.to_vec(),
        };
        joined.mixture(place.mixture_version).await?;
        Ok(joined)
    }

    /// Asks once; `None` if there was no answer in time, or no line.
    pub(super) async fn ask(&self, control: &[u8], candidate: Option<&[u8]>) -> Option<Vec<u8>> {
        let line = self.line();
        let answer = line.ask(frame::beside(control, candidate).as_bytes().to_vec()).await;
        if answer.is_none() {
            self.follow(&line).await;
        }
        answer
    }

    /// Asks until there is an answer.
    async fn insist(&self, request: &Request<'_>) -> Result<Vec<u8>, Parted> {
        let request = seal(request);
        loop {
            let asked = Instant::now();
            match self.ask(&request, None).await {
                Some(answer) => return Ok(answer),
                None => pause(asked).await,
            }
        }
    }
}

/// Checks that no certificate stands between the two sides: zenoh does not tell that from an orchestrator that is not there yet.
async fn can_agree(endpoint: &Endpoint, tls: &Tls) -> Result<(), NetError> {
    let (endpoint, tls) = (endpoint.clone(), tls.clone());
    let probed = tokio::task::spawn_blocking(move || handshake::probe(&endpoint, &tls)).await;
    // A probe that crashed has found out nothing.
    Ok(probed.unwrap_or(Ok(()))?)
}

/// Waits a little after a question that was not even asked.
pub(super) async fn pause(asked: Instant) {
    if asked.elapsed() < PAUSE {
        sleep(PAUSE).await;
    }
}

/// An answer that is not a refusal.
pub(super) fn read(answer: &[u8]) -> Result<Reply<'_>, Parted> {
    match unseal(answer)? {
        Reply::Stranger(why) => Err(Parted::Stranger(why)),
        Reply::Refused(why) => Err(Parted::Refused(why)),
        reply => Ok(reply),
    }
}

fn unexpected(to: &str) -> Parted {
    Parted::Unreadable(format!("it does not answer the question ({to})"))
}

impl Joined {
    /// A conversation for each turn that this agent may have in hand.
    pub fn slots(&self) -> Vec<Slot> {
        let numbers = self.first_slot..self.first_slot + self.uplink.agent.slots();
        numbers.map(|number| Slot::new(self.session, number)).collect()
    }

    pub(super) fn uplink(&self) -> &Uplink {
        &self.uplink
    }

    /// The newest mixture that is here.
    pub async fn newest(&self) -> Arc<Mixture> {
        let mixtures = self.mixtures.lock().await;
        Arc::clone(mixtures.back().expect("joining has brought one"))
    }

    /// A version of the mixture; what is not here of it is asked for.
    pub(super) async fn mixture(&self, version: u64) -> Result<Arc<Mixture>, Parted> {
        let mut mixtures = self.mixtures.lock().await;
        if let Some(mixture) = mixtures.iter().find(|mixture| mixture.version() == version) {
            return Ok(Arc::clone(mixture));
        }
        let mixture = Arc::new(self.fetch(mixtures.back(), version).await?);
        mixtures.push_back(Arc::clone(&mixture));
        let older = mixtures.len().saturating_sub(VERSIONS);
        mixtures.drain(..older);
        Ok(mixture)
    }

    async fn fetch(&self, base: Option<&Arc<Mixture>>, wanted: u64) -> Result<Mixture, Parted> {
        let have = base.map(|base| base.version());
        let mut arriving: Option<Arriving> = None;
        loop {
            let skip = arriving.as_ref().map_or(0, Arriving::received);
            let request = Request::Mixture { session: self.session, have, wanted, skip };
            let answer = self.uplink.insist(&request).await?;
            let Reply::Mixture(part) = read(&answer)? else { return Err(unexpected("mixture")) };
            let parts = match &mut arriving {
                Some(parts) if parts.continues(&part) => parts,
                // The version to start from has been given up meanwhile: from the beginning, without it.
                Some(_) => {
                    arriving = None;
                    continue;
                }
                None => arriving.insert(Arriving::begin(
                    &part,
                    base.filter(|_| part.from.is_some()).map(|base| &**base),
                )?),
            };
            if parts.take(&part)? {
                break;
            }
        }
        Ok(arriving.expect("the loop ends with one").finish()?)
    }

    /// A file that walkers need, by the hash of its content.
    ///
    /// # Errors
    /// The campaign has no such file.
    pub async fn file(&self, hash: &str) -> Result<Vec<u8>, Parted> {
        let mut bytes = Vec::new();
        loop {
            let offset = bytes.len() as u64;
            let request = Request::File { session: self.session, hash: hash.to_owned(), offset };
            let answer = self.uplink.insist(&request).await?;
            let Reply::File { length, part } = read(&answer)? else { return Err(unexpected("file")) };
            bytes.extend_from_slice(part);
            if bytes.len() as u64 >= length || part.is_empty() {
                return Ok(bytes);
            }
        }
    }

    /// Whether this agent is to stop; `None` if there is no answer.
    ///
    /// # Errors
    /// It has no place any more.
    pub async fn is_stopping(&self) -> Result<Option<bool>, Parted> {
        let question = seal(&Request::Here { session: self.session });
        let Some(answer) = self.uplink.ask(&question, None).await else { return Ok(None) };
        match read(&answer)? {
            Reply::Here { stopping } => Ok(Some(stopping)),
            _ => Err(unexpected("here")),
        }
    }

    /// Leaves: turns that are still in hand are free. One try, since those who are taken for dead have left as well.
    pub async fn leave(&self) {
        let request = Request::Leave { session: self.session, id: self.uplink.agent.id.clone() };
        self.uplink.ask(&seal(&request), None).await;
    }
}
