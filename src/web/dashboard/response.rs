//! What is answered: JSON, or why there is none.

use axum::body::Body;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use store::StoreError;

/// An answer, or a refusal.
pub type ApiResult = Result<Response, ApiError>;

/// Why there is no answer, in words.
#[derive(Clone, Debug)]
pub struct ApiError {
    status: StatusCode,
    why: String,
}

impl ApiError {
    /// What was asked is wrong.
    pub fn wrong(why: impl ToString) -> Self {
        Self { status: StatusCode::BAD_REQUEST, why: why.to_string() }
    }

    /// Something else.
    pub fn new(status: StatusCode, why: impl ToString) -> Self {
        Self { status, why: why.to_string() }
    }
}

/// Any value as JSON.
pub fn json(value: &impl Serialize) -> ApiResult {
    let text = serde_json::to_string(value)
        .map_err(|error| ApiError::new(StatusCode::INTERNAL_SERVER_ERROR, error))?;
    Ok(json_text(text))
}

/// A text that is JSON.
pub fn json_text(text: impl Into<Body>) -> Response {
    ([(header::CONTENT_TYPE, "application/json")], text.into()).into_response()
}

/// To whatever else is asked for.
pub async fn not_found() -> ApiError {
    ApiError::new(StatusCode::NOT_FOUND, "there is no such page")
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
