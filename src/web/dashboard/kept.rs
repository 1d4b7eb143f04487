//! Answers that take long: reckoned when somebody asks, and kept for the others who ask. Nobody waits for them long: who asks too early gets
//! what was reckoned before, or is told to ask again.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use axum::http::StatusCode;
use axum::response::IntoResponse;
use tokio::sync::watch;
use tokio::time::timeout;

use super::answer::{Answer, Refusal, json_text};

/// What was reckoned is given out again for so many times as long as it took …
const PART: u32 = 50;
/// … and for so long at least.
const LEAST: Duration = Duration::from_secs(2);
/// Who asks waits for so long at most.
const PATIENCE: Duration = Duration::from_millis(500);

/// What was reckoned last, and what is being reckoned.
#[derive(Clone, Debug, Default)]
pub struct Kept(Arc<Mutex<State>>);

#[derive(Debug, Default)]
struct State {
    reckoned: Option<Reckoned>,
    /// Closed when it is done, however it ends.
    under_way: Option<watch::Receiver<()>>,
}

#[derive(Clone, Debug)]
struct Reckoned {
    found: Result<String, Refusal>,
    until: Instant,
}

impl Kept {
    /// The JSON that is kept, or what `reckon` comes to. 202 if there is nothing yet.
    pub async fn answer(
        &self,
        reckon: impl Future<Output = Result<String, Refusal>> + Send + 'static,
    ) -> Answer {
        if let Some(mut under_way) = self.begin(reckon) {
            // Nothing is ever sent: it ends with the task.
            let _ = timeout(PATIENCE, under_way.changed()).await;
        }
        match &self.state().reckoned {
            Some(reckoned) => reckoned.found.clone().map(json_text),
            None => Ok((StatusCode::ACCEPTED, json_text(r#"{"reckoning":true}"#)).into_response()),
        }
    }

    /// Begins to reckon unless that is under way, or what is kept is new enough.
    fn begin(
        &self,
        reckon: impl Future<Output = Result<String, Refusal>> + Send + 'static,
    ) -> Option<watch::Receiver<()>> {
        let mut state = self.state();
        if state.reckoned.as_ref().is_some_and(|reckoned| Instant::now() < reckoned.until) {
            return None;
        }
        if let Some(under_way) = state.under_way.as_ref().filter(|under_way| under_way.has_changed().is_ok())
        {
            return Some(under_way.clone());
        }
        let (done, under_way) = watch::channel(());
        state.under_way = Some(under_way.clone());
        let kept = self.clone();
        tokio::spawn(async move {
            let begun = Instant::now();
            let found = reckon.await;
            let until = Instant::now() + (begun.elapsed() * PART).max(LEAST);
            kept.state().reckoned = Some(Reckoned { found, until });
            drop(done);
        });
        Some(under_way)
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use axum::body::to_bytes;
    use tokio::sync::oneshot;

    use super::*;

    async fn told(answer: Answer) -> (StatusCode, String) {
        let response = answer.into_response();
        let (status, body) = (response.status(), response.into_body());
        (status, String::from_utf8(to_bytes(body, 1000).await.unwrap().to_vec()).unwrap())
    }

    #[tokio::test]
    async fn nobody_waits_long_and_nothing_is_reckoned_twice() {
        let kept = Kept::default();
        let (send, wait) = oneshot::channel();
        let slow = async move { Ok(wait.await.unwrap_or_default()) };
        assert_eq!(told(kept.answer(slow).await).await.0, StatusCode::ACCEPTED);
        let other = async { panic!("it is under way") };
        assert_eq!(told(kept.answer(other).await).await.0, StatusCode::ACCEPTED);
        send.send("{}".to_owned()).unwrap();
        let mut found = (StatusCode::ACCEPTED, String::new());
        while found.0 == StatusCode::ACCEPTED {
            found = told(kept.answer(async { panic!("it is under way, or kept") }).await).await;
        }
        assert_eq!(found, (StatusCode::OK, "{}".to_owned()));
    }

    #[tokio::test]
    async fn why_there_is_none_is_told_and_a_failure_is_not_for_ever() {
        let kept = Kept::default();
        let none = async { Err(Refusal::new(StatusCode::NOT_FOUND, "no labels")) };
        let (status, why) = told(kept.answer(none).await).await;
        assert!(status == StatusCode::NOT_FOUND && why.contains("no labels"), "{why}");
        let kept = Kept::default();
        assert_eq!(told(kept.answer(async { panic!("lost") }).await).await.0, StatusCode::ACCEPTED);
        assert_eq!(told(kept.answer(async { Ok("{}".to_owned()) }).await).await.0, StatusCode::OK);
    }
}
