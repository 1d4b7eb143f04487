//! The structures that a filter of the table shows, as one file.

use std::collections::BTreeMap;
use std::error::Error;
use std::sync::Arc;

use atoms::extxyz::{LabelKeys, write_frame};
use axum::body::Body;
use axum::extract::{RawQuery, State};
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use futures_util::stream::{self, StreamExt};
use store::{ExportCursor, ListedCandidate, Store};
use wire::{ContentHash, WalkConditions, WalkId};

use super::query::{CandidateQuery, TableOrder};
use crate::export_frame;
use crate::web::dashboard::Dashboard;
use crate::web::dashboard::candidate::frame_of;
use crate::web::dashboard::response::{ApiError, ApiResult};

/// Largest number of structures in a file, and of candidates read for them.
const MAX_STRUCTURES: usize = 2000;
const MAX_READ: usize = 100_000;
/// Structures in memory at a time.
const PAGE: usize = 32;

/// What all frames need.
struct FrameWriter {
    store: Store,
    campaign: String,
    protocol: Option<ContentHash>,
    conditions: BTreeMap<WalkId, WalkConditions>,
}

/// `GET /api/candidates.extxyz?fate=…&state=…&where=…`: in the order of the decisions or another order with an index. Labelled
/// structures are as in `calmwalk export --control`; the others have no energy, forces and stress.
pub async fn extxyz(State(dashboard): State<Dashboard>, RawQuery(query): RawQuery) -> ApiResult {
    let mut query = CandidateQuery::parse(query.as_deref().unwrap_or_default())?;
    if query.after.is_some() || query.limit.is_some() {
        return Err(ApiError::bad_request(
            "a file has all structures that match: 'after' and 'limit' do not apply",
        ));
    }
    if matches!(query.order, TableOrder::Column(_)) {
        (query.order, query.ascending) = (TableOrder::Decision, false);
    }
    let store = dashboard.store;
    let found = query.collect(&store, None, MAX_STRUCTURES + 1, (MAX_READ, usize::MAX)).await?;
    if found.rows.len() > MAX_STRUCTURES || found.next.is_some() {
        let why = match found.rows.len() > MAX_STRUCTURES {
            true => format!("more than {MAX_STRUCTURES} structures match"),
            false => format!("more than {MAX_READ} candidates would be read for this file"),
        };
        let what = "narrow the selection, or use calmwalk export --where on the host of the campaign";
        return Err(ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, format!("{why}: {what}")));
    }
    if found.rows.is_empty() {
        return Err(ApiError::new(StatusCode::NOT_FOUND, "no candidate matches"));
    }
    let writer = Arc::new(FrameWriter {
        campaign: store.campaign().await?.id.to_string(),
        protocol: store.protocol_in_force().await?.map(|protocol| protocol.hash),
        conditions: store.walk_conditions().await?,
        store,
    });
    // The first frames before the headers, so that a damaged store is an error and no short file.
    let mut rows = found.rows;
    let others = rows.split_off(rows.len().min(PAGE));
    let first = writer.frames(&rows).await?;
    let pages: Vec<_> = others.chunks(PAGE).map(<[_]>::to_vec).collect();
    let rest = stream::iter(pages).then(move |rows| {
        let writer = Arc::clone(&writer);
        async move { writer.frames(&rows).await.map_err(Box::<dyn Error + Send + Sync>::from) }
    });
    let body = Body::from_stream(stream::iter([Ok(first)]).chain(rest));
    let disposition = "attachment; filename=\"candidates.extxyz\"";
    let headers =
        [(header::CONTENT_TYPE, "text/plain; charset=utf-8"), (header::CONTENT_DISPOSITION, disposition)];
    Ok((headers, body).into_response())
}

impl FrameWriter {
    /// The text of structures.
    async fn frames(&self, rows: &[ListedCandidate]) -> Result<Vec<u8>, ApiError> {
        let decisions: Vec<_> =
            rows.iter().filter(|row| row.energy.is_some()).map(|row| row.decision).collect();
        let labelled = match self.protocol {
            Some(protocol) => self.store.labelled_candidates(protocol, &decisions).await?,
            None => Vec::new(),
        };
        let mut labelled: BTreeMap<_, _> = labelled.into_iter().map(|row| (row.cursor, row)).collect();
        let mut bytes = Vec::new();
        for row in rows {
            let frame = match labelled.remove(&ExportCursor::Candidate(row.decision)) {
                Some(labelled) => {
                    export_frame::frame(labelled, LabelKeys::Ase, &self.campaign, &self.conditions)
                }
                None => frame_of(&self.store, &row.id).await?,
            };
            write_frame(&mut bytes, &frame)
                .map_err(|error| ApiError::new(StatusCode::UNPROCESSABLE_ENTITY, error))?;
        }
        Ok(bytes)
    }
}
