//! `calmwalk versions … show`

use std::collections::BTreeMap;
use std::io::{self, Write};

use monitor::version_finds::VersionFinds;
use serde_json::{Value, json};
use store::{Location, Store, VersionRecord};

use super::errors::{UNKNOWN, table, with_parent};
use super::list::{first_to_json, record_to_json};
use super::{CommandError, ExitStatus, KnownVersions};
use crate::calibration_file::GradeFiles;
use crate::output::{TextTable, count, decimals, print, print_json};
use crate::wording::cost::wall_time;
use crate::wording::date;

/// Show everything about one version
///
/// Shows how it was trained, its hashes, its errors on every data set beside those of its parent, its walks, and the candidates
/// that they found.
#[derive(Debug, clap::Args)]
pub struct VersionsShowArgs {
    /// Number of the version, as in the list
    #[arg(value_name = "N")]
    number: u32,
}

/// What is shown.
struct ShownVersion {
    number: u32,
    known: KnownVersions,
    /// BLAKE3 hashes of model and mixture; empty if it has none.
    hashes: [String; 2],
    finds: VersionFinds,
}

impl VersionsShowArgs {
    pub fn run(self, location: &Location, json: bool) -> Result<ExitStatus, CommandError> {
        let shown = super::read(location, async |store| ShownVersion::read(store, self.number).await)?;
        if json {
            print_json(&shown.to_json())?;
        } else {
            print(|out| shown.write(out))?;
        }
        Ok(ExitStatus::Done)
    }
}

impl ShownVersion {
    async fn read(store: &Store, number: u32) -> Result<Self, CommandError> {
        let known = KnownVersions::read(store).await?;
        if number > 0 {
            super::numbered(&known.versions, number)?;
        }
        let GradeFiles { model_hash, mixture_hash } = GradeFiles::of_version(store, number).await?;
        let hashes = [model_hash, mixture_hash.unwrap_or_default()];
        Ok(Self { number, known, hashes, finds: VersionFinds::read(store, number).await? })
    }

    /// `None` for version 0.
    fn record(&self) -> Option<&VersionRecord> {
        self.known.versions.iter().find(|version| version.number == self.number)
    }

    fn figures(&self) -> &Value {
        self.record().map_or(&UNKNOWN, |record| &record.figures)
    }

    fn to_json(&self) -> Value {
        let mut json = self.record().map_or_else(first_to_json, record_to_json);
        let [model, mixture] = self.hashes.each_ref().map(|hash| json!(hash));
        json["in_force"] = json!(self.number == self.known.taken_up);
        (json["model_hash"], json["mixture_hash"]) = (model, mixture);
        json["figures"] = self.figures().clone();
        json["found"] = json!(self.finds);
        json
    }

    fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        writeln!(out, "version {}: {}", self.number, self.known.state(self.number))?;
        if let Some(record) = self.record() {
            write_training(out, record)?;
        }
        for (title, hash) in
            ["model", "mixture"].iter().zip(&self.hashes).filter(|(_, hash)| !hash.is_empty())
        {
            line(out, title, &format!("BLAKE3 {hash}"))?;
        }
        self.write_finds(out)?;
        let pairs = with_parent(&self.known.versions, self.number);
        if !pairs.is_empty() {
            writeln!(out)?;
            table(["parent", &format!("version {}", self.number)], &pairs).write(out)?;
        }
        self.write_comparisons(out)
    }

    fn write_finds(&self, out: &mut dyn Write) -> io::Result<()> {
        let VersionFinds { biased_walks, control_walks, candidates } = &self.finds;
        let walks = [(biased_walks, "biased"), (control_walks, "control")].into_iter();
        let walks: Vec<_> = walks
            .filter(|(walks, _)| !walks.is_empty())
            .map(|(walks, origin)| format!("{} {origin} ({})", total(walks), listed(walks)))
            .collect();
        let walks = if walks.is_empty() { "none yet".to_owned() } else { walks.join(", ") };
        line(out, "walks", &walks)?;
        let found = match total(candidates) {
            0 => "none".to_owned(),
            all => format!("{all} ({})", listed(candidates)),
        };
        line(out, "candidates", &found)
    }

    /// Models that were trained on other structures, to compare the version with.
    fn write_comparisons(&self, out: &mut dyn Write) -> io::Result<()> {
        let all = self.figures()["comparisons"].as_array().map_or(&[][..], Vec::as_slice);
        if all.is_empty() {
            return Ok(());
        }
        let titles = ["trained with", ">structures", "set", ">energy MAE (meV/atom)", ">force MAE (eV/Å)"];
        let mut table = TextTable::new(&titles);
        for comparison in all {
            for set in comparison["sets"].as_array().into_iter().flatten() {
                let number = |key: &str| set["errors"][key].as_f64();
                table.push(vec![
                    comparison["name"].as_str().unwrap_or_default().to_owned(),
                    comparison["structures"].to_string(),
                    set["name"].as_str().unwrap_or_default().to_owned(),
                    decimals(number("energy_mae").map(|error| 1000.0 * error), 2),
                    decimals(number("force_mae"), 4),
                ]);
            }
        }
        writeln!(out)?;
        table.write(out)
    }
}

/// A line with a title.
fn line(out: &mut dyn Write, title: &str, text: &str) -> io::Result<()> {
    writeln!(out, "{title:<12}{text}")
}

fn write_training(out: &mut dyn Write, record: &VersionRecord) -> io::Result<()> {
    let VersionRecord { parent, reason, method, structures, last_decision, labels, .. } = record;
    if !reason.is_empty() {
        line(out, "reason", reason)?;
    }
    line(out, "parent", &format!("version {parent}"))?;
    line(out, "method", method)?;
    let (labels, structures) = (count(*labels, "label"), count(*structures, "accepted structure"));
    line(out, "trained on", &format!("{labels}, when there were {structures} (decision {last_decision})"))?;
    let numbers = ["structures", "replay", "validation", "epochs"].into_iter().filter_map(|key| {
        let number = record.figures["training"][key].as_u64()?;
        Some(format!("{key} {number}"))
    });
    let numbers: Vec<_> = numbers.collect();
    if !numbers.is_empty() {
        line(out, "training", &numbers.join(", "))?;
    }
    let (time, hours) = (wall_time(record.seconds), record.core_hours);
    line(out, "refit", &format!("{time}, {hours:.2} core-hours, {}", date::utc(record.time)))
}

fn total(counts: &BTreeMap<String, u64>) -> u64 {
    counts.values().sum()
}

/// Words with their numbers, such as `2 accepted, 1 covered`.
fn listed(counts: &BTreeMap<String, u64>) -> String {
    let listed: Vec<_> =
        counts.iter().map(|(word, number)| format!("{number} {}", word.replace('_', " "))).collect();
    listed.join(", ")
}
