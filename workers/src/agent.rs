//! The agent of a host: deals the turns of a campaign that is led from another host to the walkers here.

mod numbers;
mod pool;

use std::collections::BTreeMap;
use std::pin::pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use futures_util::StreamExt;
use futures_util::future::BoxFuture;
use futures_util::stream::FuturesUnordered;
use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval, timeout};
use wire::WalkId;
use wire::messages::{Progress, Report};
use wire::net::{AgentClient, LinkError, Membership, Slot, SlotReport};
use wire::transport::{Incoming, WorkItem};

pub use self::numbers::{Numbers, Turns};
use self::pool::Pool;

/// Between two questions whether the orchestrator wants its agents to stop.
const LOOK: Duration = Duration::from_secs(2);
/// Between two pieces of news about a walk.
const NEWS: Duration = Duration::from_secs(1);
/// An orchestrator that is there answers sooner.
const SILENT: Duration = Duration::from_secs(5);
/// What walkers delivered last may take so long on its way when the agent is asked to stop.
const LAST_WORDS: Duration = Duration::from_secs(20);

/// How an agent's work ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ended {
    /// The campaign has no more work.
    Done,
    /// It was asked to stop, or every walker is gone.
    Stopped,
}

/// What an agent tells those who watch it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum News {
    /// The orchestrator wants its agents to stop.
    Stop,
    /// It does not answer.
    Silent {
        /// Reports that are kept for it.
        untold: usize,
        /// Walkers that have nothing to do.
        idle: usize,
    },
    /// It answers again.
    Back,
}

/// Deals turns.
pub struct Agent {
    /// The line to the orchestrator.
    pub uplink: Arc<AgentClient>,
    /// The place that it has been given there.
    pub joined: Membership,
    /// What comes from the walkers of this host.
    pub incoming: mpsc::Receiver<Incoming>,
    /// Set from outside: walkers are sent home with their turns where they stand.
    pub stopping: Arc<AtomicBool>,
    /// An orchestrator that has been silent for so long will not come back.
    pub patience: Duration,
    /// Kept for those who watch.
    pub numbers: Arc<Mutex<Numbers>>,
}

/// What an exchange about a slot came to.
type Exchanged = (Slot, SlotReport, Result<Option<WorkItem>, LinkError>);

/// The answer to the question whether to stop, and how long it took.
type Asked = (Result<Option<bool>, LinkError>, Duration);

/// What an agent has to say and to ask.
struct Desk {
    uplink: Arc<AgentClient>,
    joined: Arc<Membership>,
    pool: Pool,
    asking: FuturesUnordered<BoxFuture<'static, Exchanged>>,
    /// Those of them that deliver something.
    telling: usize,
    /// Whether the orchestrator wants its agents to stop.
    question: Option<BoxFuture<'static, Asked>>,
    /// A new place, when this one has been lost …
    joining: Option<BoxFuture<'static, Result<Membership, LinkError>>>,
    /// … which is taken when all that was asked from the old one has been answered.
    next_place: Option<Membership>,
    /// When the orchestrator was last heard.
    heard: Instant,
    numbers: Arc<Mutex<Numbers>>,
    /// What was told of its silence.
    silence: Option<News>,
    /// When there was last news of a walk.
    news: BTreeMap<WalkId, Instant>,
}

impl Agent {
    /// Works until there is no more work or it is asked to stop.
    ///
    /// # Errors
    /// The orchestrator is silent, or it and this program do not understand each other.
    pub async fn run(mut self, mut watch: impl FnMut(News)) -> Result<Ended, LinkError> {
        let slots = self.joined.slots();
        let uplink = Arc::clone(&self.uplink);
        let mut over = pin!(uplink.address().wait_until_over());
        let mut desk = Desk::new(self.uplink, self.joined, self.numbers);
        desk.numbers().mixture_version = Some(desk.joined.newest().await.version());
        desk.begin(slots);
        let mut look = interval(LOOK);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                message = self.incoming.recv() => match message {
                    Some(message) => desk.take_in(message),
                    None => break,
                },
                Some(exchanged) = desk.asking.next() => desk.exchanged(exchanged)?,
                joined = answered(&mut desk.joining) => desk.has_joined(joined?),
                (told, took) = answered(&mut desk.question) => if desk.is_to_stop(told, took)? { watch(News::Stop) },
                _ = look.tick() => desk.look(self.patience)?.into_iter().for_each(&mut watch),
                // Of this agent the orchestrator knew nothing any more, or it would have waited.
                () = &mut over => {
                    desk.pool.send_home();
                    return Ok(Ended::Done);
                }
            }
            if self.stopping.load(Ordering::Relaxed) {
                desk.pool.send_home();
                if desk.pool.is_idle() {
                    break;
                }
            } else if desk.pool.is_over() {
                // Of a campaign that is over, or of one that is being stopped.
                let stopped = matches!(desk.joined.is_stopping().await, Ok(Some(true)));
                desk.pool.send_home();
                desk.joined.leave().await;
                return Ok(if stopped { Ended::Stopped } else { Ended::Done });
            }
        }
        // Not for ever: a line that is down must not keep a batch job beyond its time.
        let _ = timeout(LAST_WORDS, desk.last_words()).await;
        desk.joined.leave().await;
        Ok(Ended::Stopped)
    }
}

/// The answer to a question, if one was asked.
async fn answered<T>(question: &mut Option<BoxFuture<'static, T>>) -> T {
    match question {
        Some(asked) => {
            let answer = asked.await;
            *question = None;
            answer
        }
        None => std::future::pending().await,
    }
}

impl Desk {
    fn new(uplink: Arc<AgentClient>, joined: Membership, numbers: Arc<Mutex<Numbers>>) -> Self {
        Self {
            uplink,
            joined: Arc::new(joined),
            pool: Pool::default(),
            asking: FuturesUnordered::new(),
            telling: 0,
            question: None,
            joining: None,
            next_place: None,
            heard: Instant::now(),
            numbers,
            silence: None,
            news: BTreeMap::new(),
        }
    }

    fn numbers(&self) -> MutexGuard<'_, Numbers> {
        self.numbers.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Somebody is there.
    fn hear(&mut self) {
        self.heard = Instant::now();
        self.numbers().heard = Some(self.heard);
    }

    fn begin(&mut self, slots: Vec<Slot>) {
        self.hear();
        self.numbers().places += 1;
        for (slot, told) in self.pool.begin(slots) {
            self.exchange(slot, told);
        }
    }

    /// Begins to deliver what came of a slot's turn, and to ask for the next.
    fn exchange(&mut self, mut slot: Slot, told: SlotReport) {
        self.telling += usize::from(!matches!(told, SlotReport::Empty));
        let joined = Arc::clone(&self.joined);
        self.asking.push(Box::pin(async move {
            let result = slot.exchange(&joined, &told).await;
            (slot, told, result)
        }));
    }

    fn take_in(&mut self, message: Incoming) {
        let next = match message {
            Incoming::Progress(walk, progress) => {
                self.numbers().at(walk, &progress);
                self.news(walk, progress);
                None
            }
            Incoming::Idle { walker, report, reply } => {
                if let Some(Report { walk, progress, .. }) = &report {
                    self.numbers().at(*walk, progress);
                }
                self.pool.free(walker, report, reply)
            }
            Incoming::Lost { walker, crashed } => self.pool.gone(walker, crashed),
        };
        if let Some((slot, told)) = next {
            self.exchange(slot, told);
        }
        self.count();
    }

    /// What is kept, and who waits.
    fn count(&self) {
        let mut numbers = self.numbers();
        (numbers.untold, numbers.idle) = (self.untold(), self.pool.idle());
    }

    /// Reports that the orchestrator has not taken yet.
    fn untold(&self) -> usize {
        self.telling + self.pool.untold()
    }

    fn exchanged(&mut self, (slot, told, result): Exchanged) -> Result<(), LinkError> {
        self.hear();
        self.telling -= usize::from(!matches!(told, SlotReport::Empty));
        if result.is_ok() {
            self.numbers().told(&told);
        }
        match result {
            Ok(Some(work)) => {
                self.numbers().taken(&work.assignment, work.mixture.version());
                self.pool.turn(slot, work);
            }
            Ok(None) => self.pool.sent_home(),
            Err(LinkError::RejoinRequired(_)) => {
                self.pool.keep(told);
                self.join_anew();
            }
            Err(parted) => return Err(parted),
        }
        self.take_next_place();
        self.count();
        Ok(())
    }

    /// This agent was taken for dead, or the orchestrator was started again: what it has to tell it tells in a new place.
    fn join_anew(&mut self) {
        if self.joining.is_none() && self.next_place.is_none() {
            let uplink = Arc::clone(&self.uplink);
            self.joining = Some(Box::pin(async move { uplink.join().await }));
        }
    }

    fn has_joined(&mut self, joined: Membership) {
        self.next_place = Some(joined);
        self.take_next_place();
    }

    fn take_next_place(&mut self) {
        if !self.asking.is_empty() {
            return;
        }
        if let Some(joined) = self.next_place.take() {
            let slots = joined.slots();
            self.joined = Arc::new(joined);
            self.begin(slots);
        }
    }

    /// Asks whether to stop, unless the orchestrator has been silent for so long that it is of no use. Returns what is new
    /// of its silence.
    fn look(&mut self, patience: Duration) -> Result<Option<News>, LinkError> {
        let silence = self.heard.elapsed();
        if silence > patience {
            return Err(LinkError::Timeout { minutes: patience.as_secs_f64() / 60.0 });
        }
        let joined = Arc::clone(&self.joined);
        self.question.get_or_insert_with(|| {
            Box::pin(async move {
                let asked = Instant::now();
                (joined.is_stopping().await, asked.elapsed())
            })
        });
        let now = (silence > SILENT).then(|| News::Silent { untold: self.untold(), idle: self.pool.idle() });
        let before = std::mem::replace(&mut self.silence, now);
        Ok(if now.is_none() { before.map(|_| News::Back) } else { now.filter(|_| now != before) })
    }

    fn is_to_stop(
        &mut self,
        told: Result<Option<bool>, LinkError>,
        took: Duration,
    ) -> Result<bool, LinkError> {
        match told {
            Ok(None) => return Ok(false),
            Err(LinkError::RejoinRequired(_)) => self.join_anew(),
            Err(parted) => return Err(parted),
            Ok(Some(_)) => {}
        }
        self.hear();
        self.numbers().round_trip = Some(took);
        Ok(matches!(told, Ok(Some(true))))
    }

    /// Where a walk stands, once a second.
    fn news(&mut self, walk: WalkId, progress: Progress) {
        let now = Instant::now();
        if self.news.get(&walk).is_some_and(|last| now.duration_since(*last) < NEWS) {
            return;
        }
        if let Some(slot) = self.pool.slot_of(walk) {
            self.news.insert(walk, now);
            tokio::spawn(slot.progress(Arc::clone(&self.joined), walk, progress));
        }
    }

    /// Waits until everything that is to be told has been taken. From a place that is lost it is not told: as far as the
    /// orchestrator knows nobody has those turns in hand, and they begin again where they began.
    async fn last_words(&mut self) {
        while self.telling > 0 {
            let Some((_, told, _)) = self.asking.next().await else { return };
            self.telling -= usize::from(!matches!(told, SlotReport::Empty));
        }
    }
}
