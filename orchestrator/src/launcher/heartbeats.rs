//! Heartbeats of life, given from any thread for the price of storing a number.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Where signs of life of the children are left; clones leave them at the same place. Nobody is woken by them: they are
/// looked at before anything is decided.
#[derive(Clone, Debug)]
pub struct Heartbeats {
    begun: Instant,
    children: Arc<[Heartbeat]>,
}

#[derive(Debug, Default)]
struct Heartbeat {
    /// When it was last heard, ns since the beginning and at least 1; 0 if not since the last look.
    heard: AtomicU64,
    delivered: AtomicBool,
}

impl Heartbeats {
    pub(super) fn new(children: u32) -> Self {
        Self { begun: Instant::now(), children: (0..children).map(|_| Heartbeat::default()).collect() }
    }

    /// The child is alive.
    pub fn heartbeat(&self, number: u32) {
        if let Some(sign) = self.sign(number) {
            let now = u64::try_from(self.now().as_nanos()).unwrap_or(u64::MAX);
            sign.heard.fetch_max(now.max(1), Ordering::Relaxed);
        }
    }

    /// The child is alive and has delivered something.
    pub fn delivered(&self, number: u32) {
        self.heartbeat(number);
        if let Some(sign) = self.sign(number) {
            sign.delivered.store(true, Ordering::Relaxed);
        }
    }

    /// Time since the beginning.
    pub(super) fn now(&self) -> Duration {
        self.begun.elapsed()
    }

    /// The instant so long after the beginning, if there is one.
    pub(super) fn instant(&self, since_beginning: Duration) -> Option<Instant> {
        self.begun.checked_add(since_beginning)
    }

    /// When each child was last heard since the last look, and whether it was delivered: number, time, delivered.
    pub(super) fn collect(&self) -> impl Iterator<Item = (u32, Duration, bool)> {
        (0..).zip(self.children.iter()).filter_map(|(number, sign)| {
            let delivered = sign.delivered.swap(false, Ordering::Relaxed);
            match sign.heard.swap(0, Ordering::Relaxed) {
                0 if !delivered => None,
                heard => Some((number, Duration::from_nanos(heard), delivered)),
            }
        })
    }

    fn sign(&self, number: u32) -> Option<&Heartbeat> {
        self.children.get(usize::try_from(number).ok()?)
    }
}
