//! The tables of a report, rounded for the page and with full precision for a file.

mod calibration;
mod comparison;
mod completion_model;
mod conditions;
mod facts;
mod forgetting;
mod labels;
mod seed_structures;
mod settings;
mod versions;

use std::collections::BTreeMap;

use store::WalkStatus;

use super::report_data::ReportData;
use crate::page::{PageTable, TableCell, count, percent, real, text};

pub use facts::collection_rule;

/// Number of walks, and their states.
fn states<'a>(walks: impl Iterator<Item = &'a WalkStatus>) -> (u64, String) {
    let mut states: BTreeMap<&str, u64> = BTreeMap::new();
    for walk in walks {
        *states.entry(&walk.state).or_default() += 1;
    }
    let all = states.values().sum();
    let words = |(state, number): (&&str, &u64)| {
        let state = state.replace('_', " ");
        if all == 1 { state } else { format!("{number} {state}") }
    };
    (all, states.iter().map(words).collect::<Vec<_>>().join(", "))
}

/// All tables with rows, in the order of the page.
pub fn all(data: &ReportData) -> Vec<PageTable> {
    let mut tables = vec![
        facts::summary(data),
        forgetting::elements(data),
        forgetting::components(data),
        conditions::conditions(data),
        seed_structures::seed_structures(data),
    ];
    if let Some(found) = &data.labels {
        tables.extend(comparison::all(&found.comparison));
        tables.extend([
            labels::correlations(&found.statistics),
            labels::energy_offsets(&found.statistics),
            labels::quantiles("quantiles-gamma", "γ", &found.statistics.all.gamma),
            labels::quantiles("quantiles-gamma-nbr", "γ_{nbr}", &found.statistics.all.gamma_nbr),
            calibration::found(&found.calibration.summary()),
            calibration::by_value(&found.calibration.summary()),
        ]);
    }
    tables.extend([versions::versions(&data.versions), versions::errors(&data.versions)]);
    if let Some(found) = &data.labels {
        tables.extend([versions::grades(&found.statistics), labels::failures(&found.failures)]);
        if let Some(completion) = &found.completion {
            let reliability = completion_model::reliability(completion);
            tables.extend([completion_model::coefficients(completion), reliability]);
        }
        tables.push(labels::unlabelled(&found.unlabelled));
    }
    tables.extend([settings::settings(data), facts::provenance(data)]);
    tables.retain(|table| !table.rows.is_empty());
    tables
}
