//! Results by seed structure.

use std::collections::BTreeMap;

use store::WalkStatus;

use super::super::report_data::ReportData;
use super::{PageTable, count, states, text};

/// Walks, candidates by fate and labels of each seed structure.
pub fn seed_structures(data: &ReportData) -> PageTable {
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
        "too close",
        "budget",
        "backlog",
        "control frames",
        "labelled",
        "failed",
    ];
    let mut table = PageTable::new("seed-structures", caption, &titles);
    let mut fates: BTreeMap<u64, BTreeMap<&str, u64>> = BTreeMap::new();
    for fate in &data.fates_by_seed {
        fates.entry(fate.part).or_default().insert(&fate.fate, fate.number);
    }
    for seed in &data.seeds {
        let fate =
            |name: &str| fates.get(&seed.index.into()).and_then(|of| of.get(name)).copied().unwrap_or(0);
        let biased = data.collections.biased.labels.get(&seed.index).copied().unwrap_or_default();
        let control = data.collections.control.labels.get(&seed.index).copied().unwrap_or_default();
        let of_seed = |walk: &&WalkStatus| walk.seed_structure == seed.name && walk.origin == "biased";
        let (walks, ended) = states(data.status.walks.iter().filter(of_seed));
        let names = ["accepted", "covered", "duplicate", "too_close", "budget", "backlog"];
        let mut row = vec![text(&seed.name), text(seed.structure.formula()), count(walks), text(ended)];
        row.push(count(names.iter().map(|name| fate(name)).sum()));
        row.extend(names.map(|name| count(fate(name))));
        row.extend([count(control.structures), count(biased.labelled + control.labelled)]);
        row.push(count(biased.failed + control.failed));
        table.rows.push(row);
    }
    table
}
