//! The components of the mixture in force.

use axum::extract::State;
use axum::http::StatusCode;
use monitor::mixture_status::{self, InitialMixture};
use store::Store;

use super::Dashboard;
use super::response::{ApiError, ApiResult};
use crate::initial_mixture;

/// `GET /api/mixture`: each component, and how far its covariance has moved since the campaign began.
pub async fn mixture(State(dashboard): State<Dashboard>) -> ApiResult {
    let Dashboard { store, mixture, initial, .. } = dashboard;
    mixture.get_or_compute(compute(store, initial)).await
}

async fn compute(store: Store, initial: Option<InitialMixture>) -> Result<String, ApiError> {
    let not_found = |why: &dyn ToString| ApiError::new(StatusCode::NOT_FOUND, why.to_string());
    let initial = match initial {
        Some(initial) => initial,
        None => initial_mixture::read(&store).await.map_err(|failure| not_found(&failure))?,
    };
    let newest = store.newest_mixture().await?;
    // Computing the eigenvalues of every component may take seconds.
    let status = tokio::task::spawn_blocking(move || mixture_status::mixture_status(&initial, &newest)).await;
    let internal = |error: &dyn ToString| ApiError::new(StatusCode::INTERNAL_SERVER_ERROR, error.to_string());
    let status = status.map_err(|error| internal(&error))?.map_err(|failure| internal(&failure))?;
    serde_json::to_string(&status).map_err(|error| internal(&error))
}
