//! `calmwalk validate`

mod seed_table;

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use calm::Artifact;

use super::{CommandError, ExitStatus};
use crate::atomic_file::{AtomicFile, cannot_write};
use crate::campaign::{LoadedCampaign, PairRange, Remark, SeedTriage, StepTimes, triage};
use crate::disk_forecast;
use crate::output::{Bar, TextTable, count, decimals, print};
use crate::runtime;
use crate::wording;

/// Number of pairs of elements, and of seed structures, that are shown.
const SHOWN: usize = 20;

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

/// Check a configuration and all files that it refers to
///
/// Reports all errors with file, line and key (exit code 2). Valid but suspicious values are warnings on standard error and do
/// not change the exit code. Grades every seed structure under the original mixture, measures a few steps on this host to
/// estimate the time of walks, and shows the worst seed structures.
#[derive(Debug, clap::Args)]
pub struct ValidateArgs {
    /// Configuration of a campaign (TOML)
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// List every pair of elements and every seed structure instead of the first 20
    #[arg(long)]
    all: bool,
    /// Write a table of all seed structures, including skipped ones, to this file
    #[arg(long, value_name = "FILE.csv")]
    csv: Option<PathBuf>,
}

impl ValidateArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let campaign = LoadedCampaign::load(&self.config)?;
        campaign.print_warnings();
        let csv = self.csv.as_deref().map(AtomicFile::create).transpose()?;
        let seeds = graded(&campaign);
        let times = StepTimes::measure(&campaign)?;
        if let (Some(mut file), Some(path)) = (csv, &self.csv) {
            let bytes = seed_table::csv(&campaign, &seeds, &times).into_bytes();
            file.write_all(&bytes).map_err(|error| cannot_write(path, error))?;
            file.finish()?;
        }
        let shown = if self.all { usize::MAX } else { SHOWN };
        print(|out| {
            write(out, &self.config, &campaign)?;
            write_seeds(out, &campaign, &seeds, &times)?;
            write_short_range(out, &campaign.pair_ranges, shown)?;
            writeln!(out)?;
            seed_table::write(out, &seeds, &times, shown)
        })?;
        Ok(ExitStatus::Done)
    }
}

/// Grades the seed structures with a progress bar.
fn graded(campaign: &LoadedCampaign) -> Vec<SeedTriage<'_>> {
    let (bar, done) = (Bar::new(Some(campaign.seed_structures.len() as u64), BAR), AtomicU64::new(0));
    triage(campaign, || bar.set(done.fetch_add(1, Ordering::Relaxed) + 1, || "seed structures".to_owned()))
}

/// How many seed structures are noteworthy, how long walks take, and whether walkers wait.
fn write_seeds(
    out: &mut dyn Write,
    campaign: &LoadedCampaign,
    seeds: &[SeedTriage<'_>],
    times: &StepTimes,
) -> io::Result<()> {
    let number = |is: fn(&Remark) -> bool| seeds.iter().filter(|found| is(&found.remark)).count();
    let remarks = [
        (number(|remark| *remark == Remark::Candidate), "meet the collection rule before their walks start"),
        (
            number(|remark| matches!(remark, Remark::NotInMixture(_))),
            "have an element that the mixture has no data of",
        ),
        (number(|remark| matches!(remark, Remark::Ungraded(_))), "cannot be graded"),
    ];
    for (number, words) in remarks.into_iter().filter(|(number, _)| *number > 0) {
        writeln!(out, "  at the start     {number} of {} {words}", count(seeds.len(), "seed structure"))?;
    }
    let walks = times.total(seeds.iter().map(|found| found.seed));
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
    let architecture = model.description().architecture;
    let atoms = || seed_structures.iter().map(|named| named.seed.structure.len());
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
