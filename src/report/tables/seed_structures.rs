//! Results by seed structure.

use std::collections::{BTreeMap, HashMap};

use store::WalkStatus;

use super::super::report_data::ReportData;
use super::{PageTable, count, states, text};

/// Walks, candidates by fate and labels of each seed structure.
pub fn seed_structures(data: &ReportData) -> PageTable {
    let caption = "Results by seed structure: biased walks and their states, candidates by fate, frames of its control walks, and labels of \
                   both.";
    let mut titles = vec![
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
    // Most campaigns decline nothing for these reasons.
    let declined = &data.status.candidates.declined;
    let has_unlikely = declined.unlikely_to_complete > 0;
    let has_too_large = declined.grade_too_large > 0;
    titles.extend(has_unlikely.then_some("unlikely to complete"));
    titles.extend(has_too_large.then_some("grade too large"));
    let mut table = PageTable::new("seed-structures", caption, &titles);
    let mut fates: BTreeMap<u64, BTreeMap<&str, u64>> = BTreeMap::new();
    for fate in &data.fates_by_seed_structure {
        fates.entry(fate.part).or_default().insert(&fate.fate, fate.number);
    }
    let walks_by_seed_structure = by_seed_structure(&data.status.walks);
    for seed in &data.seed_structures {
        let fate =
            |name: &str| fates.get(&seed.index.into()).and_then(|of| of.get(name)).copied().unwrap_or(0);
        let biased = data.collections.biased.labels.get(&seed.index).copied().unwrap_or_default();
        let control = data.collections.control.labels.get(&seed.index).copied().unwrap_or_default();
        let (walks, ended) =
            states(walks_by_seed_structure.get(seed.name.as_str()).into_iter().flatten().copied());
        let names = ["accepted", "covered", "duplicate", "too_close", "budget", "backlog"];
        let mut row = vec![text(&seed.name), text(seed.structure.formula()), count(walks), text(ended)];
        let (unlikely, too_large) = (fate("unlikely_to_complete"), fate("grade_too_large"));
        row.push(count(names.iter().map(|name| fate(name)).sum::<u64>() + unlikely + too_large));
        row.extend(names.map(|name| count(fate(name))));
        row.extend([count(control.structures), count(biased.labelled + control.labelled)]);
        row.push(count(biased.failed + control.failed));
        row.extend(has_unlikely.then(|| count(unlikely)));
        row.extend(has_too_large.then(|| count(too_large)));
        table.rows.push(row);
    }
    table
}

/// The biased walks from each seed structure, by its name.
fn by_seed_structure(walks: &[WalkStatus]) -> HashMap<&str, Vec<&WalkStatus>> {
    let mut all: HashMap<&str, Vec<&WalkStatus>> = HashMap::new();
    for walk in walks.iter().filter(|walk| walk.origin == "biased") {
        all.entry(&walk.seed_structure).or_default().push(walk);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_seed_structure_has_its_biased_walks() {
        let walk = |walk, seed_structure: &str, origin: &str| WalkStatus {
            walk,
            seed_structure: seed_structure.to_owned(),
            origin: origin.to_owned(),
            ..WalkStatus::default()
        };
        let walks =
            [walk(0, "b", "biased"), walk(1, "a", "biased"), walk(2, "b", "control"), walk(3, "b", "biased")];
        let found = by_seed_structure(&walks);
        let numbers = |name: &str| found[name].iter().map(|walk| walk.walk).collect::<Vec<_>>();
        assert_eq!((numbers("a"), numbers("b"), found.len()), (vec![1], vec![0, 3], 2));
    }
}
