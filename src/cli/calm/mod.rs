//! `calmwalk calm`: commands for CALM mixtures, without a campaign.

mod build;
mod compare;
mod filter;
mod info;
mod merge;
mod recalibrate;
mod score;
mod score_labels;
mod score_table;
mod scorer;

use super::{ExitStatus, Failure};

/// Build, recalibrate, compare or inspect CALM mixtures, grade structures, or judge grades by errors
#[derive(Debug, clap::Subcommand)]
pub enum Calm {
    Build(build::Build),
    Compare(compare::Compare),
    Filter(filter::Filter),
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
            Self::Filter(command) => command.run(),
            Self::Info(command) => command.run(),
            Self::Merge(command) => command.run(),
            Self::Recalibrate(command) => command.run(),
            Self::Score(command) => command.run(),
        }
    }
}
