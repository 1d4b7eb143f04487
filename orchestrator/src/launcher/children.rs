//! Runs the processes of one kind for the supervisor.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::io;
use std::time::Instant;

use rustix::process::Signal;
use tokio::sync::mpsc;

use super::Launch;
use super::child_monitor::{self, ChildNews, ChildReporter};
use super::heartbeats::Heartbeats;
use super::process::{AdoptError, ProcessHandle};
use crate::supervisor::{ChildExit, ChildStatus, ExitReason, Limits, Supervisor, SupervisorAction};

/// Maximum number of queued lines and exits; further writers wait.
const MAX_QUEUED: usize = 64;

/// An event of the children.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ChildEvent {
    /// A process was started.
    Started {
        /// Number of the child.
        number: u32,
        /// Start count of this child, from 1.
        incarnation: u32,
        /// Process id.
        pid: u32,
    },
    /// A process wrote a line to its standard error.
    Stderr {
        /// Number of the child.
        number: u32,
        /// The line, without line ending.
        line: String,
    },
    /// A process exited and was waited for, or could not be started.
    Ended {
        /// Number of the child.
        number: u32,
        /// The exit and the new state of the child.
        ended: ChildExit,
    },
    /// No process is running and none will be started. The last event.
    AllExited,
}

/// Processes of one kind, numbered from 0, which are started, monitored and restarted as the
/// [supervisor](crate::supervisor) decides.
pub struct Children {
    supervisor: Supervisor,
    /// How to start the process with this number and incarnation.
    launch: Box<dyn FnMut(u32, u32) -> Launch + Send>,
    processes: BTreeMap<u32, ProcessHandle>,
    heartbeats: Heartbeats,
    reporter: mpsc::Sender<(u32, ChildNews)>,
    news: mpsc::Receiver<(u32, ChildNews)>,
    /// Events that were not returned yet.
    events: VecDeque<ChildEvent>,
    reported_all_exited: bool,
}

impl Children {
    /// This number of children. [`Self::next`] starts them; `launch` says how for each number and incarnation.
    pub fn new(
        children: u32,
        limits: Limits,
        launch: impl FnMut(u32, u32) -> Launch + Send + 'static,
    ) -> Self {
        let (reporter, news) = mpsc::channel(MAX_QUEUED);
        Self {
            supervisor: Supervisor::new(children, limits),
            launch: Box::new(launch),
            processes: BTreeMap::new(),
            heartbeats: Heartbeats::new(children),
            reporter,
            news,
            events: VecDeque::new(),
            reported_all_exited: false,
        }
    }

    /// Adopts process `pid`, which started at `start_time` ([`store::process_start_time`]), as a child that was never
    /// started. It need not be a child of this process, but then the reason of its exit remains unknown. Must be called
    /// in a tokio runtime.
    pub fn adopt(&mut self, number: u32, pid: u32, start_time: &str) -> Result<(), AdoptError> {
        let process = ProcessHandle::open_running(pid, start_time)?;
        let end = process.end().map_err(|error| AdoptError::Refused { pid, error })?;
        if !self.supervisor.adopt(number, self.heartbeats.now()) {
            return Err(AdoptError::NotAdoptable { pid, number });
        }
        self.processes.insert(number, process);
        tokio::spawn(child_monitor::monitor_adopted(end, self.reporter(number)));
        Ok(())
    }

    /// Where to send heartbeats.
    pub fn heartbeats(&self) -> Heartbeats {
        self.heartbeats.clone()
    }

    /// Stops all processes: SIGTERM now, SIGKILL after the grace period.
    pub fn stop(&mut self) {
        self.collect_heartbeats();
        let actions = self.supervisor.stop(self.heartbeats.now());
        self.execute(actions);
    }

    /// There is no more work: starts no more processes.
    pub fn close(&mut self) {
        self.supervisor.close();
    }

    /// Status of the children.
    pub fn status(&mut self) -> Vec<ChildStatus> {
        self.collect_heartbeats();
        self.supervisor.status(self.heartbeats.now()).collect()
    }

    /// Returns the next event and performs all actions until then: no process is started or killed unless this is
    /// awaited. Await it on the main thread, see [`crate::launcher`]. Cancel safe.
    pub async fn next(&mut self) -> ChildEvent {
        loop {
            // The caller must learn of an exit before the next start.
            if let Some(event) = self.events.pop_front() {
                return event;
            }
            self.collect_heartbeats();
            let actions = self.supervisor.due_actions(self.heartbeats.now());
            self.execute(actions);
            if let Some(event) = self.events.pop_front() {
                return event;
            }
            if self.supervisor.is_over() && !self.reported_all_exited {
                self.reported_all_exited = true;
                return ChildEvent::AllExited;
            }
            let due = self.supervisor.next_deadline().and_then(|due| self.heartbeats.instant(due));
            tokio::select! {
                Some((number, news)) = self.news.recv() => self.process_news(number, news),
                () = sleep_until(due) => {}
            }
        }
    }

    fn collect_heartbeats(&mut self) {
        for (number, heard, delivered) in self.heartbeats.collect() {
            if delivered {
                self.supervisor.delivered(number, heard);
            } else {
                self.supervisor.heartbeat(number, heard);
            }
        }
    }

    fn process_news(&mut self, number: u32, news: ChildNews) {
        match news {
            ChildNews::Stderr(line) => self.events.push_back(ChildEvent::Stderr { number, line }),
            ChildNews::Ended(reason) => {
                self.processes.remove(&number);
                // Heartbeats from before the exit.
                self.collect_heartbeats();
                self.ended(number, reason);
            }
        }
    }

    fn ended(&mut self, number: u32, reason: ExitReason) {
        if let Some(ended) = self.supervisor.ended(number, reason, self.heartbeats.now()) {
            self.events.push_back(ChildEvent::Ended { number, ended });
        }
    }

    fn execute(&mut self, actions: Vec<SupervisorAction>) {
        for action in actions {
            match action {
                SupervisorAction::Start { number, incarnation } => match self.start(number, incarnation) {
                    Ok(pid) => self.events.push_back(ChildEvent::Started { number, incarnation, pid }),
                    Err(error) => self.ended(number, start_failure(&error)),
                },
                SupervisorAction::Terminate { number } => self.signal(number, Signal::TERM),
                SupervisorAction::Kill { number } => self.signal(number, Signal::KILL),
            }
        }
    }

    fn start(&mut self, number: u32, incarnation: u32) -> io::Result<u32> {
        let (mut child, setup) = (self.launch)(number, incarnation).start()?;
        let pid = child.id().ok_or_else(|| io::Error::other("it exited before it could be monitored"))?;
        let process = ProcessHandle::from_child(pid).inspect_err(|_| {
            // A process that cannot be signalled later must not live.
            let _ = child.start_kill();
        })?;
        self.processes.insert(number, process);
        tokio::spawn(child_monitor::monitor_child(child, setup, self.reporter(number)));
        Ok(pid)
    }

    fn signal(&mut self, number: u32, signal: Signal) {
        let sent = self.processes.get(&number).map(|process| process.signal(signal));
        if let Some(Err(error)) = sent {
            let line = format!("cannot send signal {} to it: {error}", signal.as_raw());
            self.events.push_back(ChildEvent::Stderr { number, line });
        }
    }

    fn reporter(&self, number: u32) -> ChildReporter {
        ChildReporter { number, news: self.reporter.clone() }
    }
}

impl fmt::Debug for Children {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Children").field("supervisor", &self.supervisor).finish_non_exhaustive()
    }
}

/// The exit reason of a failed start.
fn start_failure(error: &io::Error) -> ExitReason {
    let is_shortage = error.raw_os_error().is_some_and(|number| {
        [libc::EMFILE, libc::ENFILE, libc::EAGAIN, libc::ENOMEM, libc::ENOBUFS].contains(&number)
    });
    ExitReason::StartFailed { reason: error.to_string(), is_shortage }
}

/// Sleeps until this time, or forever.
async fn sleep_until(due: Option<Instant>) {
    match due {
        Some(due) => tokio::time::sleep_until(due.into()).await,
        None => std::future::pending().await,
    }
}
