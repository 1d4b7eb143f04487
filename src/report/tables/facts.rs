//! Summary and provenance of the campaign.

use std::collections::BTreeSet;

use calm::CollectionRule;
use calm::forgetting::{ComponentForgetting, ElementForgetting};
use monitor::mixture_values::forgetting_by_element;
use serde_json::Value;
use store::LabelJobCounts;
use store::records::{LEFT_OUT, TRAINING_FRAMES};

use super::super::report_data::ReportData;
use super::super::style::grouped;
use super::settings::flatten;
use super::{PageTable, text};
use crate::wording;

/// Elements in the summary, those first whose training data are forgotten most.
const MAX_ELEMENTS: usize = 6;

/// The campaign in a few lines.
pub fn summary(data: &ReportData) -> PageTable {
    let mut table = PageTable::new("summary", "The campaign in numbers.", &["", "value"]);
    let status = &data.status;
    let mut row = |name: &str, value: String| table.rows.push(vec![text(name), text(value)]);
    row("campaign", format!("{}, {} mode", data.campaign.id, data.campaign.mode));
    let walks = |origin: &str| status.walks.iter().filter(|walk| walk.origin == origin).count() as u64;
    let state = if status.finished { "has ended" } else { "is not over: numbers are current" };
    row("state", state.into());
    row("walks", format!("{} biased, {} control", grouped(walks("biased")), grouped(walks("control"))));
    let candidates = &status.candidates;
    row(
        "candidates",
        format!("{} seen, {} accepted", grouped(candidates.seen), grouped(candidates.accepted)),
    );
    row("control frames", grouped(candidates.control));
    if let Some(left_out) = data.values.get(LEFT_OUT).and_then(Value::as_u64) {
        row("left out (not gradable, or control frames with atoms too close)", grouped(left_out));
    }
    row("label jobs", label_jobs(&status.labels));
    if let Some(found) = &data.labels {
        let energies = found.statistics.energies.summary();
        row(
            "energy error",
            wording::energies::errors(&energies)
                .unwrap_or_else(|| wording::energies::offsets(&energies.offsets)),
        );
    }
    row("imported structures", grouped(status.imported));
    row("cost of labels", wording::cost::core_time(status.budget.used.core_hours));
    let training = data.values.get(TRAINING_FRAMES);
    row("mixture", mixture(status.mixture_version, training));
    let forgotten = training.map(forgetting_by_element).unwrap_or_default();
    if !forgotten.is_empty() {
        let shown: Vec<_> = forgotten.iter().take(MAX_ELEMENTS).map(element_forgetting).collect();
        row("mean σ² of training atoms, relative to the start", shown.join(", "));
    }
    if let Some(key) = &status.budget.used_up {
        row("ended by", format!("the budget {key}"));
    }
    table
}

fn label_jobs(labels: &LabelJobCounts) -> String {
    format!(
        "{} labelled, {} failed, {} dropped, {} superseded, {} leased, {} queued; {} labels excluded by hand",
        grouped(labels.labelled),
        grouped(labels.failed),
        grouped(labels.dropped),
        grouped(labels.superseded),
        grouped(labels.leased),
        grouped(labels.queued),
        grouped(labels.excluded)
    )
}

/// The version of the mixture, with the grades of the training frames under it if they are monitored.
fn mixture(version: u64, training: Option<&Value>) -> String {
    let number = |key: &str| training.and_then(|training| training[key].as_f64());
    let grades = match number("median").zip(number("share_above_one")) {
        Some((median, share)) => {
            format!("; training atoms under it: median γ {median:.2}, {:.1} % above 1", 100.0 * share)
        }
        None => String::new(),
    };
    format!("version {version}{grades}")
}

/// How much the training data of an element are forgotten.
fn element_forgetting(of: &ElementForgetting) -> String {
    let share = of.share_above_one.map(|share| format!("{:.1} % above 1", 100.0 * share));
    let worst = of.worst_component().map(|ComponentForgetting { component, mean_square_growth }| {
        format!("component {component} × {mean_square_growth:.2}")
    });
    let more: Vec<_> = share.into_iter().chain(worst).collect();
    let more = if more.is_empty() { String::new() } else { format!(" ({})", more.join(", ")) };
    format!("{} × {:.2}{more}", of.element, of.mean_square_growth)
}

/// The collection rule as text. `None` if the configuration has none.
pub fn collection_rule(configuration: &Value) -> Option<String> {
    let rule: CollectionRule = serde_json::from_value(configuration["collect"]["criterion"].clone()).ok()?;
    Some(rule.description())
}

/// Versions, hashes and sources.
pub fn provenance(data: &ReportData) -> PageTable {
    let mut table = PageTable::new("provenance", "Provenance of the campaign.", &["", "value"]).whole();
    let mut row = |name: String, value: String| table.rows.push(vec![text(name), text(value)]);
    let campaign = &data.campaign;
    row("campaign".into(), campaign.id.to_string());
    if let Some(begun) = data.started {
        row("started".into(), wording::date::utc(begun));
    }
    row("started by".into(), format!("calmwalk {}", campaign.program_version));
    row("report by".into(), format!("calmwalk {}", env!("CARGO_PKG_VERSION")));
    if let Some(labels) = &data.labels {
        row("label protocol".into(), labels.protocol.name.clone());
        row("protocol hash (BLAKE3)".into(), labels.protocol.hash.to_string());
        let mut pairs = Vec::new();
        flatten("protocol", &labels.protocol.settings, &mut pairs);
        pairs
            .into_iter()
            .for_each(|(key, value)| value.into_iter().for_each(|value| row(key.clone(), value)));
    }
    if let Some(files) = data.configuration["files"].as_object() {
        for (key, hash) in files {
            row(format!("file {key} (BLAKE3)"), hash.as_str().unwrap_or_default().to_owned());
        }
    }
    let sources: BTreeSet<_> = data.seed_structures.iter().map(|seed| seed.source.as_str()).collect();
    let seeds = data.seed_structures.len() as u64;
    row(
        "seed structures".into(),
        format!("{} of {}", grouped(seeds), sources.into_iter().collect::<Vec<_>>().join(", ")),
    );
    let hosts: BTreeSet<_> = data.status.processes.iter().map(|process| process.host.as_str()).collect();
    if !hosts.is_empty() {
        row("hosts".into(), hosts.into_iter().collect::<Vec<_>>().join(", "));
    }
    table
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn collection_rules_are_words() {
        let rule = |criterion: Value| collection_rule(&json!({ "collect": { "criterion": criterion } }));
        let count = json!({ "rule": "atom_count", "threshold": 1.3, "fraction": 0.15, "min_atoms": 3 });
        assert_eq!(rule(count).unwrap(), "at least max(3, ⌈0.15 N⌉) of its N atoms have γ above 1.3");
        assert_eq!(rule(json!({})), None);
    }
}
