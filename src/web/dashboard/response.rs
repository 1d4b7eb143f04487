//! Responses of the API: JSON or an error.

use axum::body::Body;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use store::StoreError;

/// A response or an error.
pub type ApiResult = Result<Response, ApiError>;

/// An error with its message.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{why}")]
pub struct ApiError {
    status: StatusCode,
    why: String,
}

impl ApiError {
    /// The request is wrong.
    pub fn bad_request(why: impl ToString) -> Self {
        Self { status: StatusCode::BAD_REQUEST, why: why.to_string() }
    }

    /// Any other error.
    pub fn new(status: StatusCode, why: impl ToString) -> Self {
        Self { status, why: why.to_string() }
    }
}

/// A value as JSON.
pub fn json(value: &impl Serialize) -> ApiResult {
    let text = serde_json::to_string(value)
        .map_err(|error| ApiError::new(StatusCode::INTERNAL_SERVER_ERROR, error))?;
    Ok(json_text(text))
}

/// A text that is JSON already.
pub fn json_text(text: impl Into<Body>) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], text.into()).into_response()
}

/// For unknown paths.
pub async fn not_found() -> ApiError {
    ApiError::new(StatusCode::NOT_FOUND, "no such page")
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let text = serde_json::json!({ "error": self.why }).to_string();
        (self.status, json_text(text)).into_response()
    }
}

impl From<StoreError> for ApiError {
    fn from(error: StoreError) -> Self {
        use StoreError as E;
        let status = match error {
            E::UnknownCandidate { .. }
            | E::UnknownImport { .. }
            | E::UnknownJob { .. }
            | E::UnknownWalk { .. } => StatusCode::NOT_FOUND,
            E::AmbiguousJob { .. } | E::WrongState { .. } | E::EndedWalk { .. } => StatusCode::CONFLICT,
            _ => StatusCode::SERVICE_UNAVAILABLE,
        };
        Self::new(status, error)
    }
}
