//! `calmwalk validate`

use std::path::PathBuf;

use super::{Ended, Failure};
use crate::campaign::Campaign;

/// Check a configuration and every file that it names
#[derive(Debug, clap::Args)]
pub struct Validate {
    /// Configuration of a campaign
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
}

impl Validate {
    pub fn run(self) -> Result<Ended, Failure> {
        let campaign = Campaign::load(&self.config)?;
        let atoms: Vec<_> = campaign.seeds.iter().map(|named| named.seed.structure.len()).collect();
        let elements: Vec<_> = campaign.model.elements().iter().map(|species| species.symbol()).collect();
        println!("{} is a valid campaign", self.config.display());
        println!("  potential        GRACE, {}, cutoff {} Å", elements.join(" "), campaign.model.cutoff());
        println!("  mixture          {} features an atom", campaign.artifact.mixture.dimension());
        let (least, most) = (atoms.iter().min().unwrap_or(&0), atoms.iter().max().unwrap_or(&0));
        println!("  seed structures  {} ({least} to {most} atoms)", atoms.len());
        println!("  labels           protocol '{}'", campaign.protocol.name);
        Ok(Ended::Done)
    }
}
