//! The seed structures before a campaign starts, as `validate` and `estimate` show them: the worst ones as a table, all as CSV.

use std::io::{self, Write};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use serde_json::{Value, json};

use super::CommandError;
use crate::atomic_file::{AtomicFile, cannot_write};
use crate::campaign::{
    LoadedCampaign, Remark, SeedStructureTriage, SkippedStructure, SourcedStructure, StepTimes, WalkTime,
    triage,
};
use crate::csv::{Csv, number};
use crate::output::{Bar, TextTable, count, decimals};
use crate::wording::cost::wall_time;

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

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

/// The seed structures of a campaign under the original mixture, and the time of their walks.
pub struct SeedStructureTable<'a> {
    campaign: &'a LoadedCampaign,
    /// The worst first.
    seed_structures: Vec<SeedStructureTriage<'a>>,
    times: StepTimes,
}

impl<'a> SeedStructureTable<'a> {
    /// Grades the seed structures with a progress bar and measures a few steps. Writes the CSV if there is a path for it.
    ///
    /// # Errors
    /// The CSV cannot be written, or the system cannot create the threads of a walker.
    pub fn examine(campaign: &'a LoadedCampaign, csv: Option<&Path>) -> Result<Self, CommandError> {
        // Fail before the long computation.
        let file = csv.map(AtomicFile::create).transpose()?;
        let (bar, done) = (Bar::new(Some(campaign.seed_structures.len() as u64), BAR), AtomicU64::new(0));
        let seed_structures = triage(campaign, || {
            bar.set(done.fetch_add(1, Ordering::Relaxed) + 1, || "seed structures".to_owned())
        });
        let table = Self { campaign, seed_structures, times: StepTimes::measure(campaign)? };
        if let Some((mut file, path)) = file.zip(csv) {
            file.write_all(&table.csv().into_bytes()).map_err(|error| cannot_write(path, error))?;
            file.finish()?;
        }
        Ok(table)
    }

    /// How many structures are noteworthy and why, as sentences.
    pub fn remarks(&self) -> Vec<String> {
        let number =
            |is: fn(&Remark) -> bool| self.seed_structures.iter().filter(|found| is(&found.remark)).count();
        let remarks = [
            (
                number(|remark| matches!(remark, Remark::UnstableCell(_))),
                "have no positive bulk modulus for the bias on their cells",
            ),
            (
                number(|remark| *remark == Remark::Candidate),
                "meet the collection rule before their walks start",
            ),
            (
                number(|remark| matches!(remark, Remark::NotInMixture(_))),
                "have an element that the mixture has no data of",
            ),
            (number(|remark| matches!(remark, Remark::Ungraded(_))), "cannot be graded"),
        ];
        let all = count(self.seed_structures.len(), "seed structure");
        let there = remarks.into_iter().filter(|(number, _)| *number > 0);
        there.map(|(number, words)| format!("{number} of {all} {words}")).collect()
    }

    /// The time of the walks from a seed structure. `None` if no step could be measured.
    pub fn walk_time(&self, seed: &SourcedStructure) -> Option<WalkTime> {
        self.times.for_seed_structure(seed)
    }

    /// The time of all walks. `None` if no step could be measured.
    pub fn total_walk_time(&self) -> Option<WalkTime> {
        self.times.total(&self.campaign.seed_structures)
    }

    /// Each seed structure by its name, with what is noteworthy, its distances in Å and its grades. Skipped ones are not among
    /// them.
    pub fn to_json(&self) -> Vec<(&'a str, Value)> {
        let pairs = |found: &SeedStructureTriage<'_>| -> Value {
            let pairs = found.pairs.iter();
            let pair = pairs.map(|of| json!({ "pair": of.pair, "distance": of.distance, "limit": of.limit }));
            pair.collect()
        };
        let row = |found: &SeedStructureTriage<'a>| {
            let value = json!({
                "formula": found.seed_structure.plan.structure.formula(), "state": state(&found.remark),
                "remark": words(&found.remark), "distances": pairs(found), "gamma_max": found.gamma_max,
                "atoms_above": found.atoms_above, "atoms_needed": found.needed_atoms,
            });
            (found.seed_structure.plan.name.as_str(), value)
        };
        self.seed_structures.iter().map(row).collect()
    }

    /// Writes a table of the `shown` worst structures.
    pub fn write(&self, out: &mut dyn Write, shown: usize) -> io::Result<()> {
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
        for found in self.seed_structures.iter().take(shown) {
            let structure = &found.seed_structure.plan.structure;
            let closest = found.pairs.first();
            table.push(vec![
                found.seed_structure.plan.name.clone(),
                structure.len().to_string(),
                structure.formula(),
                closest.map_or("–".to_owned(), |closest| closest.pair.to_string()),
                decimals(closest.map(|closest| closest.distance), 3),
                decimals(closest.map(|closest| closest.relative()), 2),
                decimals(found.gamma_max, 2),
                found.atoms_above.to_string(),
                found.needed_atoms.to_string(),
                self.times
                    .for_seed_structure(found.seed_structure)
                    .map_or("–".to_owned(), |time| wall_time(time.biased)),
                words(&found.remark),
            ]);
        }
        table.write(out)?;
        match self.seed_structures.len().saturating_sub(shown) {
            0 => Ok(()),
            more => writeln!(out, "… and {more} more seed structures (use --all, or --csv FILE)"),
        }
    }

    /// All seed structures: skipped ones, then the others, the worst first.
    fn csv(&self) -> Csv {
        let mut csv = Csv::new(&COLUMNS);
        self.campaign.skipped.iter().for_each(|skipped| csv.push(&skipped_row(skipped)));
        self.seed_structures.iter().for_each(|found| csv.push(&row(found, &self.times)));
        csv
    }
}

/// Times of walks in hours.
pub fn walk_hours(walks: Option<WalkTime>) -> Option<Value> {
    let hours = |seconds: f64| seconds / SECONDS_PER_HOUR;
    walks.map(|time| json!({ "biased": hours(time.biased), "control": hours(time.control) }))
}

/// A seed structure that was skipped, and why.
pub fn skipped_json(SkippedStructure { plan, source, reason }: &SkippedStructure) -> Value {
    json!({ "seed_structure": plan.name, "source": source, "reason": reason })
}

/// A remark in words.
fn words(remark: &Remark) -> String {
    match remark {
        Remark::Ungraded(error) => format!("cannot be graded: {error}"),
        Remark::NotInMixture(elements) => {
            let elements: Vec<_> = elements.iter().map(|species| species.symbol()).collect();
            format!("the mixture has no data of {}", elements.join(", "))
        }
        Remark::UnstableCell(reason) => {
            format!("walks with a bias on the cell cannot start ({reason}): give walk.cell_bias.stress_scale")
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
        Remark::UnstableCell(_) => "unstable_cell",
        Remark::Candidate => "candidate",
        Remark::Nothing => "ready",
    }
}

fn skipped_row(SkippedStructure { plan, source, reason }: &SkippedStructure) -> Vec<String> {
    let structure = &plan.structure;
    let mut row = vec![plan.name.clone(), source.clone(), structure.len().to_string(), structure.formula()];
    row.extend(["skipped".to_owned(), reason.clone()]);
    row.resize(COLUMNS.len(), String::new());
    row
}

fn row(found: &SeedStructureTriage<'_>, times: &StepTimes) -> Vec<String> {
    let structure = &found.seed_structure.plan.structure;
    let closest = found.pairs.first();
    let time = times.for_seed_structure(found.seed_structure);
    let hours = |seconds: Option<f64>| number(seconds.map(|seconds| seconds / SECONDS_PER_HOUR));
    let distances =
        found.pairs.iter().map(|pair| format!("{} {:.4} {:.4}", pair.pair, pair.distance, pair.limit));
    vec![
        found.seed_structure.plan.name.clone(),
        found.seed_structure.source.clone(),
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
        number(found.seed_structure.geometry.bonds as f64 / structure.len() as f64),
        hours(time.map(|time| time.biased)),
        hours(time.map(|time| time.control)),
    ]
}
