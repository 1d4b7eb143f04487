//! What may be done from a page: what `calmwalk queue` and `calmwalk walks` do. It takes the token that is said when the campaign starts, in a header
//! that no page of another site can send.

use std::fs::File;
use std::io::Read;

use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, StatusCode};
use serde_json::{Value, json};
use store::{Store, unix_milliseconds};
use wire::WalkId;

use super::Dashboard;
use super::answer::{self, Answer, Refusal};
use crate::outcome::Failure;
use crate::web::guard;

const HEADER: &str = "x-calmwalk-token";

/// A store that may be changed, and what has to be known for that.
#[derive(Clone, Debug)]
pub struct Acting {
    store: Store,
    token: String,
}

impl Acting {
    /// With a new token, which nobody can guess.
    pub fn new(store: Store) -> Result<Self, Failure> {
        let mut bytes = [0; 16];
        let read = File::open("/dev/urandom").and_then(|mut source| source.read_exact(&mut bytes));
        read.map_err(|error| Failure::Failed(format!("cannot read /dev/urandom: {error}")))?;
        Ok(Self { store, token: bytes.iter().map(|byte| format!("{byte:02x}")).collect() })
    }

    /// What the owner of the campaign is told.
    pub fn token(&self) -> &str {
        &self.token
    }

    /// Takes as long for any token of that length.
    fn knows(&self, headers: &HeaderMap) -> bool {
        let given = headers.get(HEADER).map_or(&b""[..], |value| value.as_bytes());
        let differing = given.iter().zip(self.token.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
        given.len() == self.token.len() && differing == 0
    }
}

/// `GET /api/actions`: whether there are any, and whether this token is the one.
pub async fn allowed(State(dashboard): State<Dashboard>, headers: HeaderMap) -> Answer {
    let acting = &dashboard.acting;
    let knows = acting.as_ref().is_some_and(|acting| acting.knows(&headers));
    answer::json(&json!({ "possible": acting.is_some(), "token_is_right": knows }))
}

/// `POST /api/candidates/ID/drop`, `retry` or `prioritise` with `{"priority": …}`: returns the job as it is then.
pub async fn act(
    State(dashboard): State<Dashboard>,
    Path((id, action)): Path<(String, String)>,
    headers: HeaderMap,
    body: Bytes,
) -> Answer {
    let (store, now) = (may_change(&dashboard, &headers)?, unix_milliseconds());
    let candidate = match action.as_str() {
        "drop" => store.drop_job(&id, now).await?,
        "retry" => store.retry_job(&id, now).await?,
        "prioritise" => store.prioritise_job(&id, priority(&body)?, now).await?,
        _ => return Err(Refusal::new(StatusCode::NOT_FOUND, "there is drop, retry and prioritise")),
    };
    answer::json(&store.queue_show(&candidate).await?.job)
}

/// `POST /api/walks/N/pause` or `resume`, `all` for N being every walk that has more steps to make: returns the walks that were
/// changed.
pub async fn act_on_walks(
    State(dashboard): State<Dashboard>,
    Path((walk, action)): Path<(String, String)>,
    headers: HeaderMap,
) -> Answer {
    let store = may_change(&dashboard, &headers)?;
    let paused = match action.as_str() {
        "pause" => true,
        "resume" => false,
        _ => return Err(Refusal::new(StatusCode::NOT_FOUND, "there is pause and resume")),
    };
    let walks = match walk.as_str() {
        "all" => store.active_walks().await?,
        number => {
            vec![WalkId(number.parse().map_err(|_| Refusal::wrong("expected the number of a walk, or all"))?)]
        }
    };
    let changed = store.pause_walks(&walks, paused, unix_milliseconds()).await?;
    answer::json(&json!({ "changed": changed, "paused": paused }))
}

/// What may be changed, if whoever asks may do so.
fn may_change<'a>(dashboard: &'a Dashboard, headers: &HeaderMap) -> Result<&'a Store, Refusal> {
    let refused = Refusal::new;
    let Some(acting) = &dashboard.acting else {
        return Err(refused(
            StatusCode::FORBIDDEN,
            "this campaign is only looked at: nothing can be changed here",
        ));
    };
    if !guard::is_of_this_site(headers) {
        return Err(refused(StatusCode::FORBIDDEN, "only pages of this dashboard may change something"));
    }
    if !acting.knows(headers) {
        let why = "that takes the token which calmwalk run has printed behind the address";
        return Err(refused(StatusCode::UNAUTHORIZED, why));
    }
    Ok(&acting.store)
}

fn priority(body: &[u8]) -> Result<i32, Refusal> {
    let asked: Value = serde_json::from_slice(body).unwrap_or_default();
    let priority = asked["priority"].as_i64().and_then(|priority| priority.try_into().ok());
    priority.ok_or_else(|| Refusal::wrong("expected {\"priority\": …} with a whole number of 32 bits"))
}
