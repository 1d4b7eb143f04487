//! `/metrics` of an agent: what it knows of its walkers, of their turns and of the line to the orchestrator. docs/metrics.md lists it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use axum::Router;
use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use orchestrator::supervisor::{ChildState, ChildStatus};
use workers::agent::Numbers;

use super::exposition::{CONTENT_TYPE, Text};

/// What is known of an agent. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct Watched {
    /// Its work and its line.
    pub numbers: Arc<Mutex<Numbers>>,
    /// Its walkers.
    pub walkers: Arc<Mutex<Vec<ChildStatus>>>,
}

/// The metrics of an agent.
pub fn router(watched: Watched) -> Router {
    Router::new().route("/metrics", get(metrics)).with_state(watched)
}

async fn metrics(State(watched): State<Watched>) -> Response {
    let numbers = watched.numbers.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let walkers = watched.walkers.lock().unwrap_or_else(PoisonError::into_inner).clone();
    ([(header::CONTENT_TYPE, CONTENT_TYPE)], text(&numbers, &walkers)).into_response()
}

fn text(numbers: &Numbers, walkers: &[ChildStatus]) -> String {
    let mut text = Text::default();
    let host = store::this_host();
    let labels = [("host", host.as_str()), ("version", env!("CARGO_PKG_VERSION"))];
    text.gauge("calmwalk_agent_info", "What runs: always 1.", &[(&labels, 1.0)]);
    of_walkers(&mut text, numbers, walkers);
    of_turns(&mut text, numbers);
    let version = numbers.mixture_version.map(|version| version as f64);
    gauge(&mut text, "calmwalk_agent_mixture_version", "Newest version of the mixture here.", version);
    of_line(&mut text, numbers);
    text.into_string()
}

fn of_walkers(text: &mut Text, numbers: &Numbers, walkers: &[ChildStatus]) {
    let mut states: BTreeMap<&str, u64> = BTreeMap::new();
    walkers.iter().for_each(|walker| *states.entry(state(walker.state)).or_default() += 1);
    let labels: Vec<_> = states.keys().map(|state| [("state", *state)]).collect();
    let samples: Vec<_> =
        labels.iter().zip(states.values()).map(|(labels, count)| (&labels[..], *count as f64)).collect();
    text.gauge("calmwalk_agent_walkers", "Walkers of this host by state.", &samples);
    let restarts: u64 = walkers.iter().map(|walker| u64::from(walker.restarts)).sum();
    text.counter(
        "calmwalk_agent_walker_restarts_total",
        "Starts of walkers that followed a failure.",
        &[(&[], restarts as f64)],
    );
    text.gauge("calmwalk_agent_idle_walkers", "Walkers without a turn.", &[(&[], numbers.idle as f64)]);
}

fn of_turns(text: &mut Text, numbers: &Numbers) {
    let taken = numbers.turns_taken as f64;
    text.counter("calmwalk_agent_turns_taken_total", "Turns that the orchestrator gave.", &[(&[], taken)]);
    let turns = &numbers.turns;
    let outcomes = [
        ("candidate", turns.candidate),
        ("turn", turns.turn),
        ("paused", turns.paused),
        ("ended", turns.ended),
        ("lost", turns.lost),
    ];
    let labels = outcomes.map(|(outcome, _)| [("outcome", outcome)]);
    let samples: Vec<_> =
        labels.iter().zip(outcomes).map(|(labels, (_, count))| (&labels[..], count as f64)).collect();
    text.counter(
        "calmwalk_agent_turns_total",
        "Turns by what came of them, as far as the orchestrator has taken it.",
        &samples,
    );
    let steps = numbers.steps as f64;
    text.counter("calmwalk_agent_steps_total", "Steps of the walkers of this host.", &[(&[], steps)]);
}

fn of_line(text: &mut Text, numbers: &Numbers) {
    let linked = f64::from(numbers.is_linked());
    text.gauge("calmwalk_agent_link_up", "Whether the orchestrator answers.", &[(&[], linked)]);
    gauge(
        text,
        "calmwalk_agent_link_silence_seconds",
        "Time since the orchestrator was last heard.",
        numbers.heard.map(|heard| heard.elapsed().as_secs_f64()),
    );
    gauge(
        text,
        "calmwalk_agent_link_round_trip_seconds",
        "Time that the last question to the orchestrator took to be answered.",
        numbers.round_trip.map(|took| took.as_secs_f64()),
    );
    let places = numbers.places as f64;
    text.counter(
        "calmwalk_agent_places_total",
        "Times that the orchestrator has let this agent join.",
        &[(&[], places)],
    );
    text.gauge(
        "calmwalk_agent_untold_reports",
        "Reports that the orchestrator has not taken yet.",
        &[(&[], numbers.untold as f64)],
    );
}

/// Nothing where there is no value.
fn gauge(text: &mut Text, name: &str, help: &str, value: Option<f64>) {
    if let Some(value) = value {
        text.gauge(name, help, &[(&[], value)]);
    }
}

fn state(standing: ChildState) -> &'static str {
    match standing {
        ChildState::Starting => "starting",
        ChildState::Running => "running",
        ChildState::BackingOff { .. } => "pausing",
        ChildState::Stopping => "ending",
        ChildState::Exited => "gone_home",
        ChildState::Failed => "given_up",
    }
}
