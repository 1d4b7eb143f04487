//! Caches responses that take long to compute. A request that comes too early gets the previous result, or 202.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use axum::http::StatusCode;
use axum::response::IntoResponse;
use tokio::sync::watch;
use tokio::time::timeout;

use super::response::{ApiError, ApiResult, json_text};

/// A result stays valid for this multiple of the time it took …
const VALIDITY_FACTOR: u32 = 50;
/// … and at least for this long.
const MIN_VALIDITY: Duration = Duration::from_secs(2);
/// Longest time that a request waits.
const WAIT_TIMEOUT: Duration = Duration::from_millis(500);

/// The last result and the computation in progress. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct CachedResponse(Arc<Mutex<CacheState>>);

#[derive(Debug, Default)]
struct CacheState {
    computed: Option<Computed>,
    /// Closed at the end of the computation, whether it succeeds or fails.
    in_progress: Option<watch::Receiver<()>>,
}

#[derive(Clone, Debug)]
struct Computed {
    found: Result<String, ApiError>,
    valid_until: Instant,
}

impl CachedResponse {
    /// Returns the cached JSON or the result of `compute`. Returns 202 if there is none yet.
    pub async fn get_or_compute(
        &self,
        compute: impl Future<Output = Result<String, ApiError>> + Send + 'static,
    ) -> ApiResult {
        if let Some(mut in_progress) = self.start(compute) {
            // The channel carries no value; it closes with the task.
            let _ = timeout(WAIT_TIMEOUT, in_progress.changed()).await;
        }
        match &self.state().computed {
            Some(computed) => computed.found.clone().map(json_text),
            None => Ok((StatusCode::ACCEPTED, json_text(r#"{"computing":true}"#)).into_response()),
        }
    }

    /// Starts `compute` unless it is in progress or the cached result is still valid.
    fn start(
        &self,
        compute: impl Future<Output = Result<String, ApiError>> + Send + 'static,
    ) -> Option<watch::Receiver<()>> {
        let mut state = self.state();
        if state.computed.as_ref().is_some_and(|computed| Instant::now() < computed.valid_until) {
            return None;
        }
        if let Some(in_progress) =
            state.in_progress.as_ref().filter(|in_progress| in_progress.has_changed().is_ok())
        {
            return Some(in_progress.clone());
        }
        let (done, in_progress) = watch::channel(());
        state.in_progress = Some(in_progress.clone());
        let cache = self.clone();
        tokio::spawn(async move {
            let begun = Instant::now();
            let found = compute.await;
            let valid_until = Instant::now() + (begun.elapsed() * VALIDITY_FACTOR).max(MIN_VALIDITY);
            cache.state().computed = Some(Computed { found, valid_until });
            drop(done);
        });
        Some(in_progress)
    }

    fn state(&self) -> MutexGuard<'_, CacheState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use axum::body::to_bytes;
    use tokio::sync::oneshot;

    use super::*;

    async fn body(answer: ApiResult) -> (StatusCode, String) {
        let response = answer.into_response();
        let (status, body) = (response.status(), response.into_body());
        (status, String::from_utf8(to_bytes(body, 1000).await.unwrap().to_vec()).unwrap())
    }

    #[tokio::test]
    async fn requests_do_not_wait_long_and_nothing_is_computed_twice() {
        let cache = CachedResponse::default();
        let (send, wait) = oneshot::channel();
        let slow = async move { Ok(wait.await.unwrap_or_default()) };
        assert_eq!(body(cache.get_or_compute(slow).await).await.0, StatusCode::ACCEPTED);
        let other = async { panic!("it is under way") };
        assert_eq!(body(cache.get_or_compute(other).await).await.0, StatusCode::ACCEPTED);
        send.send("{}".to_owned()).unwrap();
        let mut found = (StatusCode::ACCEPTED, String::new());
        while found.0 == StatusCode::ACCEPTED {
            found = body(cache.get_or_compute(async { panic!("it is under way, or kept") }).await).await;
        }
        assert_eq!(found, (StatusCode::OK, "{}".to_owned()));
    }

    #[tokio::test]
    async fn errors_are_returned_and_failures_are_retried() {
        let cache = CachedResponse::default();
        let none = async { Err(ApiError::new(StatusCode::NOT_FOUND, "no labels")) };
        let (status, why) = body(cache.get_or_compute(none).await).await;
        assert!(status == StatusCode::NOT_FOUND && why.contains("no labels"), "{why}");
        let cache = CachedResponse::default();
        assert_eq!(body(cache.get_or_compute(async { panic!("lost") }).await).await.0, StatusCode::ACCEPTED);
        assert_eq!(body(cache.get_or_compute(async { Ok("{}".to_owned()) }).await).await.0, StatusCode::OK);
    }
}
