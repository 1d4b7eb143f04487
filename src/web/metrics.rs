//! `/metrics` for Prometheus: the values of `calmwalk status`, read on request. docs/metrics.md lists them.

use std::collections::BTreeMap;

use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use monitor::Snapshot;
use monitor::versions::{CampaignVersions, VersionStanding, VersionSummary};
use store::{CampaignStatus, Store, unix_milliseconds};
use wire::DeviceStatistics;

use super::exposition::{CONTENT_TYPE, MetricsText};

const SECONDS_PER_HOUR: f64 = 3600.0;

/// Serves the metrics of a campaign.
pub fn router(store: Store) -> Router {
    Router::new().route("/metrics", get(metrics)).with_state(store)
}

async fn metrics(State(store): State<Store>) -> Response {
    match Snapshot::read(&store).await {
        Ok(snapshot) => ([(header::CONTENT_TYPE, CONTENT_TYPE)], text(&snapshot)).into_response(),
        Err(failure) => (StatusCode::SERVICE_UNAVAILABLE, failure.to_string()).into_response(),
    }
}

/// All metrics. Labels have few values: kinds, states, reasons and classes, never walks or structures.
pub fn text(snapshot: &Snapshot) -> String {
    let (campaign, status) = (&snapshot.campaign, &snapshot.status);
    let mut text = MetricsText::default();
    let id = campaign.id.to_string();
    let labels =
        [("campaign", id.as_str()), ("mode", &campaign.mode), ("version", env!("CARGO_PKG_VERSION"))];
    text.gauge("calmwalk_info", "Information about the campaign; always 1.", &[(&labels, 1.0)]);
    text.gauge(
        "calmwalk_finished",
        "Whether the campaign is finished.",
        &[(&[], f64::from(status.finished))],
    );
    candidates(&mut text, status);
    walks(&mut text, status);
    device_metrics(&mut text, &snapshot.devices);
    label_queue(&mut text, status);
    let failures: Vec<_> =
        snapshot.labels.failures.iter().map(|failure| [("class", failure.class.as_str())]).collect();
    let samples: Vec<_> = failures
        .iter()
        .zip(&snapshot.labels.failures)
        .map(|(labels, found)| (&labels[..], (found.labelled + found.failed + found.unfinished) as f64))
        .collect();
    text.gauge("calmwalk_failed_label_jobs", "Label jobs with a failure of this class.", &samples);
    processes(&mut text, status);
    versions(&mut text, &snapshot.versions);
    if let Some(share) = snapshot.mixture.share_above_one() {
        text.gauge(
            "calmwalk_training_atoms_above_one_ratio",
            "Share of the training atoms with an extrapolation grade above 1 under the newest mixture.",
            &[(&[], share)],
        );
    }
    text.gauge("calmwalk_store_bytes", "Size of the database.", &[(&[], snapshot.disk.bytes as f64)]);
    if let Some(end) = snapshot.end.time {
        text.gauge(
            "calmwalk_expected_end_timestamp_seconds",
            "Expected end of the campaign, if nothing changes.",
            &[(&[], end as f64 / 1000.0)],
        );
    }
    text.into_string()
}

fn candidates(text: &mut MetricsText, status: &CampaignStatus) {
    let candidates = &status.candidates;
    let declined = &candidates.declined;
    let fates = [
        ("accepted", candidates.accepted),
        ("covered", declined.covered),
        ("duplicate", declined.duplicate),
        ("too_close", declined.too_close),
        ("budget", declined.budget),
        ("backlog", declined.backlog),
        ("unlikely_to_complete", declined.unlikely_to_complete),
        ("grade_too_large", declined.grade_too_large),
    ];
    let labels = fates.map(|(fate, _)| [("fate", fate)]);
    let samples: Vec<_> =
        labels.iter().zip(fates).map(|(labels, (_, count))| (&labels[..], count as f64)).collect();
    text.counter("calmwalk_candidates_total", "Candidates of biased walks by fate.", &samples);
    let control = candidates.control as f64;
    text.counter("calmwalk_control_frames_total", "Frames of control walks.", &[(&[], control)]);
    let rejected = candidates.rejected_by_guards as f64;
    text.counter(
        "calmwalk_rejected_structures_total",
        "Structures rejected by the walkers' guards.",
        &[(&[], rejected)],
    );
    let version = status.mixture_version as f64;
    text.gauge("calmwalk_mixture_version", "Version of the mixture in force.", &[(&[], version)]);
}

/// The devices of a model in Python, if there are any.
pub(super) fn device_metrics(text: &mut MetricsText, devices: &[DeviceStatistics]) {
    if devices.is_empty() {
        return;
    }
    // Several programs may be on one device.
    let numbers: Vec<_> = (0..devices.len()).map(|number| number.to_string()).collect();
    let labels: Vec<_> = numbers
        .iter()
        .zip(devices)
        .map(|(number, one)| [("number", number.as_str()), ("device", one.device.as_str())])
        .collect();
    let samples = |value: fn(&DeviceStatistics) -> f64| -> Vec<_> {
        labels.iter().zip(devices).map(|(labels, one)| (&labels[..], value(one))).collect()
    };
    let mut counter = |name, help, value| text.counter(name, help, &samples(value));
    counter("calmwalk_device_batches_total", "Batches that the device evaluated.", |one| one.batches as f64);
    counter("calmwalk_device_structures_total", "Structures in them.", |one| one.structures as f64);
    counter("calmwalk_device_bonds_total", "Directed bonds in them.", |one| one.bonds as f64);
    counter("calmwalk_device_busy_seconds_total", "Time for which the device had work.", |one| one.busy);
    counter("calmwalk_device_wait_seconds_total", "Time that calls waited for their batch.", |one| {
        one.waited
    });
    counter("calmwalk_device_compile_seconds_total", "Time of batches of a new shape.", |one| one.compiled);
    counter("calmwalk_device_restarts_total", "Restarts of the model's program.", |one| one.restarts as f64);
    text.gauge(
        "calmwalk_device_busy_ratio",
        "Share of the time for which the device had work.",
        &samples(DeviceStatistics::busy_share),
    );
}

fn walks(text: &mut MetricsText, status: &CampaignStatus) {
    let mut states: BTreeMap<&str, u64> = BTreeMap::new();
    status.walks.iter().for_each(|walk| *states.entry(&walk.state).or_default() += 1);
    let labels: Vec<_> = states.keys().map(|state| [("state", *state)]).collect();
    let samples: Vec<_> =
        labels.iter().zip(states.values()).map(|(labels, count)| (&labels[..], *count as f64)).collect();
    text.gauge("calmwalk_walks", "Walks by state.", &samples);
    if let Some(speed) = status.steps_per_second {
        text.gauge("calmwalk_steps_per_second", "Steps per second of all walks together.", &[(&[], speed)]);
    }
    if let Some(busy) = status.walkers_busy {
        text.gauge(
            "calmwalk_walkers_busy_ratio",
            "Average share of the walkers that are busy.",
            &[(&[], busy)],
        );
    }
    let under_way = status.walks.iter().filter(|walk| matches!(walk.state.as_str(), "waiting" | "running"));
    if let Some(gamma) = under_way.filter_map(|walk| walk.gamma_max).reduce(f64::max) {
        text.gauge(
            "calmwalk_walk_grade_max",
            "Largest extrapolation grade of the running walks.",
            &[(&[], gamma)],
        );
    }
}

fn label_queue(text: &mut MetricsText, status: &CampaignStatus) {
    let labels = &status.labels;
    let states = [
        ("queued", labels.queued),
        ("leased", labels.leased),
        ("labelled", labels.labelled),
        ("failed", labels.failed),
        ("dropped", labels.dropped),
        ("superseded", labels.superseded),
    ];
    let names = states.map(|(state, _)| [("state", state)]);
    let samples: Vec<_> =
        names.iter().zip(states).map(|(labels, (_, count))| (&labels[..], count as f64)).collect();
    text.gauge("calmwalk_label_jobs", "Label jobs by state.", &samples);
    if let Some(lease) = &status.oldest_lease {
        let age = (unix_milliseconds() - lease.started).max(0) as f64 / 1000.0;
        text.gauge(
            "calmwalk_oldest_lease_age_seconds",
            "Age of the oldest running label attempt.",
            &[(&[], age)],
        );
    }
    let used = &status.budget.used;
    let made = used.labels as f64;
    text.counter("calmwalk_labels_made_total", "Labels made, including checks.", &[(&[], made)]);
    let core_seconds = used.core_hours * SECONDS_PER_HOUR;
    // The cost of an attempt is known only at its end and estimated before, so the sum may decrease.
    text.gauge(
        "calmwalk_label_core_seconds",
        "Core-seconds of label attempts, including running ones.",
        &[(&[], core_seconds)],
    );
    let seconds = used.wall_hours * SECONDS_PER_HOUR;
    text.counter("calmwalk_running_seconds_total", "Running time of the campaign.", &[(&[], seconds)]);
}

fn processes(text: &mut MetricsText, status: &CampaignStatus) {
    let mut kinds: BTreeMap<(&str, &str), u64> = BTreeMap::new();
    for process in &status.processes {
        // Other states contain free text.
        let known = ["running", "stopping", "backing_off", "unresponsive", "dead"];
        let state = known.into_iter().find(|state| process.state == *state).unwrap_or("failed");
        *kinds.entry((&process.kind, state)).or_default() += 1;
    }
    let labels: Vec<_> = kinds.keys().map(|(kind, state)| [("kind", *kind), ("state", *state)]).collect();
    let samples: Vec<_> =
        labels.iter().zip(kinds.values()).map(|(labels, count)| (&labels[..], *count as f64)).collect();
    text.gauge("calmwalk_processes", "Processes by kind and state.", &samples);
}

/// Versions of the potential; nothing in a campaign that has never begun to train one.
fn versions(text: &mut MetricsText, found: &CampaignVersions) {
    if found.all.is_empty() && found.refit.is_none() {
        return;
    }
    let in_force = found.in_force().map_or(0, |version| version.number);
    text.gauge(
        "calmwalk_version_in_force",
        "Version of the potential in force; 0 is that of the configuration.",
        &[(&[], f64::from(in_force))],
    );
    let count =
        |state: VersionStanding| found.all.iter().filter(|version| version.state == state).count() as f64;
    let states = VersionStanding::ALL.map(|state| [("state", state.name())]);
    let samples: Vec<_> =
        states.iter().zip(VersionStanding::ALL).map(|(labels, state)| (&labels[..], count(state))).collect();
    text.gauge("calmwalk_versions", "Versions of the potential by state.", &samples);
    force_errors(text, found);
    text.gauge(
        "calmwalk_refit_running",
        "Whether a version of the potential is being trained.",
        &[(&[], f64::from(u8::from(found.refit.is_some())))],
    );
    let sum = |of: fn(&VersionSummary) -> f64| found.all.iter().map(of).fold(0.0, |sum, one| sum + one);
    text.counter(
        "calmwalk_refit_seconds_total",
        "Wall time of refits, refused ones included.",
        &[(&[], sum(|version| version.seconds))],
    );
    text.counter(
        "calmwalk_refit_core_hours_total",
        "Core-hours of refits, refused ones included.",
        &[(&[], sum(|version| version.core_hours))],
    );
}

/// Force errors of each version on each data set. Both are few.
fn force_errors(text: &mut MetricsText, found: &CampaignVersions) {
    let errors = found.all.iter().flat_map(|version| {
        let number = version.number.to_string();
        version.errors.iter().filter_map(move |set| Some((number.clone(), &set.name, set.force_mae()?)))
    });
    let errors: Vec<_> = errors.collect();
    let labels: Vec<_> =
        errors.iter().map(|(number, set, _)| [("version", number.as_str()), ("set", set.as_str())]).collect();
    let samples: Vec<_> =
        labels.iter().zip(&errors).map(|(labels, (.., error))| (&labels[..], *error)).collect();
    text.gauge(
        "calmwalk_version_force_mae",
        "Mean absolute error of force components of a version on a data set, eV/A.",
        &samples,
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_have_metrics_once_there_are_any() {
        let snapshot = crate::cli::status::tests::large();
        let shown = text(&snapshot);
        for line in [
            "calmwalk_version_in_force 3",
            "calmwalk_versions{state=\"in_force\"} 1",
            "calmwalk_versions{state=\"refused\"} 1",
            "calmwalk_version_force_mae{version=\"3\",set=\"liquid\"} 0.25",
            "calmwalk_refit_running 1",
            "calmwalk_refit_seconds_total 3600",
            "calmwalk_refit_core_hours_total 15",
        ] {
            assert!(shown.lines().any(|found| found == line), "{line}:\n{shown}");
        }
        let none = text(&Snapshot { versions: CampaignVersions::default(), ..snapshot });
        assert!(!none.contains("calmwalk_version") && !none.contains("calmwalk_refit"), "{none}");
        let docs = include_str!("../../docs/metrics.md");
        let names = shown.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.split(' ').next());
        names.for_each(|name| assert!(docs.contains(&format!("| `{name}` |")), "{name}"));
    }
}
