//! The shell round the supervisor: the processes of one kind, kept alive.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::io;
use std::time::Instant;

use rustix::process::Signal;
use tokio::sync::mpsc;

use super::Launch;
use super::process::{AdoptError, Process};
use super::signs::Signs;
use super::watch::{self, News, Teller};
use crate::supervisor::{ChildStatus, Ended, Ending, Limits, Order, Supervisor};

/// Lines and ends that wait to be told; who writes more waits.
const NEWS: usize = 64;

/// What happened to the children.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// A process was started.
    Started {
        /// Which child.
        number: u32,
        /// The how-manieth start of this child, from 1.
        incarnation: u32,
        /// Process number.
        pid: u32,
    },
    /// A line that a process wrote to its standard error.
    Said {
        /// Which child.
        number: u32,
        /// The line, without its end.
        line: String,
    },
    /// A process ended, or could not be started. It has been reaped.
    Ended {
        /// Which child.
        number: u32,
        /// How, and what becomes of the child.
        ended: Ended,
    },
    /// No process is left and none will be started. Nothing comes after it.
    AllGone,
}

/// Processes of one kind, numbered from 0, which are started, watched and started again as the
/// [supervisor](crate::supervisor) orders.
pub struct Children {
    supervisor: Supervisor,
    /// What to start for a number and incarnation.
    launch: Box<dyn FnMut(u32, u32) -> Launch + Send>,
    processes: BTreeMap<u32, Process>,
    signs: Signs,
    teller: mpsc::Sender<(u32, News)>,
    news: mpsc::Receiver<(u32, News)>,
    /// What happened and was not told yet.
    events: VecDeque<Event>,
    told_all_gone: bool,
}

impl Children {
    /// So many children; [`Self::next`] starts them, each as `launch` says for its number and incarnation.
    pub fn new(
        children: u32,
        limits: Limits,
        launch: impl FnMut(u32, u32) -> Launch + Send + 'static,
    ) -> Self {
        let (teller, news) = mpsc::channel(NEWS);
        Self {
            supervisor: Supervisor::new(children, limits),
            launch: Box::new(launch),
            processes: BTreeMap::new(),
            signs: Signs::new(children),
            teller,
            news,
            events: VecDeque::new(),
            told_all_gone: false,
        }
    }

    /// Takes the process `pid` that was born at `birth` ([`store::process_start_time`]) for a child that was not started yet.
    /// It need not be a child of this process; of its end no more can be known than that it came. To be called inside the
    /// runtime.
    pub fn adopt(&mut self, number: u32, pid: u32, birth: &str) -> Result<(), AdoptError> {
        let process = Process::find(pid, birth)?;
        let end = process.end().map_err(|error| AdoptError::Refused { pid, error })?;
        if !self.supervisor.adopt(number, self.signs.now()) {
            return Err(AdoptError::Taken { pid, number });
        }
        self.processes.insert(number, process);
        tokio::spawn(watch::stranger(end, self.teller(number)));
        Ok(())
    }

    /// Where signs of life go.
    pub fn signs(&self) -> Signs {
        self.signs.clone()
    }

    /// Ends the whole set in order: SIGTERM now, SIGKILL when the time of grace is over.
    pub fn stop(&mut self) {
        self.collect_signs();
        let orders = self.supervisor.stop(self.signs.now());
        self.obey(orders);
    }

    /// There is no more work: nobody is started any more.
    pub fn close(&mut self) {
        self.supervisor.close();
    }

    /// Where the children stand.
    pub fn status(&mut self) -> Vec<ChildStatus> {
        self.collect_signs();
        self.supervisor.status(self.signs.now()).collect()
    }

    /// The next thing that happens, and everything that has to be done until then: nobody is started or killed while
    /// this is not awaited. To be awaited on the main thread: see [`crate::launcher`]. Dropped while it waits, it has lost nothing.
    pub async fn next(&mut self) -> Event {
        loop {
            // Whoever is told of an end has to know of it before the next start.
            if let Some(event) = self.events.pop_front() {
                return event;
            }
            self.collect_signs();
            let orders = self.supervisor.due(self.signs.now());
            self.obey(orders);
            if let Some(event) = self.events.pop_front() {
                return event;
            }
            if self.supervisor.is_over() && !self.told_all_gone {
                self.told_all_gone = true;
                return Event::AllGone;
            }
            let due = self.supervisor.next().and_then(|due| self.signs.instant(due));
            tokio::select! {
                Some((number, news)) = self.news.recv() => self.take_in(number, news),
                () = sleep_until(due) => {}
            }
        }
    }

    fn collect_signs(&mut self) {
        for (number, heard, useful) in self.signs.collect() {
            if useful {
                self.supervisor.useful(number, heard);
            } else {
                self.supervisor.heard(number, heard);
            }
        }
    }

    fn take_in(&mut self, number: u32, news: News) {
        match news {
            News::Said(line) => self.events.push_back(Event::Said { number, line }),
            News::Ended(ending) => {
                self.processes.remove(&number);
                // What it did before it ended.
                self.collect_signs();
                self.ended(number, ending);
            }
        }
    }

    fn ended(&mut self, number: u32, ending: Ending) {
        if let Some(ended) = self.supervisor.ended(number, ending, self.signs.now()) {
            self.events.push_back(Event::Ended { number, ended });
        }
    }

    fn obey(&mut self, orders: Vec<Order>) {
        for order in orders {
            match order {
                Order::Start { number, incarnation } => match self.start(number, incarnation) {
                    Ok(pid) => self.events.push_back(Event::Started { number, incarnation, pid }),
                    Err(error) => self.ended(number, not_started(&error)),
                },
                Order::Terminate { number } => self.signal(number, Signal::TERM),
                Order::Kill { number } => self.signal(number, Signal::KILL),
            }
        }
    }

    fn start(&mut self, number: u32, incarnation: u32) -> io::Result<u32> {
        let (mut child, setup) = (self.launch)(number, incarnation).start()?;
        let pid = child.id().ok_or_else(|| io::Error::other("it ended before it could be watched"))?;
        let process = Process::of_child(pid).inspect_err(|_| {
            // What cannot be signalled later must not live.
            let _ = child.start_kill();
        })?;
        self.processes.insert(number, process);
        tokio::spawn(watch::child(child, setup, self.teller(number)));
        Ok(pid)
    }

    fn signal(&mut self, number: u32, signal: Signal) {
        let sent = self.processes.get(&number).map(|process| process.signal(signal));
        if let Some(Err(error)) = sent {
            let line = format!("signal {} could not be sent to it: {error}", signal.as_raw());
            self.events.push_back(Event::Said { number, line });
        }
    }

    fn teller(&self, number: u32) -> Teller {
        Teller { number, news: self.teller.clone() }
    }
}

impl fmt::Debug for Children {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Children").field("supervisor", &self.supervisor).finish_non_exhaustive()
    }
}

/// The end of a start that failed.
fn not_started(error: &io::Error) -> Ending {
    let is_shortage = error.raw_os_error().is_some_and(|number| {
        [libc::EMFILE, libc::ENFILE, libc::EAGAIN, libc::ENOMEM, libc::ENOBUFS].contains(&number)
    });
    Ending::NotStarted { reason: error.to_string(), is_shortage }
}

/// Sleeps until then, or for ever.
async fn sleep_until(due: Option<Instant>) {
    match due {
        Some(due) => tokio::time::sleep_until(due.into()).await,
        None => std::future::pending().await,
    }
}
