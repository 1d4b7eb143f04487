//! Results by the conditions of walks.

use std::collections::HashMap;

use store::WalkStatus;
use wire::WalkConditions;

use super::super::report_data::ReportData;
use super::{PageTable, count, real, states, text};

/// The biased walks under the same conditions, from any seed structure. Without rows if all walks have the same.
pub fn conditions(data: &ReportData) -> PageTable {
    let mut titles = vec![
        "group",
        "T (K)",
        "cell",
        "τ",
        "walks",
        "ended",
        "accepted",
        "per walk",
        "rejected",
        "roll-backs",
    ];
    let caption = "Results by the conditions of biased walks: temperature of the thermostat, volume or pressure, and τ at the start; accepted \
                   structures, structures rejected by the guard, and roll-backs to a checkpoint.";
    let all = by_conditions(&data.status.walks);
    let has_versions = all.iter().any(|(conditions, _)| conditions.version > 0);
    titles.extend(has_versions.then_some("version of the potential"));
    let mut table = PageTable::new("conditions", caption, &titles);
    for (conditions, walks) in all.iter().filter(|_| all.len() > 1) {
        let sum = |of: fn(&WalkStatus) -> u64| walks.iter().map(|walk| of(walk)).sum::<u64>();
        let (accepted, number) = (sum(|walk| walk.accepted.into()), walks.len() as u64);
        let mut row = vec![
            text(&conditions.group),
            real(conditions.temperature, 0),
            text(conditions.cell_in_words()),
            real(conditions.tau, 3),
            count(number),
            text(states(walks.iter().copied()).1),
            count(accepted),
            real(accepted as f64 / number as f64, 2),
            count(sum(|walk| walk.rejected.unsigned_abs())),
            count(sum(|walk| walk.rollbacks.into())),
        ];
        row.extend(has_versions.then(|| text(conditions.version.to_string())));
        table.rows.push(row);
    }
    table
}

/// The biased walks by their conditions, repeats together, in order of the first.
fn by_conditions(walks: &[WalkStatus]) -> Vec<(WalkConditions, Vec<&WalkStatus>)> {
    let mut all: Vec<(WalkConditions, Vec<&WalkStatus>)> = Vec::new();
    let mut places = HashMap::new();
    for walk in walks.iter().filter(|walk| walk.origin == "biased") {
        let Some(conditions) = &walk.conditions else { continue };
        let WalkConditions { group, temperature, tau, version, .. } = conditions;
        // Numbers have no hash, their bits have.
        let key = (group, temperature.to_bits(), tau.to_bits(), conditions.cell_in_words(), version);
        let place = *places.entry(key).or_insert(all.len());
        if place == all.len() {
            all.push((WalkConditions { repeat: 0, ..conditions.clone() }, Vec::new()));
        }
        all[place].1.push(walk);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeats_and_seed_structures_are_taken_together() {
        let walk = |temperature, repeat, origin: &str| WalkStatus {
            origin: origin.to_owned(),
            conditions: Some(WalkConditions { temperature, repeat, ..WalkConditions::default() }),
            ..WalkStatus::default()
        };
        let walks = [
            walk(600.0, 0, "biased"),
            walk(600.0, 1, "biased"),
            walk(300.0, 0, "biased"),
            walk(600.0, 0, "biased"),
            walk(600.0, 0, "control"),
        ];
        let found = by_conditions(&walks);
        let numbers: Vec<_> = found.iter().map(|(of, walks)| (of.temperature, walks.len())).collect();
        assert_eq!(numbers, [(600.0, 3), (300.0, 1)]);
    }
}
