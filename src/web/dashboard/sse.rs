//! Streams status updates as server-sent events. The store is polled once for all clients.

use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::stream::{self, Stream};
use monitor::Snapshot;
use serde_json::json;
use store::{Store, unix_milliseconds};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::Dashboard;
use super::response::{self, ApiResult};
use super::time_series::{TimeSeries, TimeSeriesPoint};
use crate::wording;

/// Shortest interval between polls while a client listens.
const POLL_INTERVAL: Duration = Duration::from_secs(2);
/// Interval while no client listens, and the longest in any case.
const IDLE_POLL_INTERVAL: Duration = Duration::from_secs(10);
/// In between, the pause is this multiple of the time of a poll, so that polling takes less than 1/200 of a core.
const PAUSE_FACTOR: u32 = 200;

/// The latest update as JSON, and the samples so far.
#[derive(Clone, Debug)]
pub struct StatusFeed {
    /// Shared by all clones, so that the number of listening clients is known.
    latest: Arc<watch::Receiver<Option<Arc<str>>>>,
    samples: Arc<Mutex<TimeSeries>>,
    _task: Arc<PollTask>,
}

/// The polling task, which ends with the last clone.
#[derive(Debug)]
struct PollTask(JoinHandle<()>);

impl Drop for PollTask {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl StatusFeed {
    /// Starts to poll this store.
    pub fn start(store: Store) -> Self {
        let (publish, latest) = watch::channel(None);
        let samples = Arc::new(Mutex::new(TimeSeries::default()));
        let task = tokio::spawn(poll(store, publish, Arc::clone(&samples)));
        Self { latest: Arc::new(latest), samples, _task: Arc::new(PollTask(task)) }
    }
}

async fn poll(store: Store, publish: watch::Sender<Option<Arc<str>>>, samples: Arc<Mutex<TimeSeries>>) {
    // The dashboard itself holds one receiver.
    let is_watched = || publish.receiver_count() > 1;
    loop {
        let begun = Instant::now();
        let text = match Snapshot::read(&store).await {
            Ok(snapshot) => {
                let sample = TimeSeriesPoint::new(&snapshot.status, unix_milliseconds());
                let status = wording::json::snapshot(&snapshot).unwrap_or_default();
                let text = json!({ "status": status, "sample": sample }).to_string();
                samples.lock().unwrap_or_else(PoisonError::into_inner).add(sample);
                text
            }
            // A server may be unreachable for a while.
            Err(failure) => json!({ "error": failure.to_string() }).to_string(),
        };
        publish.send_replace(Some(text.into()));
        let pause = begun.elapsed() * PAUSE_FACTOR;
        let mut waited = pause.clamp(POLL_INTERVAL, IDLE_POLL_INTERVAL);
        tokio::time::sleep(waited).await;
        while !is_watched() && waited < IDLE_POLL_INTERVAL {
            tokio::time::sleep(POLL_INTERVAL / 4).await;
            waited += POLL_INTERVAL / 4;
        }
    }
}

/// `GET /api/events`: the latest update and all that follow.
pub async fn events(
    State(dashboard): State<Dashboard>,
) -> Sse<impl Stream<Item = Result<Event, Infallible>>> {
    let latest = watch::Receiver::clone(&dashboard.feed.latest);
    let events = stream::unfold((latest, true), |(mut latest, is_first)| async move {
        if !is_first || latest.borrow().is_none() {
            latest.changed().await.ok()?;
        }
        let text = latest.borrow_and_update().clone()?;
        Some((Ok(Event::default().data(text)), (latest, false)))
    });
    Sse::new(events).keep_alive(KeepAlive::default())
}

/// `GET /api/samples`: the initial data of the plots over time.
pub async fn samples(State(dashboard): State<Dashboard>) -> ApiResult {
    response::json(&dashboard.feed.samples.lock().unwrap_or_else(PoisonError::into_inner).samples())
}
