//! `calmwalk calm`: commands for CALM mixtures, without a campaign.

mod build;
mod info;
mod recalibrate;
mod score;
mod scorer;

use super::{ExitStatus, Failure};

/// Build, recalibrate or inspect a CALM mixture, or grade structures with it
#[derive(Debug, clap::Subcommand)]
pub enum Calm {
    Build(build::Build),
    Info(info::Info),
    Recalibrate(recalibrate::Recalibrate),
    Score(score::Score),
}

impl Calm {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        match self {
            Self::Build(command) => command.run(),
            Self::Info(command) => command.run(),
            Self::Recalibrate(command) => command.run(),
            Self::Score(command) => command.run(),
        }
    }
}
