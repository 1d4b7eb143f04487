//! The seed structures as a table, the worst first, and as CSV.

use std::io::{self, Write};

use crate::campaign::{LoadedCampaign, Remark, SeedTriage, SkippedStructure, StepTimes};
use crate::csv::{Csv, number};
use crate::output::{TextTable, decimals};
use crate::wording::cost::wall_time;

const SECONDS_PER_HOUR: f64 = 3600.0;

/// Columns of the CSV; docs/seed-structures.md describes them.
const COLUMNS: [&str; 16] = [
    "seed_structure",
    "source",
    "atoms",
    "formula",
    "state",
    "remark",
    "closest_pair",
    "distance",
    "limit",
    "distances",
    "gamma_max",
    "atoms_above",
    "atoms_needed",
    "neighbours_per_atom",
    "walk_hours",
    "control_hours",
];

/// Writes a table of the first `shown` structures.
pub fn write(
    out: &mut dyn Write,
    seeds: &[SeedTriage<'_>],
    times: &StepTimes,
    shown: usize,
) -> io::Result<()> {
    let mut table = TextTable::new(&[
        "seed structure",
        ">atoms",
        "formula",
        "closest pair",
        ">distance (Å)",
        ">distance/limit",
        ">γ_max",
        ">atoms above",
        ">needed",
        ">walk",
        "remark",
    ]);
    for found in seeds.iter().take(shown) {
        let structure = &found.seed.seed.structure;
        let closest = found.pairs.first();
        table.push(vec![
            found.seed.seed.name.clone(),
            structure.len().to_string(),
            structure.formula(),
            closest.map_or("–".to_owned(), |closest| closest.pair.to_string()),
            decimals(closest.map(|closest| closest.distance), 3),
            decimals(closest.map(|closest| closest.relative()), 2),
            decimals(found.gamma_max, 2),
            found.atoms_above.to_string(),
            found.needed_atoms.to_string(),
            times.of(found.seed).map_or("–".to_owned(), |time| wall_time(time.biased)),
            words(&found.remark),
        ]);
    }
    table.write(out)?;
    match seeds.len().saturating_sub(shown) {
        0 => Ok(()),
        more => writeln!(out, "… and {more} more seed structures (use --all, or --csv FILE)"),
    }
}

/// A remark in words.
fn words(remark: &Remark) -> String {
    match remark {
        Remark::Ungraded(error) => format!("cannot be graded: {error}"),
        Remark::NotInMixture(elements) => {
            let elements: Vec<_> = elements.iter().map(|species| species.symbol()).collect();
            format!("the mixture has no data of {}", elements.join(", "))
        }
        Remark::Candidate => "a candidate before its walk starts".to_owned(),
        Remark::Nothing => String::new(),
    }
}

/// The name of a remark in the column `state`.
fn state(remark: &Remark) -> &'static str {
    match remark {
        Remark::Ungraded(_) => "ungraded",
        Remark::NotInMixture(_) => "not_in_mixture",
        Remark::Candidate => "candidate",
        Remark::Nothing => "ready",
    }
}

/// All seed structures: skipped ones, and the others in their order.
pub fn csv(campaign: &LoadedCampaign, seeds: &[SeedTriage<'_>], times: &StepTimes) -> Csv {
    let mut csv = Csv::new(&COLUMNS);
    campaign.skipped.iter().for_each(|skipped| csv.push(&skipped_row(skipped)));
    seeds.iter().for_each(|found| csv.push(&row(found, times)));
    csv
}

fn skipped_row(SkippedStructure { seed, source, reason }: &SkippedStructure) -> Vec<String> {
    let structure = &seed.structure;
    let mut row = vec![seed.name.clone(), source.clone(), structure.len().to_string(), structure.formula()];
    row.extend(["skipped".to_owned(), reason.clone()]);
    row.resize(COLUMNS.len(), String::new());
    row
}

fn row(found: &SeedTriage<'_>, times: &StepTimes) -> Vec<String> {
    let structure = &found.seed.seed.structure;
    let closest = found.pairs.first();
    let time = times.of(found.seed);
    let hours = |seconds: Option<f64>| number(seconds.map(|seconds| seconds / SECONDS_PER_HOUR));
    let distances =
        found.pairs.iter().map(|pair| format!("{} {:.4} {:.4}", pair.pair, pair.distance, pair.limit));
    vec![
        found.seed.seed.name.clone(),
        found.seed.source.clone(),
        structure.len().to_string(),
        structure.formula(),
        state(&found.remark).to_owned(),
        words(&found.remark),
        closest.map_or(String::new(), |closest| closest.pair.to_string()),
        number(closest.map(|closest| closest.distance)),
        number(closest.map(|closest| closest.limit)),
        distances.collect::<Vec<_>>().join("; "),
        number(found.gamma_max),
        found.atoms_above.to_string(),
        found.needed_atoms.to_string(),
        number(found.seed.geometry.bonds as f64 / structure.len() as f64),
        hours(time.map(|time| time.biased)),
        hours(time.map(|time| time.control)),
    ]
}
