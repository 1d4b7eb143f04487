//! The dashboard: pages for a browser, and a JSON API. docs/dashboard.md describes it.

mod actions;
mod cache;
mod candidate;
mod candidate_table;
mod feature_map;
mod force_errors;
mod history;
mod mixture;
mod response;
mod sse;
mod static_files;
mod time_series;

use std::sync::Arc;

use axum::Router;
use axum::extract::{Path, State};
use axum::middleware;
use axum::routing::{get, post};
use monitor::calibration::CalibrationReader;
use monitor::mixture_status::InitialMixture;
use monitor::walk_trace::WalkTrace;
use store::Store;
use tokio::sync::Mutex;
use wire::WalkId;

pub use self::actions::Mutations;
use self::cache::CachedResponse;
use self::response::{ApiResult, json};
use self::sse::StatusFeed;
use super::security;

/// Largest number of candidates of a walk that are shown.
const MAX_CANDIDATES_OF_WALK: u32 = 2000;

/// State of the request handlers. Clones share it.
#[derive(Clone, Debug)]
pub struct Dashboard {
    /// Read-only, with separate connections.
    store: Store,
    feed: StatusFeed,
    errors: CachedResponse,
    /// Keeps what labels teach about bounds of errors, so that later ones alone are read again.
    calibrations: Arc<Mutex<CalibrationReader>>,
    mixture: CachedResponse,
    map: CachedResponse,
    /// The initial mixture, if this process runs the campaign.
    initial: Option<InitialMixture>,
    /// `None` if nothing may be changed.
    mutations: Option<Mutations>,
}

impl Dashboard {
    /// Shows the content of `store` and polls it every few seconds.
    pub fn new(store: Store, mutations: Option<Mutations>, initial: Option<InitialMixture>) -> Self {
        let feed = StatusFeed::start(store.clone());
        let [errors, mixture, map] = [(); 3].map(|()| CachedResponse::default());
        let calibrations = Arc::default();
        Self { feed, errors, calibrations, mixture, map, initial, store, mutations }
    }

    /// Routes of the dashboard.
    pub fn router(self) -> Router {
        Router::new()
            .route("/", get(static_files::index))
            .route("/pages/{name}", get(static_files::file))
            .route("/api/events", get(sse::events))
            .route("/api/samples", get(sse::samples))
            .route("/api/history", get(history::history))
            .route("/api/candidates", get(candidate_table::page))
            .route("/api/candidates.extxyz", get(candidate_table::download::extxyz))
            .route("/api/candidates/{id}", get(candidate::details))
            .route("/api/candidates/{id}/structure", get(candidate::structure))
            .route("/api/candidates/{id}/structure.extxyz", get(candidate::extxyz))
            .route("/api/candidates/{id}/structure.poscar", get(candidate::poscar))
            .route("/api/candidates/{id}/{action}", post(actions::act_on_job))
            .route("/api/actions", get(actions::action_status))
            .route("/api/errors", get(force_errors::force_errors))
            .route("/api/map", get(feature_map::feature_map))
            .route("/api/mixture", get(mixture::mixture))
            .route("/api/walks/{walk}/candidates", get(candidates_of_walk))
            .route("/api/walks/{walk}/trace", get(trace_of_walk))
            .route("/api/walks/{walk}/{action}", post(actions::act_on_walks))
            .fallback(response::not_found)
            .layer(middleware::map_response(security::add_security_headers))
            .with_state(self)
    }
}

async fn candidates_of_walk(State(dashboard): State<Dashboard>, Path(walk): Path<u32>) -> ApiResult {
    json(&dashboard.store.list_walk(walk, MAX_CANDIDATES_OF_WALK).await?)
}

async fn trace_of_walk(State(dashboard): State<Dashboard>, Path(walk): Path<u32>) -> ApiResult {
    json(&WalkTrace::read(&dashboard.store, WalkId(walk)).await?)
}
