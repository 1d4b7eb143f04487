//! Force errors by grade, computed from all labels.

use axum::extract::State;
use axum::http::StatusCode;
use monitor::label_statistics;

use super::Dashboard;
use super::response::{ApiError, ApiResult};
use crate::wording;

/// `GET /api/errors`: what `calmwalk force-errors --json` prints, and the names of what the page shows of it.
pub async fn force_errors(State(dashboard): State<Dashboard>) -> ApiResult {
    dashboard.errors.clone().get_or_compute(compute(dashboard)).await
}

async fn compute(dashboard: Dashboard) -> Result<String, ApiError> {
    let store = &dashboard.store;
    let none =
        || ApiError::new(StatusCode::NOT_FOUND, "the campaign has no label protocol, and so no labels");
    let protocol = store.protocol_in_force().await?.ok_or_else(none)?;
    let statistics = label_statistics::read(store, protocol.hash, None).await?;
    let mut calibrations = dashboard.calibrations.lock().await;
    calibrations.read(store, protocol.hash).await?;
    let bounds = calibrations.summary(statistics.version.unwrap_or(0));
    drop(calibrations);
    // The intervals may take seconds.
    let json = move || {
        let mut json = wording::json::force_errors_for_page(&statistics, &protocol);
        json["calibration"] = wording::json::error_bounds(&bounds);
        json.to_string()
    };
    let json = tokio::task::spawn_blocking(json).await;
    json.map_err(|error| ApiError::new(StatusCode::INTERNAL_SERVER_ERROR, error.to_string()))
}
