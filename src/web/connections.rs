//! Limits the connections of a listener: their number, their idle time, and which one is closed for a new one.
//!
//! Every user of this host can connect, so connections are limited, and the process reserves file descriptors for its
//! children. At the limit, the connection that has been idle longest is closed for the newest.

use std::collections::BTreeMap;
use std::os::fd::AsRawFd;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use rustix::process::{Resource, getrlimit};
use tokio::net::TcpStream;
use tokio::task::JoinHandle;

/// Largest number of connections of one listener.
const MAX_CONNECTIONS: usize = 64;
/// Time for which a new connection may be idle before it can be closed for another: long enough to send a request.
const MIN_IDLE_TIME: Duration = Duration::from_millis(200);
/// File descriptors reserved for other purposes, where the limit allows. Starting a process takes up to ten.
const MIN_RESERVED_DESCRIPTORS: u64 = 64;

/// The open connections. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct HttpConnections(Arc<Mutex<Open>>);

#[derive(Debug, Default)]
struct Open {
    by_number: BTreeMap<u64, Connection>,
    next_number: u64,
}

#[derive(Debug)]
struct Connection {
    state: ConnectionState,
    /// When the state began.
    since: Instant,
    task: Option<JoinHandle<()>>,
}

/// What a connection is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ConnectionState {
    /// Waiting for a complete request, or for the client to read a response.
    Idle,
    /// Streaming events until the client leaves.
    Streaming,
    /// Responding to a request.
    Responding,
}

/// Registration of a connection, removed on drop.
#[derive(Debug)]
pub struct ConnectionGuard {
    connections: HttpConnections,
    number: u64,
}

/// Whether a new connection may be served.
#[derive(Debug)]
pub enum Admission {
    /// At once.
    Now,
    /// After this connection has closed.
    AfterClosing(JoinHandle<()>),
    /// Try again after this time.
    Later(Duration),
    /// Refuse it: all others are responding.
    Refuse,
}

impl HttpConnections {
    /// Decides whether to serve a new connection, and which one to close for it.
    pub fn admit(&self, stream: &TcpStream) -> Admission {
        let mut open = self.open();
        if open.by_number.len() < MAX_CONNECTIONS && leaves_reserve(stream) {
            return Admission::Now;
        }
        open.evict(Instant::now())
    }

    /// Registers a connection and serves it with `serve`.
    pub fn add(&self, serve: impl FnOnce(ConnectionGuard) -> JoinHandle<()>) {
        let number = {
            let mut open = self.open();
            open.next_number += 1;
            let number = open.next_number;
            let connection = Connection { state: ConnectionState::Idle, since: Instant::now(), task: None };
            open.by_number.insert(number, connection);
            number
        };
        let task = serve(ConnectionGuard { connections: self.clone(), number });
        // It may have ended already.
        if let Some(connection) = self.open().by_number.get_mut(&number) {
            connection.task = Some(task);
        }
    }

    /// Closes all connections.
    pub fn close(&self) {
        self.open().by_number.values().filter_map(|open| open.task.as_ref()).for_each(JoinHandle::abort);
    }

    fn open(&self) -> MutexGuard<'_, Open> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Open {
    /// Closes the connection that has been idle longest, or else the one that has streamed events longest.
    fn evict(&mut self, now: Instant) -> Admission {
        // A connection without a task has only just been accepted.
        let others = self.by_number.iter().filter(|(_, open)| open.task.is_some());
        let first = others.min_by_key(|(_, open)| (open.state, open.since));
        let Some((number, open)) = first.filter(|(_, open)| open.state != ConnectionState::Responding) else {
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
    /// Sets the state of the connection.
    pub fn set_state(&self, state: ConnectionState) {
        if let Some(open) = self.connections.open().by_number.get_mut(&self.number) {
            (open.state, open.since) = (state, Instant::now());
        }
    }

    /// How long the connection has been idle. Zero unless it is idle.
    pub fn idle(&self) -> Duration {
        let open = self.connections.open();
        let idle = open.by_number.get(&self.number).filter(|open| open.state == ConnectionState::Idle);
        idle.map_or(Duration::ZERO, |open| open.since.elapsed())
    }
}

impl Drop for ConnectionGuard {
    fn drop(&mut self) {
        self.connections.open().by_number.remove(&self.number);
    }
}

/// Whether enough descriptors remain. A new file gets the lowest free number, so the number tells how many are in
/// use.
fn leaves_reserve(stream: &TcpStream) -> bool {
    let number = u64::try_from(stream.as_raw_fd()).unwrap_or(u64::MAX);
    getrlimit(Resource::Nofile).current.is_none_or(|limit| number < limit - reserve(limit))
}

/// Descriptors to reserve under this limit: a quarter of it, at least [`MIN_RESERVED_DESCRIPTORS`], at most half.
fn reserve(limit: u64) -> u64 {
    MIN_RESERVED_DESCRIPTORS.max(limit / 4).min(limit / 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(states: &[(ConnectionState, u64)], now: Instant) -> Open {
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
    async fn the_longest_idle_is_closed_first_and_responding_ones_stay() {
        let now = Instant::now() + Duration::from_secs(3600);
        let mut open = open(
            &[
                (ConnectionState::Responding, 100),
                (ConnectionState::Streaming, 90),
                (ConnectionState::Idle, 10),
                (ConnectionState::Idle, 20),
                (ConnectionState::Streaming, 80),
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
    async fn new_connections_have_time_to_send_a_request() {
        let now = Instant::now() + Duration::from_secs(3600);
        let mut open = open(&[(ConnectionState::Idle, 0)], now);
        let Admission::Later(left) = open.evict(now) else { panic!("it is new") };
        assert!(matches!(open.evict(now + left), Admission::AfterClosing(_)));
    }

    #[test]
    fn small_limits_leave_something_for_connections() {
        assert_eq!([32, 64, 128, 256, 1024, 4096].map(reserve), [16, 32, 64, 64, 256, 1024]);
    }
}
