//! Force errors by grade, which take a walk through all labels: reckoned when somebody asks, and kept for the others who ask.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::http::StatusCode;
use tokio::sync::Mutex;

use super::Dashboard;
use super::answer::{Answer, Refusal, json_text};
use crate::cli::errors::as_json;
use crate::learned;

/// What was reckoned is given out again for so many times as long as it took.
const KEPT: u32 = 50;

/// What was reckoned last. Whoever asks while it is being reckoned waits for it.
#[derive(Clone, Debug, Default)]
pub struct Errors(Arc<Mutex<Option<Reckoned>>>);

#[derive(Debug)]
struct Reckoned {
    text: String,
    until: Instant,
}

/// `GET /api/errors`: what `calmwalk errors --json` prints.
pub async fn errors(State(dashboard): State<Dashboard>) -> Answer {
    let mut kept = dashboard.errors.0.lock().await;
    if let Some(reckoned) = kept.as_ref().filter(|reckoned| Instant::now() < reckoned.until) {
        return Ok(json_text(reckoned.text.clone()));
    }
    let begun = Instant::now();
    let store = &dashboard.store;
    let none = || Refusal::new(StatusCode::NOT_FOUND, "the campaign has no label protocol, and so no labels");
    let protocol = store.protocol_in_force().await?.ok_or_else(none)?;
    let text = as_json(&protocol, &learned::of(store, protocol.hash).await?).to_string();
    let pause = (begun.elapsed() * KEPT).max(Duration::from_secs(2));
    *kept = Some(Reckoned { text: text.clone(), until: Instant::now() + pause });
    Ok(json_text(text))
}
