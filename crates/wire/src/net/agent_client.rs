//! The agent's end: a session with the orchestrator. Requests are repeated until they are answered.

use std::collections::VecDeque;
use std::ops::Range;
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
use super::endpoint::{self, Endpoint};
use super::handshake;
use super::link_error::{LinkError, decode_reply, unexpected};
use super::message::{AGENTS, AgentInfo, AgentReply, AgentRequest, ORCHESTRATOR};
use super::mixture_fetch::MixtureFetch;
use super::side::ConnectionSide;
use crate::control::encode;
use crate::mixture::ORIGINAL;
use crate::protocol::frame;

/// Timeout of a request, after which it is repeated.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(5);
/// Delay between attempts while the link is down.
const RETRY_DELAY: Duration = Duration::from_millis(300);
/// Interval between attempts to connect for the first time.
const CONNECT_RETRY_INTERVAL: Duration = Duration::from_secs(1);
/// Interval between checks whether the orchestrator has moved.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Number of mixture versions to keep.
const MAX_VERSIONS: usize = 4;

/// An agent's client of the orchestrator.
pub struct AgentClient {
    address: Address,
    tls: Option<Tls>,
    agent: AgentInfo,
    connection: Lock<Arc<EndpointConnection>>,
    /// Time of the last check whether the orchestrator has moved; locked during the check.
    last_poll: Mutex<Option<Instant>>,
}

/// A connection to one endpoint.
struct EndpointConnection {
    endpoint: Endpoint,
    session: Session,
    /// The heartbeat.
    _token: LivelinessToken,
}

/// Membership of an agent in a run of the orchestrator.
pub struct Membership {
    client: Arc<AgentClient>,
    /// Session of the orchestrator.
    pub(super) session: u64,
    first_slot: u32,
    /// The newest version last; locked while a version is fetched.
    mixtures: Mutex<VecDeque<Arc<Mixture>>>,
    /// The original mixture.
    pub original: Arc<Mixture>,
    /// Configuration for starting walkers.
    pub setup: Vec<u8>,
}

impl EndpointConnection {
    /// Connects to the current endpoint of the orchestrator.
    async fn find(address: &Address, tls: Option<&Tls>, agent: &AgentInfo) -> Result<Self, NetError> {
        match address.resolve()? {
            Announcement::Endpoint(endpoint) => Self::open(endpoint, tls, agent).await,
            Announcement::Over => Err(NetError::CampaignOver),
        }
    }

    async fn open(endpoint: Endpoint, tls: Option<&Tls>, agent: &AgentInfo) -> Result<Self, NetError> {
        let session = endpoint::open(ConnectionSide::Agent, &endpoint, tls).await?;
        let token = session.liveliness().declare_token(format!("{AGENTS}/{}", agent.id));
        let _token = token.await.map_err(|why| NetError::open(&endpoint, why))?;
        Ok(Self { endpoint, session, _token })
    }

    /// Sends a request once; `None` if there is no answer in time, or no link.
    async fn send_once(&self, payload: Vec<u8>) -> Option<Vec<u8>> {
        let query = self.session.get(ORCHESTRATOR).payload(payload).timeout(REQUEST_TIMEOUT);
        let replies = query.consolidation(ConsolidationMode::None).await.ok()?;
        let reply = replies.recv_async().await.ok()?;
        Some(reply.result().ok()?.payload().to_bytes().into_owned())
    }
}

impl AgentClient {
    /// Waits until an orchestrator listens at the address, and connects to it.
    ///
    /// Calls `waiting` with the reason if the first attempt fails.
    ///
    /// # Errors
    /// An endpoint off loopback without certificates, an endpoint file that cannot be read or is invalid, or a
    /// certificate that one side rejects.
    pub async fn open(
        address: &Address,
        tls: Option<&Tls>,
        agent: AgentInfo,
        waiting: impl FnOnce(&NetError),
    ) -> Result<Self, NetError> {
        let mut waiting = Some(waiting);
        let connection = loop {
            match EndpointConnection::find(address, tls, &agent).await {
                Err(
                    error @ (NetError::Open { .. }
                    | NetError::EndpointFileMissing { .. }
                    | NetError::CampaignOver),
                ) => {
                    if let (NetError::Open { endpoint, .. }, Some(tls)) = (&error, tls) {
                        check_handshake(endpoint, tls).await?;
                    }
                    waiting.take().into_iter().for_each(|waiting| waiting(&error));
                    sleep(CONNECT_RETRY_INTERVAL).await;
                }
                found => break found?,
            }
        };
        let (address, tls) = (address.clone(), tls.cloned());
        Ok(Self {
            address,
            tls,
            agent,
            connection: Lock::new(Arc::new(connection)),
            last_poll: Mutex::default(),
        })
    }

    /// Address of the orchestrator.
    pub fn address(&self) -> &Address {
        &self.address
    }

    fn connection(&self) -> Arc<EndpointConnection> {
        Arc::clone(&self.connection.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Connects to the current endpoint of the orchestrator if it has changed.
    async fn reconnect_if_moved(&self, connection: &Arc<EndpointConnection>) {
        // One of many concurrent requests without answer checks for all of them.
        let Ok(mut last_poll) = self.last_poll.try_lock() else { return };
        if last_poll.is_some_and(|last_poll| last_poll.elapsed() < POLL_INTERVAL)
            || !Arc::ptr_eq(connection, &self.connection())
        {
            return;
        }
        if let Ok(Announcement::Endpoint(endpoint)) = self.address.resolve()
            && endpoint != connection.endpoint
            && let Ok(found) = EndpointConnection::open(endpoint, self.tls.as_ref(), &self.agent).await
        {
            *self.connection.lock().unwrap_or_else(PoisonError::into_inner) = Arc::new(found);
        }
        *last_poll = Some(Instant::now());
    }

    /// Joins the campaign; repeats the request until it is answered.
    ///
    /// # Errors
    /// The orchestrator rejects the agent.
    pub async fn join(self: &Arc<Self>) -> Result<Membership, LinkError> {
        loop {
            match self.try_join().await {
                // Another orchestrator has taken over in the meantime.
                Err(LinkError::RejoinRequired(_)) => {}
                membership => return membership,
            }
        }
    }

    async fn try_join(self: &Arc<Self>) -> Result<Membership, LinkError> {
        let answer = self.request(&AgentRequest::Join(self.agent.clone())).await?;
        let AgentReply::Joined(reply) = decode_reply(&answer)? else { return Err(unexpected("join")) };
        let newest = Arc::new(self.fetch_mixture(reply.session, None, reply.mixture_version).await?);
        let original = Arc::new(self.fetch_mixture(reply.session, Some(&newest), ORIGINAL).await?);
        Ok(Membership {
            client: Arc::clone(self),
            session: reply.session,
            first_slot: reply.first_slot,
            mixtures: Mutex::new(VecDeque::from([newest])),
            original,
            setup: reply.setup.to_vec(),
        })
    }

    /// Fetches a version of the mixture; a delta if the orchestrator still has the base version.
    async fn fetch_mixture(
        &self,
        session: u64,
        base: Option<&Arc<Mixture>>,
        wanted: u64,
    ) -> Result<Mixture, LinkError> {
        let mut fetch = MixtureFetch::new(session, base.cloned(), wanted);
        loop {
            let answer = self.request(&fetch.request()).await?;
            if let Some(mixture) = fetch.receive(&answer)? {
                return Ok(mixture);
            }
        }
    }

    /// Sends a request once; `None` if there is no answer in time, or no link.
    pub(super) async fn send_once(&self, control: &[u8], candidate: Option<&[u8]>) -> Option<Vec<u8>> {
        let connection = self.connection();
        let answer = connection.send_once(frame::with_block(control, candidate).as_bytes().to_vec()).await;
        if answer.is_none() {
            self.reconnect_if_moved(&connection).await;
        }
        answer
    }

    /// Sends a request until it is answered.
    async fn request(&self, request: &AgentRequest<'_>) -> Result<Vec<u8>, LinkError> {
        let request = encode(request);
        loop {
            let sent_at = Instant::now();
            match self.send_once(&request, None).await {
                Some(answer) => return Ok(answer),
                None => delay_retry(sent_at).await,
            }
        }
    }
}

/// Checks whether a certificate prevents the connection. zenoh reports the same error if the orchestrator is not
/// running.
async fn check_handshake(endpoint: &Endpoint, tls: &Tls) -> Result<(), NetError> {
    let (endpoint, tls) = (endpoint.clone(), tls.clone());
    let probed = tokio::task::spawn_blocking(move || handshake::probe(&endpoint, &tls)).await;
    // A probe that panicked has no result.
    Ok(probed.unwrap_or(Ok(()))?)
}

/// Waits briefly if a request failed immediately.
pub(super) async fn delay_retry(sent_at: Instant) {
    if sent_at.elapsed() < RETRY_DELAY {
        sleep(RETRY_DELAY).await;
    }
}

impl Membership {
    /// Numbers of this agent's slots.
    pub(super) fn slot_numbers(&self) -> Range<u32> {
        self.first_slot..self.first_slot + self.client.agent.slots()
    }

    pub(super) fn client(&self) -> &AgentClient {
        &self.client
    }

    /// The newest mixture that has been received.
    pub async fn newest(&self) -> Arc<Mixture> {
        let mixtures = self.mixtures.lock().await;
        Arc::clone(mixtures.back().expect("joining has brought one"))
    }

    /// A version of the mixture; fetches what is missing.
    pub(super) async fn mixture(&self, version: u64) -> Result<Arc<Mixture>, LinkError> {
        let mut mixtures = self.mixtures.lock().await;
        if let Some(mixture) = mixtures.iter().find(|mixture| mixture.version() == version) {
            return Ok(Arc::clone(mixture));
        }
        let mixture = Arc::new(self.client.fetch_mixture(self.session, mixtures.back(), version).await?);
        mixtures.push_back(Arc::clone(&mixture));
        let older = mixtures.len().saturating_sub(MAX_VERSIONS);
        mixtures.drain(..older);
        Ok(mixture)
    }

    /// Fetches a file for walkers by the hash of its content.
    ///
    /// # Errors
    /// The campaign has no such file.
    pub async fn fetch_file(&self, hash: &str) -> Result<Vec<u8>, LinkError> {
        let mut bytes = Vec::new();
        loop {
            let offset = bytes.len() as u64;
            let request = AgentRequest::File { session: self.session, hash: hash.to_owned(), offset };
            let answer = self.client.request(&request).await?;
            let AgentReply::File { length, part } = decode_reply(&answer)? else {
                return Err(unexpected("file"));
            };
            bytes.extend_from_slice(part);
            if bytes.len() as u64 >= length || part.is_empty() {
                return Ok(bytes);
            }
        }
    }

    /// Whether this agent should stop; `None` if there is no answer.
    ///
    /// # Errors
    /// The agent must join again.
    pub async fn is_stopping(&self) -> Result<Option<bool>, LinkError> {
        let ping = encode(&AgentRequest::Ping { session: self.session });
        let Some(answer) = self.client.send_once(&ping, None).await else { return Ok(None) };
        match decode_reply(&answer)? {
            AgentReply::Pong { stopping } => Ok(Some(stopping)),
            _ => Err(unexpected("ping")),
        }
    }

    /// Leaves and returns all assignments. Tries once only, since a lost agent loses its assignments as well.
    pub async fn leave(&self) {
        let request = AgentRequest::Leave { session: self.session, id: self.client.agent.id.clone() };
        self.client.send_once(&encode(&request), None).await;
    }
}
