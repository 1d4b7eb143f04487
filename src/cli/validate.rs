//! `calmwalk validate`

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use calm::Artifact;

use super::{ExitStatus, Failure};
use crate::campaign::Campaign;
use crate::disk_forecast::DiskForecast;
use crate::output::{count, print};

/// Check a configuration and every file that it names
///
/// Everything that is wrong is told at once, with file, line and key: exit code 2. What is possible but hardly meant is a warning on
/// the standard error, which changes nothing about the exit code.
#[derive(Debug, clap::Args)]
pub struct Validate {
    /// Configuration of a campaign
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
}

impl Validate {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let campaign = Campaign::load(&self.config)?;
        campaign.print_warnings();
        print(|out| write(out, &self.config, &campaign))?;
        Ok(ExitStatus::Done)
    }
}

fn write(out: &mut dyn Write, path: &Path, campaign: &Campaign) -> io::Result<()> {
    let Campaign { model, artifact: Artifact { mixture, .. }, seed_structures, .. } = campaign;
    let elements: Vec<_> = model.elements().iter().map(|species| species.symbol()).collect();
    let architecture = model.description().architecture;
    let atoms = || seed_structures.iter().map(|named| named.seed.structure.len());
    let (least, most) = (atoms().min().unwrap_or(0), atoms().max().unwrap_or(0));
    writeln!(out, "{} is a valid campaign", path.display())?;
    writeln!(out, "  potential        {architecture}, {}, cutoff {} Å", elements.join(" "), model.cutoff())?;
    let (components, features) = (mixture.iter().count(), mixture.dimension());
    let (components, features) = (count(components, "component"), count(features, "feature"));
    writeln!(out, "  mixture          {components}, {features} an atom")?;
    if !mixture.can_be_updated() {
        writeln!(
            out,
            "                   without scatter and counts: it can be scored with but not updated"
        )?;
    }
    writeln!(out, "  seed structures  {}, of {least} to {most} atoms", seed_structures.len())?;
    writeln!(out, "  labels           protocol '{}'", campaign.protocol.name)?;
    writeln!(out, "  disk             {}", DiskForecast::from_campaign(campaign))?;
    match campaign.warnings.len() {
        0 => writeln!(out, "  warnings         none"),
        count => writeln!(out, "  warnings         {count}: see above"),
    }
}
