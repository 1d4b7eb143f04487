//! `calmwalk validate`

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use calm::Artifact;

use super::{ExitStatus, Failure};
use crate::campaign::{Campaign, PairRange};
use crate::disk_forecast;
use crate::output::{Table, count, decimals, print};
use crate::wording;

/// Number of pairs of elements that are shown.
const SHOWN: usize = 20;

/// Check a configuration and all files that it refers to
///
/// Reports all errors with file, line and key (exit code 2). Valid but suspicious values are warnings on standard error and do
/// not change the exit code.
#[derive(Debug, clap::Args)]
pub struct Validate {
    /// Configuration of a campaign (TOML)
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// List every pair of elements instead of the first 20
    #[arg(long)]
    all: bool,
}

impl Validate {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let campaign = Campaign::load(&self.config)?;
        campaign.print_warnings();
        print(|out| write(out, &self.config, &campaign, self.all))?;
        Ok(ExitStatus::Done)
    }
}

fn write(out: &mut dyn Write, path: &Path, campaign: &Campaign, all: bool) -> io::Result<()> {
    let Campaign { model, artifact: Artifact { mixture, .. }, seed_structures, .. } = campaign;
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
    let skipped = match campaign.skipped {
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
        0 => writeln!(out, "  warnings         none")?,
        count => writeln!(out, "  warnings         {count}, see above")?,
    }
    write_short_range(out, &campaign.pair_ranges, all)
}

/// The pairs of elements in the seed structures with their limits and windows.
fn write_short_range(out: &mut dyn Write, ranges: &[PairRange], all: bool) -> io::Result<()> {
    let mut table = Table::new(&[
        "pair",
        ">sum of radii (Å)",
        ">shortest (Å)",
        ">guard (Å)",
        ">ZBL full below (Å)",
        ">ZBL zero above (Å)",
    ]);
    let shown = if all { ranges.len() } else { ranges.len().min(SHOWN) };
    for PairRange { pair, shortest, limit, zbl, .. } in &ranges[..shown] {
        table.push(vec![
            pair.to_string(),
            format!("{:.2}", pair.covalent_radii()),
            format!("{shortest:.3}"),
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
