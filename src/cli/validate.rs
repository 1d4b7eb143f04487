//! `calmwalk validate`

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use calm::Artifact;
use serde_json::{Value, json};

use super::seed_structure_table::{SeedStructureTable, skipped_json, walk_hours};
use super::{CommandError, ExitStatus};
use crate::campaign::{LoadedCampaign, PairRange};
use crate::config::Warning;
use crate::disk_forecast;
use crate::output::{TextTable, count, decimals, print, print_json};
use crate::runtime;
use crate::wording;

/// Number of pairs of elements, and of seed structures, that are shown.
const SHOWN: usize = 20;

/// Check a configuration and all files that it refers to
///
/// Reports all errors with file, line and key (exit code 2). Warns of valid but unusual values on standard error, without changing the exit
/// code.
///
/// Grades every seed structure under the original mixture, measures a few steps on this host to estimate the time of walks, and shows the
/// worst seed structures, each with the pair of elements that is closest to its minimum distance. --csv writes all seed structures with
/// all their pairs (docs/seed-structures.md).
#[derive(Debug, clap::Args)]
pub struct ValidateArgs {
    /// Configuration of a campaign (TOML)
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// List every pair of elements and every seed structure instead of the first 20
    #[arg(long)]
    all: bool,
    /// Write a table of all seed structures, including skipped ones, with the distances of all pairs of elements to this file
    #[arg(long, value_name = "FILE.csv")]
    csv: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl ValidateArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let campaign = LoadedCampaign::load(&self.config)?;
        campaign.print_warnings();
        let seeds = SeedStructureTable::examine(&campaign, self.csv.as_deref())?;
        if self.json {
            print_json(&as_json(&campaign, &seeds))?;
            return Ok(ExitStatus::Done);
        }
        let shown = if self.all { usize::MAX } else { SHOWN };
        print(|out| {
            write(out, &self.config, &campaign)?;
            write_seed_structures(out, &campaign, &seeds)?;
            write_short_range(out, &campaign.pair_ranges, shown)?;
            writeln!(out)?;
            seeds.write(out, shown)
        })?;
        Ok(ExitStatus::Done)
    }
}

fn as_json(campaign: &LoadedCampaign, seeds: &SeedStructureTable<'_>) -> Value {
    let LoadedCampaign { model, artifact: Artifact { mixture, .. }, warnings, skipped, .. } = campaign;
    let warning =
        |Warning { at, key, message }: &Warning| json!({ "at": at, "key": key, "message": message });
    let triage = |(name, mut found): (&str, Value)| {
        found["seed_structure"] = name.into();
        found
    };
    json!({
        "elements": model.elements().iter().map(|species| species.symbol()).collect::<Vec<_>>(),
        "cutoff": model.cutoff(), "components": mixture.iter().count(), "feature_dimension": mixture.dimension(),
        "protocol": campaign.protocol.name, "warnings": warnings.iter().map(warning).collect::<Vec<_>>(),
        "seed_structures": seeds.to_json().into_iter().map(triage).collect::<Vec<_>>(),
        "skipped": skipped.iter().map(skipped_json).collect::<Vec<_>>(),
        "walk_hours": walk_hours(seeds.total_walk_time()), "disk": disk_forecast::estimate(campaign),
    })
}

/// How many seed structures are noteworthy, how long walks take, and whether walkers wait.
fn write_seed_structures(
    out: &mut dyn Write,
    campaign: &LoadedCampaign,
    seeds: &SeedStructureTable<'_>,
) -> io::Result<()> {
    for remark in seeds.remarks() {
        writeln!(out, "  at the start     {remark}")?;
    }
    let walks = seeds.total_walk_time();
    let walks = walks.map_or("no step could be measured".to_owned(), wording::cost::walks);
    writeln!(out, "  walks            {walks}")?;
    match runtime::idle_walkers(campaign) {
        Some(idle) => writeln!(out, "  walkers          {idle}"),
        None => Ok(()),
    }
}

fn write(out: &mut dyn Write, path: &Path, campaign: &LoadedCampaign) -> io::Result<()> {
    let LoadedCampaign { model, artifact: Artifact { mixture, .. }, seed_structures, .. } = campaign;
    let elements: Vec<_> = model.elements().iter().map(|species| species.symbol()).collect();
    let architecture = model.architecture();
    let atoms = || seed_structures.iter().map(|named| named.plan.structure.len());
    let (min, max) = (atoms().min().unwrap_or(0), atoms().max().unwrap_or(0));
    writeln!(out, "{} is a valid campaign", path.display())?;
    writeln!(out, "  potential        {architecture}, {}, cutoff {} Å", elements.join(" "), model.cutoff())?;
    let (components, features) = (mixture.iter().count(), mixture.dimension());
    let (components, features) = (count(components, "component"), count(features, "feature"));
    writeln!(out, "  mixture          {components}, {features} per atom")?;
    if !mixture.can_be_updated() {
        writeln!(
            out,
            "                   without scatter matrices and counts: it can grade structures but not be updated"
        )?;
    }
    let skipped = match campaign.skipped.len() {
        0 => String::new(),
        skipped => format!("; {skipped} skipped, see above"),
    };
    writeln!(out, "  seed structures  {}, with {min} to {max} atoms{skipped}", seed_structures.len())?;
    if let Some(supercells) = campaign.supercells() {
        writeln!(out, "  supercells       {supercells}")?;
    }
    writeln!(out, "  labels           protocol '{}'", campaign.protocol.name)?;
    writeln!(out, "  disk             {}", wording::disk::forecast(&disk_forecast::estimate(campaign)))?;
    match campaign.warnings.len() {
        0 => writeln!(out, "  warnings         none"),
        count => writeln!(out, "  warnings         {count}, see above"),
    }
}

/// The pairs of elements in the seed structures with their limits and windows.
fn write_short_range(out: &mut dyn Write, ranges: &[PairRange], shown: usize) -> io::Result<()> {
    let mut table = TextTable::new(&[
        "pair",
        ">sum of radii (Å)",
        ">shortest (Å)",
        ">guard (Å)",
        ">ZBL full below (Å)",
        ">ZBL zero above (Å)",
    ]);
    let shown = shown.min(ranges.len());
    for PairRange { pair, shortest, limit, zbl, .. } in &ranges[..shown] {
        table.push(vec![
            pair.to_string(),
            format!("{:.2}", pair.covalent_radii()),
            decimals(Some(*shortest).filter(|shortest| shortest.is_finite()), 3),
            format!("{limit:.3}"),
            decimals(zbl.map(|window| window.inner), 3),
            decimals(zbl.map(|window| window.outer), 3),
        ]);
    }
    writeln!(out)?;
    table.write(out)?;
    match ranges.len() - shown {
        0 => Ok(()),
        more => writeln!(out, "… and {more} more pairs (use --all)"),
    }
}
