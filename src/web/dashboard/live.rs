//! What changes while a page is open: read once for all who look, and told by server-sent events.

use std::convert::Infallible;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::response::sse::{Event, KeepAlive, Sse};
use futures_util::stream::{self, Stream};
use serde_json::json;
use store::{Store, unix_milliseconds};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::Dashboard;
use super::answer::{self, Answer};
use super::samples::{Sample, Samples};
use crate::cli::status::Snapshot;

/// Between two looks at the store while somebody is told of them, at least.
const LOOK: Duration = Duration::from_secs(2);
/// The same while nobody is, and at most in any case.
const UNWATCHED: Duration = Duration::from_secs(10);
/// Up to that, so many times as long as a look takes: to look costs less than one part in so many of a core.
const PART: u32 = 200;

/// The newest news, as JSON, and the samples so far.
#[derive(Clone, Debug)]
pub struct Live {
    /// One for all clones, so that those who are told can be counted.
    news: Arc<watch::Receiver<Option<Arc<str>>>>,
    samples: Arc<Mutex<Samples>>,
    _looking: Arc<Looking>,
}

/// The task that looks ends with the last of those who could be told.
#[derive(Debug)]
struct Looking(JoinHandle<()>);

impl Drop for Looking {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl Live {
    /// Looks at this store again and again.
    pub fn begin(store: Store) -> Self {
        let (tell, news) = watch::channel(None);
        let samples = Arc::new(Mutex::new(Samples::default()));
        let looking = tokio::spawn(look(store, tell, Arc::clone(&samples)));
        Self { news: Arc::new(news), samples, _looking: Arc::new(Looking(looking)) }
    }
}

async fn look(store: Store, tell: watch::Sender<Option<Arc<str>>>, samples: Arc<Mutex<Samples>>) {
    // The dashboard has a receiver of its own.
    let is_watched = || tell.receiver_count() > 1;
    loop {
        let begun = Instant::now();
        let text = match Snapshot::read(&store).await {
            Ok(snapshot) => {
                let sample = Sample::of(snapshot.status(), unix_milliseconds());
                let status = snapshot.to_json().unwrap_or_default();
                let text = json!({ "status": status, "sample": sample }).to_string();
                samples.lock().unwrap_or_else(PoisonError::into_inner).push(sample);
                text
            }
            // A server may be away for a while.
            Err(failure) => json!({ "error": failure.to_string() }).to_string(),
        };
        tell.send_replace(Some(text.into()));
        let pause = begun.elapsed() * PART;
        let mut waited = pause.clamp(LOOK, UNWATCHED);
        tokio::time::sleep(waited).await;
        while !is_watched() && waited < UNWATCHED {
            tokio::time::sleep(LOOK / 4).await;
            waited += LOOK / 4;
        }
    }
}

/// `GET /api/events`: the newest news, and all that come.
pub async fn events(
    State(dashboard): State<Dashboard>,
) -> Sse<impl Stream<Item = Result<Event, Infallible>>> {
    let news = watch::Receiver::clone(&dashboard.live.news);
    let told = stream::unfold((news, true), |(mut news, is_first)| async move {
        if !is_first || news.borrow().is_none() {
            news.changed().await.ok()?;
        }
        let text = news.borrow_and_update().clone()?;
        Some((Ok(Event::default().data(text)), (news, false)))
    });
    Sse::new(told).keep_alive(KeepAlive::default())
}

/// `GET /api/samples`: what the plots over time begin with.
pub async fn samples(State(dashboard): State<Dashboard>) -> Answer {
    answer::json(&dashboard.live.samples.lock().unwrap_or_else(PoisonError::into_inner).kept())
}
