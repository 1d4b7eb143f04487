//! A stand-in for orchestrator and reactor, and for an agent.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use atoms::{Cell, Species, Structure};
use calm::{ChangedComponent, Component, Mixture};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use wire::messages::{Assignment, AssignmentReport, Outcome, WalkProgress};
use wire::net::{
    AgentBootstrap, AgentClient, AgentEvent, AgentInfo, AgentServer, Endpoint, Membership, NetError,
    StopTokens, Tls,
};
use wire::transport::{Incoming, WorkItem};
use wire::{CampaignId, Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkConditions, WalkId};

/// Timeout, much longer than anything here takes.
pub const LIMIT: Duration = Duration::from_secs(60);
/// Timeout of agents, longer than any break that they must survive here.
pub const AGENT_TIMEOUT: Duration = Duration::from_secs(40);

/// An orchestrator in this process.
pub struct TestServer {
    pub port: u16,
    pub incoming: mpsc::Receiver<Incoming>,
    pub events: Arc<Mutex<Vec<AgentEvent>>>,
    pub tokens: StopTokens,
    pub task: JoinHandle<Result<(), NetError>>,
}

/// A slot that waits for an assignment.
pub struct Offer {
    pub walker: u32,
    pub report: Option<AssignmentReport>,
    pub reply: oneshot::Sender<Option<WorkItem>>,
}

/// Options of the server.
pub struct ServerOptions {
    pub port: u16,
    pub session: u64,
    pub agent_timeout: Duration,
    pub mixture: Arc<Mixture>,
    pub original: Arc<Mixture>,
    pub files: BTreeMap<String, PathBuf>,
    pub tls: Option<Tls>,
}

impl Default for ServerOptions {
    fn default() -> Self {
        let (port, mixture) = (free_port(), Arc::new(mixture()));
        let original = Arc::clone(&mixture);
        let (agent_timeout, files) = (AGENT_TIMEOUT, BTreeMap::new());
        Self { port, session: 1, agent_timeout, mixture, original, files, tls: None }
    }
}

impl TestServer {
    pub async fn open(wanted: ServerOptions) -> Self {
        let ServerOptions { port, session, agent_timeout, mixture, original, files, tls } = wanted;
        let welcome = AgentBootstrap { setup: b"the setup".to_vec(), files };
        let server =
            AgentServer::open(&endpoint(port), tls.as_ref(), session, agent_timeout, welcome).await.unwrap();
        let tokens = StopTokens::default();
        let (to_reactor, incoming) = mpsc::channel(4);
        let events = Arc::new(Mutex::new(Vec::new()));
        let note = Arc::clone(&events);
        let note = move |event| note.lock().unwrap().push(event);
        let task = tokio::spawn(server.run(mixture, original, tokens.clone(), to_reactor, note));
        Self { port, incoming, events, tokens, task }
    }

    pub async fn next(&mut self) -> Incoming {
        timeout(LIMIT, self.incoming.recv()).await.expect("in time").expect("a message")
    }

    /// The next message other than progress, which must be an offer.
    pub async fn offer(&mut self) -> Offer {
        match self.next().await {
            Incoming::Idle { walker, report, reply } => Offer { walker, report, reply },
            other => panic!("{other:?}"),
        }
    }

    /// Waits for an event of an agent.
    pub async fn event(&self, wanted: impl Fn(&AgentEvent) -> bool) {
        let seen = async {
            while !self.events.lock().unwrap().iter().any(&wanted) {
                sleep(Duration::from_millis(20)).await;
            }
        };
        if timeout(LIMIT, seen).await.is_err() {
            panic!("only {:?}", self.events.lock().unwrap());
        }
    }

    /// Closes the server; returns when every agent has left.
    pub async fn close(self) {
        self.tokens.closing.cancel();
        timeout(LIMIT, self.task).await.expect("in time").unwrap().unwrap();
    }

    /// Ends immediately, like a killed process. Another server can then listen on the port.
    pub async fn kill(self) -> u16 {
        self.task.abort();
        let _ = self.task.await;
        let free = async {
            while TcpListener::bind(("127.0.0.1", self.port)).is_err() {
                sleep(Duration::from_millis(10)).await;
            }
        };
        timeout(LIMIT, free).await.expect("the port is free");
        self.port
    }
}

pub fn endpoint(port: u16) -> Endpoint {
    format!("tcp/127.0.0.1:{port}").parse().unwrap()
}

pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

pub fn agent(id: &str, walkers: u32) -> AgentInfo {
    AgentInfo {
        id: id.to_owned(),
        host: "here".into(),
        pid: std::process::id(),
        program_version: "0".into(),
        walkers,
        prefetch: 0,
    }
}

/// An agent that has membership.
pub async fn join(port: u16, agent: AgentInfo) -> (Arc<AgentClient>, Arc<Membership>) {
    let client = Arc::new(AgentClient::open(&endpoint(port).into(), None, agent, |_| {}).await.unwrap());
    let membership = timeout(LIMIT, client.join()).await.expect("in time").unwrap();
    (client, Arc::new(membership))
}

/// Two elements with 3 and 2 components of 20 features.
pub fn mixture() -> Mixture {
    let components = |element: usize, n: usize| (0..n).map(|slot| component(element, slot, 1.0)).collect();
    Mixture::new(0, vec![components(0, 3), components(1, 2)]).unwrap()
}

fn component(element: usize, slot: usize, scale: f64) -> Arc<Component> {
    const D: usize = 20;
    let centroid = (0..D).map(|k| (k + 7 * slot + 31 * element) as f64).collect();
    let inverse = (0..D * D).map(|k| if k % (D + 1) == 0 { scale + slot as f64 } else { 0.01 }).collect();
    Arc::new(Component::new(centroid, inverse, 1.5, None).unwrap())
}

/// The next version, which differs in one component.
pub fn next_version(mixture: &Mixture, element: usize, slot: usize) -> Arc<Mixture> {
    let component = component(element, slot, 2.0 + mixture.version() as f64);
    Arc::new(mixture.with_changes(&[ChangedComponent { element, slot, component }]).unwrap())
}

pub fn work(walk: u32, number: u64, mixture: &Arc<Mixture>) -> WorkItem {
    let walk = WalkId(walk);
    let assignment = Assignment {
        campaign: CampaignId([7; 16]),
        walk,
        number,
        origin: Origin::Biased,
        random_walk: walk,
        seed_structure: structure(),
        conditions: WalkConditions::default(),
        checkpoint: Some(vec![number as u8; 100]),
        verdict: None,
        last_step: number * 1000,
        frame_steps: Vec::new(),
        threshold_factor: 1.0,
    };
    WorkItem { assignment, mixture: Arc::clone(mixture) }
}

/// The report on an assignment.
pub fn report(assignment: &Assignment) -> AssignmentReport {
    let Assignment { campaign, walk, number, .. } = *assignment;
    let structure = structure();
    let n = structure.len();
    let candidate = Candidate {
        id: CandidateId {
            campaign,
            walk,
            segment: 0,
            step: number,
            content: ContentHash::from_structure(&structure),
        },
        origin: Origin::Biased,
        mixture_version: 3,
        temperature: 300.0,
        relative_volume: 1.0,
        energy: -(number as f64),
        virial: [[0.5; 3]; 3],
        structure,
        forces: vec![[0.25; 3]; n],
        gamma: vec![1.0; n],
        gamma_nbr: vec![2.0; n],
        features: vec![number as f64; n * 20],
    };
    let outcome = Outcome::Candidate(CandidateBlock::encode(&candidate));
    AssignmentReport {
        walk,
        assignment: number,
        outcome,
        checkpoint: number.to_le_bytes().to_vec(),
        progress: WalkProgress::default(),
        start: None,
        trace: Vec::new(),
        frames: Vec::new(),
    }
}

fn structure() -> Structure {
    let species = vec![Species::from_atomic_number(13).unwrap(); 4];
    let positions = (0..4).map(|k| [f64::from(k), 0.5, 2.0]).collect();
    let cell = Cell([[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]]);
    Structure { species, positions, cell, periodic: [true; 3] }
}
