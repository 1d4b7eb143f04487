//! `/metrics` of an agent: its walkers, their assignments and the connection to the orchestrator. docs/metrics.md
//! lists them.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use axum::Router;
use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use orchestrator::supervisor::{ChildState, ChildStatus};
use wire::DeviceStatistics;
use workers::agent::AgentMetrics;

use super::exposition::{CONTENT_TYPE, MetricsText};
use super::metrics::device_metrics;

/// State of an agent. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct AgentState {
    /// Its assignments and its connection.
    pub metrics: Arc<Mutex<AgentMetrics>>,
    /// Its walkers.
    pub walkers: Arc<Mutex<Vec<ChildStatus>>>,
    /// Its devices, for a model in Python.
    pub devices: Arc<Mutex<Vec<DeviceStatistics>>>,
}

/// Serves the metrics of an agent.
pub fn router(state: AgentState) -> Router {
    Router::new().route("/metrics", get(metrics)).with_state(state)
}

async fn metrics(State(state): State<AgentState>) -> Response {
    let metrics = state.metrics.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let walkers = state.walkers.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let devices = state.devices.lock().unwrap_or_else(PoisonError::into_inner).clone();
    ([(header::CONTENT_TYPE, CONTENT_TYPE)], text(&metrics, &walkers, &devices)).into_response()
}

fn text(metrics: &AgentMetrics, walkers: &[ChildStatus], devices: &[DeviceStatistics]) -> String {
    let mut text = MetricsText::default();
    let host = store::this_host();
    let labels = [("host", host.as_str()), ("version", env!("CARGO_PKG_VERSION"))];
    text.gauge("calmwalk_agent_info", "Information about the agent; always 1.", &[(&labels, 1.0)]);
    walker_metrics(&mut text, metrics, walkers);
    assignment_metrics(&mut text, metrics);
    let version = metrics.mixture_version.map(|version| version as f64);
    optional_gauge(
        &mut text,
        "calmwalk_agent_mixture_version",
        "Newest mixture version on this host.",
        version,
    );
    link_metrics(&mut text, metrics);
    device_metrics(&mut text, devices);
    text.into_string()
}

fn walker_metrics(text: &mut MetricsText, metrics: &AgentMetrics, walkers: &[ChildStatus]) {
    let mut states: BTreeMap<&str, u64> = BTreeMap::new();
    walkers.iter().for_each(|walker| *states.entry(state_name(walker.state)).or_default() += 1);
    let labels: Vec<_> = states.keys().map(|state| [("state", *state)]).collect();
    let samples: Vec<_> =
        labels.iter().zip(states.values()).map(|(labels, count)| (&labels[..], *count as f64)).collect();
    text.gauge("calmwalk_agent_walkers", "Walkers of this host by state.", &samples);
    let restarts: u64 = walkers.iter().map(|walker| u64::from(walker.restarts)).sum();
    text.counter(
        "calmwalk_agent_walker_restarts_total",
        "Restarts of walkers after a failure.",
        &[(&[], restarts as f64)],
    );
    text.gauge(
        "calmwalk_agent_idle_walkers",
        "Walkers without an assignment.",
        &[(&[], metrics.idle as f64)],
    );
}

fn assignment_metrics(text: &mut MetricsText, metrics: &AgentMetrics) {
    let taken = metrics.assignments_received as f64;
    text.counter(
        "calmwalk_agent_assignments_received_total",
        "Assignments received from the orchestrator.",
        &[(&[], taken)],
    );
    let assignments = &metrics.assignments;
    let outcomes = [
        ("candidate", assignments.candidate),
        ("steps_done", assignments.steps_done),
        ("interrupted", assignments.interrupted),
        ("ended", assignments.ended),
        ("lost", assignments.lost),
    ];
    let labels = outcomes.map(|(outcome, _)| [("outcome", outcome)]);
    let samples: Vec<_> =
        labels.iter().zip(outcomes).map(|(labels, (_, count))| (&labels[..], count as f64)).collect();
    text.counter(
        "calmwalk_agent_assignments_total",
        "Assignments by outcome, as acknowledged by the orchestrator.",
        &samples,
    );
    let steps = metrics.steps as f64;
    text.counter("calmwalk_agent_steps_total", "Steps of the walkers of this host.", &[(&[], steps)]);
}

fn link_metrics(text: &mut MetricsText, metrics: &AgentMetrics) {
    let linked = f64::from(metrics.is_linked());
    text.gauge("calmwalk_agent_link_up", "Whether the orchestrator answers.", &[(&[], linked)]);
    optional_gauge(
        text,
        "calmwalk_agent_link_silence_seconds",
        "Time since the last message from the orchestrator.",
        metrics.heard.map(|heard| heard.elapsed().as_secs_f64()),
    );
    optional_gauge(
        text,
        "calmwalk_agent_link_round_trip_seconds",
        "Round-trip time of the last request to the orchestrator.",
        metrics.round_trip.map(|took| took.as_secs_f64()),
    );
    let places = metrics.joins as f64;
    text.counter(
        "calmwalk_agent_joins_total",
        "Number of times that this agent has joined.",
        &[(&[], places)],
    );
    text.gauge(
        "calmwalk_agent_unsent_reports",
        "Reports that the orchestrator has not acknowledged yet.",
        &[(&[], metrics.unsent as f64)],
    );
}

/// Omits the gauge if there is no value.
fn optional_gauge(text: &mut MetricsText, name: &str, help: &str, value: Option<f64>) {
    if let Some(value) = value {
        text.gauge(name, help, &[(&[], value)]);
    }
}

fn state_name(state: ChildState) -> &'static str {
    match state {
        ChildState::Starting => "starting",
        ChildState::Running => "running",
        ChildState::BackingOff { .. } => "backing_off",
        ChildState::Stopping => "stopping",
        ChildState::Exited => "exited",
        ChildState::Failed => "failed",
    }
}
