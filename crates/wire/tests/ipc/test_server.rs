//! A stand-in for orchestrator, supervisor and reactor.

use std::path::Path;
use std::process::Child;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use calm::{Component, Mixture};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinHandle;
use tokio::time::timeout;
use wire::ipc::{ConnectInfo, IpcError, IpcServer, ServerHandle, Sizes, space_needed};
use wire::messages::{AssignmentReport, Outcome};
use wire::mixture::SharedMixture;
use wire::shm_dir::{PreparedDir, ShmDir};
use wire::transport::{Incoming, WorkItem};
use wire::{CandidateBlock, WalkId};

use super::process::{Role, assignment, candidate, start};

/// Timeout, much longer than anything here takes.
const LIMIT: Duration = Duration::from_secs(60);

/// Distinguishes the sessions of these tests.
static SESSION: AtomicU64 = AtomicU64::new(1);

/// An orchestrator in this process.
pub struct TestServer {
    pub place: ShmDir,
    prepared: PreparedDir,
    pub handle: ServerHandle,
    pub incoming: mpsc::Receiver<Incoming>,
    /// Walkers of the received messages, in order.
    pub heard: Arc<Mutex<Vec<u32>>>,
    pub task: JoinHandle<Result<(), IpcError>>,
}

/// A walker that waits for an assignment.
pub struct Offer {
    pub walker: u32,
    pub report: Option<AssignmentReport>,
    pub reply: oneshot::Sender<Option<WorkItem>>,
}

impl TestServer {
    pub fn open(directory: &Path, walkers: u32, message_bytes: usize) -> Self {
        let place = ShmDir::for_campaign(directory).unwrap();
        let sizes = Sizes { walkers, message_bytes };
        let prepared = place.prepare(space_needed(&sizes)).unwrap();
        let mut mixtures = SharedMixture::create(&place.mixture(), &mixture(0), walkers).unwrap();
        mixtures.publish_original(&mixture(0)).unwrap();
        let session = SESSION.fetch_add(1, Ordering::Relaxed);
        let server = IpcServer::open(&place, sizes, session).unwrap();
        let handle = server.handle();
        let (to_reactor, incoming) = mpsc::channel(4);
        let heard = Arc::new(Mutex::new(Vec::new()));
        let note = Arc::clone(&heard);
        let note = move |walker, _| note.lock().unwrap().push(walker);
        let task = tokio::spawn(server.run(mixtures, to_reactor, note));
        Self { place, prepared, handle, incoming, heard, task }
    }

    /// Expects a walker and starts its process.
    pub fn start(&self, walker: u32, incarnation: u32, role: impl FnOnce(ConnectInfo) -> Role) -> Child {
        self.handle.expect(walker, incarnation);
        start(&role(self.handle.connect_info(walker, incarnation)))
    }

    /// The next message other than progress.
    pub async fn next(&mut self) -> Incoming {
        loop {
            let incoming = timeout(LIMIT, self.incoming.recv()).await.expect("in time").expect("a message");
            if !matches!(incoming, Incoming::Progress(..)) {
                return incoming;
            }
        }
    }

    /// The next message other than progress, which must be an offer.
    pub async fn offer(&mut self) -> Offer {
        match self.next().await {
            Incoming::Idle { walker, report, reply } => Offer { walker, report, reply },
            other => panic!("{other:?}"),
        }
    }

    /// Sends an assignment, and checks and returns the offer that answers it.
    pub async fn go_on(&mut self, offer: Offer, number: u64, size: (usize, usize)) -> Offer {
        let walker = offer.walker;
        offer.reply.send(Some(work(walker, number, size))).unwrap();
        let next = self.offer().await;
        assert_eq!(next.walker, walker);
        check(next.report.as_ref().unwrap(), walker, number, size);
        next
    }

    /// Closes the server after all processes have exited, and checks that no files remain.
    pub async fn close(self) {
        self.handle.close();
        timeout(LIMIT, self.task).await.expect("in time").unwrap().unwrap();
        drop(self.prepared);
        self.place.remove().unwrap();
        assert_eq!(files_of(&self.place), Vec::<String>::new());
    }
}

/// An assignment with its mixture, whose version is the number of the assignment.
pub fn work(walker: u32, number: u64, size: (usize, usize)) -> WorkItem {
    WorkItem { assignment: assignment(walker, number, size), mixture: Arc::new(mixture(number)) }
}

/// Checks that a report answers this assignment.
pub fn check(report: &AssignmentReport, walker: u32, number: u64, size: (usize, usize)) {
    let AssignmentReport { walk, assignment: found, ref checkpoint, ref outcome, .. } = *report;
    assert_eq!((walk, found, checkpoint.as_slice()), (WalkId(walker), number, &number.to_le_bytes()[..]));
    let expected = CandidateBlock::encode(&candidate(&assignment(walker, number, size)));
    assert_eq!(*outcome, Outcome::Candidate(expected));
}

/// All files of a campaign.
pub fn files_of(place: &ShmDir) -> Vec<String> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir("/dev/shm").unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap();
        if name.starts_with(place.prefix()) {
            found.push(name);
        }
    }
    if place.directory().exists() {
        found.push(place.directory().display().to_string());
    }
    found
}

fn mixture(version: u64) -> Mixture {
    Mixture::new(version, vec![vec![Arc::new(Component::unknown_element(2))]]).unwrap()
}
