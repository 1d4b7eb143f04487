//! Force errors by grade, computed from all labels.

use axum::extract::State;
use axum::http::StatusCode;
use store::Store;

use super::Dashboard;
use super::response::{ApiError, ApiResult};
use crate::cli::force_errors::as_json;
use crate::label_statistics;

/// `GET /api/errors`: what `calmwalk errors --json` prints.
pub async fn force_errors(State(dashboard): State<Dashboard>) -> ApiResult {
    dashboard.errors.get_or_compute(compute(dashboard.store)).await
}

async fn compute(store: Store) -> Result<String, ApiError> {
    let none =
        || ApiError::new(StatusCode::NOT_FOUND, "the campaign has no label protocol, and so no labels");
    let protocol = store.protocol_in_force().await?.ok_or_else(none)?;
    Ok(as_json(&protocol, &label_statistics::read(&store, protocol.hash).await?).to_string())
}
