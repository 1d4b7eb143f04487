//! `calmwalk calm`: commands for CALM mixtures, without a campaign.

mod build;
mod compare;
mod export;
mod info;
mod merge;
mod recalibrate;
mod score;
mod scorer;

use super::{ExitStatus, Failure};

/// Build, recalibrate, compare, export or inspect CALM mixtures, or grade structures with them
#[derive(Debug, clap::Subcommand)]
pub enum Calm {
    Build(build::Build),
    Compare(compare::Compare),
    Export(export::Export),
    Info(info::Info),
    Merge(merge::Merge),
    Recalibrate(recalibrate::Recalibrate),
    Score(score::Score),
}

impl Calm {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        match self {
            Self::Build(command) => command.run(),
            Self::Compare(command) => command.run(),
            Self::Export(command) => command.run(),
            Self::Info(command) => command.run(),
            Self::Merge(command) => command.run(),
            Self::Recalibrate(command) => command.run(),
            Self::Score(command) => command.run(),
        }
    }
}
