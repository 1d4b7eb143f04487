//! Results by seed structure.

use std::collections::BTreeMap;

use super::super::report_data::ReportData;
use super::{Table, count, text};

/// Walks, candidates by fate and labels of each seed structure.
pub fn seed_structures(data: &ReportData) -> Table {
    let caption = "Results by seed structure: biased walks and their states, candidates by fate, frames of its control walks, and labels of \
                   both.";
    let titles = [
        "seed structure",
        "formula",
        "walks",
        "ended",
        "candidates",
        "accepted",
        "covered",
        "duplicate",
        "guard",
        "budget",
        "backlog",
        "control frames",
        "labelled",
        "failed",
    ];
    let mut table = Table::new("seed-structures", caption, &titles);
    let mut fates: BTreeMap<u64, BTreeMap<&str, u64>> = BTreeMap::new();
    for fate in &data.fates_by_seed {
        fates.entry(fate.part).or_default().insert(&fate.fate, fate.number);
    }
    for seed in &data.seeds {
        let fate =
            |name: &str| fates.get(&seed.index.into()).and_then(|of| of.get(name)).copied().unwrap_or(0);
        let biased = data.collections.biased.labels.get(&seed.index).copied().unwrap_or_default();
        let control = data.collections.control.labels.get(&seed.index).copied().unwrap_or_default();
        let (walks, ended) = walks(data, &seed.name);
        let names = ["accepted", "covered", "duplicate", "guard", "budget", "backlog"];
        let mut row = vec![text(&seed.name), text(seed.structure.formula()), count(walks), text(ended)];
        row.push(count(names.iter().map(|name| fate(name)).sum()));
        row.extend(names.map(|name| count(fate(name))));
        row.extend([count(control.structures), count(biased.labelled + control.labelled)]);
        row.push(count(biased.failed + control.failed));
        table.rows.push(row);
    }
    table
}

/// Number of biased walks from a seed structure, and their states.
fn walks(data: &ReportData, seed: &str) -> (u64, String) {
    let walks = data.status.walks.iter();
    let walks = walks.filter(|walk| walk.seed_structure == seed && walk.origin == "biased");
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
