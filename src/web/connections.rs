//! The connections of a listener: how many there may be, how long each may be idle, and which one goes when there is no room.
//!
//! Every user of this host can connect. Connections therefore have bounds, and the process keeps descriptors in reserve for
//! the processes that it starts: at a bound the connection that has been idle for longest makes room for the newest.

use std::collections::BTreeMap;
use std::os::fd::AsRawFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use rustix::process::{Resource, getrlimit};
use tokio::net::TcpStream;
use tokio::task::JoinHandle;

/// Connections of one listener at most.
const MAX_CONNECTIONS: usize = 64;
/// A connection is idle for so long before it makes room for another: whoever has connected gets so much time to ask.
const MIN_IDLE_TIME: Duration = Duration::from_millis(200);
/// Descriptors that connections leave free at least, where the limit allows it: to start a process takes up to ten.
const MIN_RESERVED_DESCRIPTORS: u64 = 64;

/// The connections that are open. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct Connections(Arc<Mutex<Open>>);

#[derive(Debug, Default)]
struct Open {
    by_number: BTreeMap<u64, Connection>,
    next_number: u64,
}

#[derive(Debug)]
struct Connection {
    state: State,
    /// When the state began.
    since: Instant,
    task: Option<JoinHandle<()>>,
}

/// What a connection does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum State {
    /// It waits for a request to be complete, or for the client to take an answer.
    Idle,
    /// It is told events until the client leaves.
    Streaming,
    /// A request is being answered.
    Responding,
}

/// A place among the connections, given back when this is dropped.
#[derive(Debug)]
pub struct ConnectionGuard {
    connections: Connections,
    number: u64,
}

/// Whether a connection may be served.
#[derive(Debug)]
pub enum Admission {
    /// Yes.
    Now,
    /// Yes, when this one has gone.
    AfterClosing(JoinHandle<()>),
    /// Not before so long.
    Later(Duration),
    /// No: all others are at work.
    Refuse,
}

impl Connections {
    /// Whether a new connection may be served, and which one goes for it.
    pub fn admit(&self, stream: &TcpStream) -> Admission {
        let mut open = self.open();
        if open.by_number.len() < MAX_CONNECTIONS && leaves_reserve(stream) {
            return Admission::Now;
        }
        open.evict(Instant::now())
    }

    /// Takes a place for a connection that `serve` begins to serve.
    pub fn add(&self, serve: impl FnOnce(ConnectionGuard) -> JoinHandle<()>) {
        let number = {
            let mut open = self.open();
            open.next_number += 1;
            let number = open.next_number;
            let connection = Connection { state: State::Idle, since: Instant::now(), task: None };
            open.by_number.insert(number, connection);
            number
        };
        let task = serve(ConnectionGuard { connections: self.clone(), number });
        // It may be over already.
        if let Some(connection) = self.open().by_number.get_mut(&number) {
            connection.task = Some(task);
        }
    }

    /// Closes all of them.
    pub fn close(&self) {
        self.open().by_number.values().filter_map(|open| open.task.as_ref()).for_each(JoinHandle::abort);
    }

    fn open(&self) -> MutexGuard<'_, Open> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Open {
    /// Closes the connection that has been idle for longest, or else the one that was told events for longest.
    fn evict(&mut self, now: Instant) -> Admission {
        // One that has no task yet has only just come.
        let others = self.by_number.iter().filter(|(_, open)| open.task.is_some());
        let first = others.min_by_key(|(_, open)| (open.state, open.since));
        let Some((number, open)) = first.filter(|(_, open)| open.state != State::Responding) else {
            return Admission::Refuse;
        };
        let left = MIN_IDLE_TIME.saturating_sub(now.saturating_duration_since(open.since));
        if !left.is_zero() {
            return Admission::Later(left);
        }
        let number = *number;
        match self.by_number.remove(&number).and_then(|open| open.task) {
            Some(task) => {
                task.abort();
                Admission::AfterClosing(task)
            }
            None => Admission::Refuse,
        }
    }
}

impl ConnectionGuard {
    /// The connection does something else from now on.
    pub fn enter(&self, state: State) {
        if let Some(open) = self.connections.open().by_number.get_mut(&self.number) {
            (open.state, open.since) = (state, Instant::now());
        }
    }

    /// How long the connection has been idle; zero while it is not.
    pub fn idle(&self) -> Duration {
        let open = self.connections.open();
        let idle = open.by_number.get(&self.number).filter(|open| open.state == State::Idle);
        idle.map_or(Duration::ZERO, |open| open.since.elapsed())
    }
}

impl Drop for ConnectionGuard {
    fn drop(&mut self) {
        self.connections.open().by_number.remove(&self.number);
    }
}

/// Whether enough descriptors are left for others. The system gives each file the lowest free number, so the number tells how
/// many are taken.
fn leaves_reserve(stream: &TcpStream) -> bool {
    let number = u64::try_from(stream.as_raw_fd()).unwrap_or(u64::MAX);
    getrlimit(Resource::Nofile).current.is_none_or(|limit| number < limit - reserve(limit))
}

/// Descriptors in reserve under this limit: a quarter of it, [`MIN_RESERVED_DESCRIPTORS`] at least, and never more than half.
fn reserve(limit: u64) -> u64 {
    MIN_RESERVED_DESCRIPTORS.max(limit / 4).min(limit / 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(states: &[(State, u64)], now: Instant) -> Open {
        let mut open = Open::default();
        for (state, age) in states {
            let since = now - Duration::from_secs(*age);
            open.next_number += 1;
            let task = Some(tokio::spawn(std::future::pending()));
            open.by_number.insert(open.next_number, Connection { state: *state, since, task });
        }
        open
    }

    #[tokio::test]
    async fn the_longest_idle_goes_first_and_who_is_answered_stays() {
        let now = Instant::now() + Duration::from_secs(3600);
        let mut open = open(
            &[
                (State::Responding, 100),
                (State::Streaming, 90),
                (State::Idle, 10),
                (State::Idle, 20),
                (State::Streaming, 80),
            ],
            now,
        );
        for gone in [4, 3, 2, 5] {
            assert!(matches!(open.evict(now), Admission::AfterClosing(_)));
            assert!(!open.by_number.contains_key(&gone), "{gone} goes: {open:?}");
        }
        assert!(matches!(open.evict(now), Admission::Refuse));
        assert_eq!(open.by_number.len(), 1);
    }

    #[tokio::test]
    async fn who_has_just_connected_has_time_to_ask() {
        let now = Instant::now() + Duration::from_secs(3600);
        let mut open = open(&[(State::Idle, 0)], now);
        let Admission::Later(left) = open.evict(now) else { panic!("it is new") };
        assert!(matches!(open.evict(now + left), Admission::AfterClosing(_)));
    }

    #[test]
    fn small_limits_leave_something_for_connections() {
        assert_eq!([32, 64, 128, 256, 1024, 4096].map(reserve), [16, 32, 64, 64, 256, 1024]);
    }
}
