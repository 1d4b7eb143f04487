//! The components of the mixture in force.

use axum::extract::State;
use axum::http::StatusCode;
use store::Store;

use super::Dashboard;
use super::answer::{Answer, Refusal};
use crate::mixture::{self, Original};

/// `GET /api/mixture`: each component, and how far its covariance has moved since the campaign began.
pub async fn mixture(State(dashboard): State<Dashboard>) -> Answer {
    let Dashboard { store, mixture, original, .. } = dashboard;
    mixture.answer(reckon(store, original)).await
}

async fn reckon(store: Store, original: Option<Original>) -> Result<String, Refusal> {
    let not_found = |why: &dyn ToString| Refusal::new(StatusCode::NOT_FOUND, why.to_string());
    let original = match original {
        Some(original) => original,
        None => Original::of(&store).await.map_err(|failure| not_found(&failure))?,
    };
    let newest = store.newest_mixture().await?;
    // Eigenvalues of every component may take seconds.
    let standing = tokio::task::spawn_blocking(move || mixture::standing(&original, &newest)).await;
    let broken = |error: &dyn ToString| Refusal::new(StatusCode::INTERNAL_SERVER_ERROR, error.to_string());
    let standing = standing.map_err(|error| broken(&error))?.map_err(|failure| broken(&failure))?;
    serde_json::to_string(&standing).map_err(|error| broken(&error))
}
