//! Force errors by grade, which take a walk through all labels.

use axum::extract::State;
use axum::http::StatusCode;
use store::Store;

use super::Dashboard;
use super::answer::{Answer, Refusal};
use crate::cli::force_errors::as_json;
use crate::learned;

/// `GET /api/errors`: what `calmwalk errors --json` prints.
pub async fn errors(State(dashboard): State<Dashboard>) -> Answer {
    dashboard.errors.answer(reckon(dashboard.store)).await
}

async fn reckon(store: Store) -> Result<String, Refusal> {
    let none = || Refusal::new(StatusCode::NOT_FOUND, "the campaign has no label protocol, and so no labels");
    let protocol = store.protocol_in_force().await?.ok_or_else(none)?;
    Ok(as_json(&protocol, &learned::of(&store, protocol.hash).await?).to_string())
}
