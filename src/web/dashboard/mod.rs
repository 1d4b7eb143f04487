//! The dashboard: pages for a browser, and the numbers that they show as JSON. docs/dashboard.md describes it.

mod actions;
mod answer;
mod candidate;
mod errors;
mod files;
mod kept;
mod live;
mod mixture;
mod samples;
mod table;

use axum::Router;
use axum::extract::{Path, State};
use axum::middleware;
use axum::routing::{get, post};
use store::Store;

pub use self::actions::Acting;
use self::answer::{Answer, json};
use self::kept::Kept;
use self::live::Live;
use super::guard;
use crate::mixture::Original;

/// Candidates of a walk that are shown as its trace, at most.
const TRACE: u32 = 2000;

/// What every request may need. Clones share it.
#[derive(Clone, Debug)]
pub struct Dashboard {
    /// To be read only, through connections of its own.
    store: Store,
    live: Live,
    errors: Kept,
    mixture: Kept,
    /// Where the campaign is run here, the mixture that it began with.
    original: Option<Original>,
    /// None where nothing may be changed.
    acting: Option<Acting>,
}

impl Dashboard {
    /// Shows what this store has, and begins to look at it every few seconds.
    pub fn new(store: Store, acting: Option<Acting>, original: Option<Original>) -> Self {
        let (errors, mixture) = (Kept::default(), Kept::default());
        Self { live: Live::begin(store.clone()), errors, mixture, original, store, acting }
    }

    /// Its pages.
    pub fn router(self) -> Router {
        Router::new()
            .route("/", get(files::index))
            .route("/pages/{name}", get(files::file))
            .route("/api/events", get(live::events))
            .route("/api/samples", get(live::samples))
            .route("/api/candidates", get(table::page))
            .route("/api/candidates/{id}", get(candidate::story))
            .route("/api/candidates/{id}/structure", get(candidate::structure))
            .route("/api/candidates/{id}/structure.extxyz", get(candidate::extxyz))
            .route("/api/candidates/{id}/structure.poscar", get(candidate::poscar))
            .route("/api/candidates/{id}/{action}", post(actions::act))
            .route("/api/actions", get(actions::allowed))
            .route("/api/errors", get(errors::errors))
            .route("/api/mixture", get(mixture::mixture))
            .route("/api/walks/{walk}/candidates", get(trace))
            .route("/api/walks/{walk}/{action}", post(actions::act_on_walks))
            .fallback(answer::nothing_there)
            .layer(middleware::map_response(guard::shut_in))
            .with_state(self)
    }
}

async fn trace(State(dashboard): State<Dashboard>, Path(walk): Path<u32>) -> Answer {
    json(&dashboard.store.list_walk(walk, TRACE).await?)
}
