//! Where collected structures lie in feature space.

use axum::extract::{RawQuery, State};
use axum::http::StatusCode;
use monitor::feature_map;
use monitor::mixture_status::InitialMixture;
use store::Store;

use super::Dashboard;
use super::response::{ApiError, ApiResult};
use crate::initial_mixture;

/// `GET /api/map`: structures, and for each element a plane with their places and the components of the initial mixture.
pub async fn feature_map(State(dashboard): State<Dashboard>, RawQuery(query): RawQuery) -> ApiResult {
    if let Some(query) = query.filter(|query| !query.is_empty()) {
        return Err(ApiError::bad_request(format!("the map has no parameters; found '{query}'")));
    }
    let Dashboard { store, map, initial, .. } = dashboard;
    map.get_or_compute(compute(store, initial)).await
}

async fn compute(store: Store, initial: Option<InitialMixture>) -> Result<String, ApiError> {
    let (initial, missing) = match initial {
        Some(initial) => (Some(initial), None),
        None => match initial_mixture::read(&store).await {
            Ok(initial) => (Some(initial), None),
            Err(failure) => (None, Some(failure.to_string())),
        },
    };
    let internal = |error: &dyn ToString| ApiError::new(StatusCode::INTERNAL_SERVER_ERROR, error.to_string());
    let sample = feature_map::read(&store).await?;
    // The axes of several elements may take seconds.
    let map = tokio::task::spawn_blocking(move || sample.into_map(initial.as_ref())).await;
    let map = map.map_err(|error| internal(&error))?;
    let mut json = serde_json::to_value(map).map_err(|error| internal(&error))?;
    json["mixture_missing"] = missing.into();
    Ok(json.to_string())
}
