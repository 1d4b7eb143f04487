//! The JSON of `monitor`, with the sentences that its documents describe.

use monitor::Snapshot;
use monitor::calibration::CalibrationSummary;
use monitor::candidate_details::CandidateDetails;
use monitor::label_statistics::LabelStatistics;
use serde_json::{Value, json};
use store::Protocol;

use super::{calibration, comparison, end_reason, energies, reference_check};

/// The JSON of `calmwalk status` (docs/status.md), without the jobs of a batch system.
pub fn snapshot(snapshot: &Snapshot) -> serde_json::Result<Value> {
    let mut json = snapshot.to_json()?;
    if let Some(check) = &snapshot.check {
        json["reference_check"]["faults"] = reference_check::faults(check).collect();
    }
    if let Some(end) = &snapshot.end_reason {
        json["end_reason"]["text"] = end_reason::describe(end).into();
    }
    Ok(json)
}

/// The JSON of `calmwalk force-errors`, for labels of this protocol. The intervals of its comparison may take seconds in a large
/// campaign.
pub fn force_errors(statistics: &LabelStatistics, protocol: &Protocol) -> Value {
    let mut json = statistics.to_json(protocol);
    json["energy"]["offsets"]["note"] = energies::offsets(&statistics.energies.summary().offsets).into();
    let compared = statistics.comparison();
    json["biased_against_control"] = json!(compared);
    json["biased_against_control"]["notes"] = comparison::notes(&compared).into();
    json
}

/// The same for the page of errors of the dashboard, with the names of what it shows, and values beside those of labels.
pub fn force_errors_for_page(statistics: &LabelStatistics, protocol: &Protocol) -> Value {
    let mut json = force_errors(statistics, protocol);
    json["biased_against_control"]["shown"] = comparison::shown();
    json["parity"] = json!(statistics.parity);
    json
}

/// Bounds of the force error in the JSON of `calmwalk force-errors`, with the sentence that views show.
pub fn error_bounds(summary: &CalibrationSummary) -> Value {
    let mut json = serde_json::to_value(summary).unwrap_or_default();
    json["note"] = calibration::sentence(summary).into();
    json
}

/// The JSON of `calmwalk explain` (docs/explain.md).
pub fn candidate(details: &CandidateDetails) -> serde_json::Result<Value> {
    let mut json = serde_json::to_value(details)?;
    for (number, label) in details.labels.iter().enumerate() {
        if let Some(model) = &label.model {
            let note = energies::offsets(&model.energy_offsets);
            json["labels"][number]["model"]["energy_offsets"]["note"] = note.into();
        }
    }
    Ok(json)
}
