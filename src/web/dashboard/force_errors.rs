//! Force errors by grade, computed from all labels.

use axum::extract::State;
use axum::http::StatusCode;
use monitor::calibration::CalibrationReader;
use monitor::label_statistics;
use store::StoreError;
use tokio::sync::OwnedMutexGuard;
use tokio::task::JoinError;
use wire::ContentHash;

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
    // Both read labels, in different orders, so that neither can use what the other has read.
    let bounds = tokio::spawn(read_bounds(dashboard.clone(), protocol.hash));
    let statistics = label_statistics::read(store, protocol.hash, None).await?;
    let bounds = bounds.await.map_err(failed)??.summary(statistics.version.unwrap_or(0));
    // The intervals may take seconds.
    let json = move || {
        let mut json = wording::json::force_errors_for_page(&statistics, &protocol);
        json["calibration"] = wording::json::error_bounds(&bounds);
        json.to_string()
    };
    tokio::task::spawn_blocking(json).await.map_err(failed)
}

/// What labels teach about bounds of errors, brought up to date.
async fn read_bounds(
    dashboard: Dashboard,
    protocol: ContentHash,
) -> Result<OwnedMutexGuard<CalibrationReader>, StoreError> {
    let mut calibrations = dashboard.calibrations.lock_owned().await;
    calibrations.read(&dashboard.store, protocol).await?;
    Ok(calibrations)
}

fn failed(error: JoinError) -> ApiError {
    ApiError::new(StatusCode::INTERNAL_SERVER_ERROR, error)
}
