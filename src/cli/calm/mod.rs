//! `calmwalk calm`: commands for CALM mixtures, without a campaign.

mod build;
mod compare;
mod info;
mod merge;
mod recalibrate;
mod score;
mod scorer;
mod validate;

use super::{ExitStatus, Failure};

/// Build, recalibrate, compare, inspect or test CALM mixtures, or grade structures with them
#[derive(Debug, clap::Subcommand)]
pub enum Calm {
    Build(build::Build),
    Compare(compare::Compare),
    Info(info::Info),
    Merge(merge::Merge),
    Recalibrate(recalibrate::Recalibrate),
    Score(score::Score),
    Validate(validate::Validate),
}

impl Calm {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        match self {
            Self::Build(command) => command.run(),
            Self::Compare(command) => command.run(),
            Self::Info(command) => command.run(),
            Self::Merge(command) => command.run(),
            Self::Recalibrate(command) => command.run(),
            Self::Score(command) => command.run(),
            Self::Validate(command) => command.run(),
        }
    }
}
