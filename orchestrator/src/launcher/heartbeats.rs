//! Heartbeats: recorded by any thread at the cost of an atomic store.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Records heartbeats of the children; clones share the records. Recording wakes no thread: the records are read before
/// every decision of the supervisor.
#[derive(Clone, Debug)]
pub struct Heartbeats {
    begun: Instant,
    children: Arc<[Heartbeat]>,
}

#[derive(Debug, Default)]
struct Heartbeat {
    /// Time of the last heartbeat, ns since `begun` and at least 1; 0 if there was none since the last read.
    heard: AtomicU64,
    delivered: AtomicBool,
}

impl Heartbeats {
    pub(super) fn new(children: u32) -> Self {
        Self { begun: Instant::now(), children: (0..children).map(|_| Heartbeat::default()).collect() }
    }

    /// Records that the child is alive.
    pub fn heartbeat(&self, number: u32) {
        if let Some(sign) = self.heartbeat_of(number) {
            let now = u64::try_from(self.now().as_nanos()).unwrap_or(u64::MAX);
            sign.heard.fetch_max(now.max(1), Ordering::Relaxed);
        }
    }

    /// Records that the child is alive and has delivered something.
    pub fn delivered(&self, number: u32) {
        self.heartbeat(number);
        if let Some(sign) = self.heartbeat_of(number) {
            sign.delivered.store(true, Ordering::Relaxed);
        }
    }

    /// Time since `begun`.
    pub(super) fn now(&self) -> Duration {
        self.begun.elapsed()
    }

    /// The instant at this time since `begun`, if it can be represented.
    pub(super) fn instant(&self, since_beginning: Duration) -> Option<Instant> {
        self.begun.checked_add(since_beginning)
    }

    /// Heartbeats since the last call: number of the child, time, and whether it delivered something.
    pub(super) fn collect(&self) -> impl Iterator<Item = (u32, Duration, bool)> {
        (0..).zip(self.children.iter()).filter_map(|(number, sign)| {
            let delivered = sign.delivered.swap(false, Ordering::Relaxed);
            match sign.heard.swap(0, Ordering::Relaxed) {
                0 if !delivered => None,
                heard => Some((number, Duration::from_nanos(heard), delivered)),
            }
        })
    }

    fn heartbeat_of(&self, number: u32) -> Option<&Heartbeat> {
        self.children.get(usize::try_from(number).ok()?)
    }
}
