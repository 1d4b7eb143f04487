//! Actions of the dashboard, as in `calmwalk queue` and `calmwalk walks`. They require the token that is printed when
//! the campaign starts, in a header that pages of other sites cannot send.

use std::fs::File;
use std::io::Read;

use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use serde_json::{Value, json};
use store::{Store, unix_milliseconds};
use wire::WalkId;

use super::Dashboard;
use super::response::{self, ApiError, ApiResult};
use crate::exit_status::CommandError;
use crate::web::security;

const HEADER: &str = "x-calmwalk-token";

/// The store for mutations, and the token that authorizes them.
#[derive(Clone, Debug)]
pub struct Mutations {
    store: Store,
    token: String,
}

impl Mutations {
    /// Generates a random token.
    pub fn new(store: Store) -> Result<Self, CommandError> {
        let mut bytes = [0; 16];
        let read = File::open("/dev/urandom").and_then(|mut source| source.read_exact(&mut bytes));
        read.map_err(|error| CommandError::Failed(format!("cannot read /dev/urandom: {error}")))?;
        Ok(Self { store, token: bytes.iter().map(|byte| format!("{byte:02x}")).collect() })
    }

    /// The token, to be printed for the owner of the campaign.
    pub fn token(&self) -> &str {
        &self.token
    }

    /// Checks the token in constant time.
    fn is_authorized(&self, headers: &HeaderMap) -> bool {
        let given = headers.get(HEADER).map_or(&b""[..], |value| value.as_bytes());
        let differing = given.iter().zip(self.token.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
        given.len() == self.token.len() && differing == 0
    }
}

/// `GET /api/actions`: whether actions are possible, and whether the token is right.
pub async fn action_status(State(dashboard): State<Dashboard>, headers: HeaderMap) -> ApiResult {
    let mutations = &dashboard.mutations;
    let is_authorized = mutations.as_ref().is_some_and(|mutations| mutations.is_authorized(&headers));
    response::json(&json!({ "possible": mutations.is_some(), "token_is_right": is_authorized }))
}

/// `POST /api/candidates/ID/drop`, `retry` or `prioritise` with `{"priority": …}`: returns the changed job.
pub async fn act_on_job(
    State(dashboard): State<Dashboard>,
    Path((id, action)): Path<(String, String)>,
    headers: HeaderMap,
    body: Bytes,
) -> ApiResult {
    let (store, now) = (authorize(&dashboard, &headers)?, unix_milliseconds());
    let candidate = match action.as_str() {
        "drop" => store.drop_job(&id, now).await?,
        "retry" => store.retry_job(&id, now).await?,
        "prioritise" => store.prioritise_job(&id, priority(&body)?, now).await?,
        _ => {
            return Err(ApiError::new(
                StatusCode::NOT_FOUND,
                "unknown action; expected drop, retry or prioritise",
            ));
        }
    };
    response::json(&store.queue_show(&candidate).await?.job)
}

/// `POST /api/walks/N/pause` or `resume`: returns the changed walks. `all` for N stands for every unfinished walk.
pub async fn act_on_walks(
    State(dashboard): State<Dashboard>,
    Path((walk, action)): Path<(String, String)>,
    headers: HeaderMap,
) -> ApiResult {
    let store = authorize(&dashboard, &headers)?;
    let paused = match action.as_str() {
        "pause" => true,
        "resume" => false,
        _ => return Err(ApiError::new(StatusCode::NOT_FOUND, "unknown action; expected pause or resume")),
    };
    let walks = match walk.as_str() {
        "all" => store.active_walks().await?,
        number => {
            vec![WalkId(
                number.parse().map_err(|_| ApiError::bad_request("expected the number of a walk, or all"))?,
            )]
        }
    };
    let changed = store.pause_walks(&walks, paused, unix_milliseconds()).await?;
    response::json(&json!({ "changed": changed, "paused": paused }))
}

/// Returns the store if the request is authorized.
fn authorize<'a>(dashboard: &'a Dashboard, headers: &HeaderMap) -> Result<&'a Store, ApiError> {
    let refused = ApiError::new;
    let Some(mutations) = &dashboard.mutations else {
        return Err(refused(StatusCode::FORBIDDEN, "this dashboard is read-only"));
    };
    if !security::is_same_origin(headers) {
        return Err(refused(StatusCode::FORBIDDEN, "only pages of this dashboard may change the campaign"));
    }
    if !mutations.is_authorized(headers) {
        let why = "this needs the token that calmwalk run printed with the address";
        return Err(refused(StatusCode::UNAUTHORIZED, why));
    }
    Ok(&mutations.store)
}

fn priority(body: &[u8]) -> Result<i32, ApiError> {
    let asked: Value = serde_json::from_slice(body).unwrap_or_default();
    let priority = asked["priority"].as_i64().and_then(|priority| priority.try_into().ok());
    priority.ok_or_else(|| ApiError::bad_request("expected {\"priority\": …} with a whole number of 32 bits"))
}
