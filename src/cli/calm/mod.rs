//! `calmwalk calm`: commands for CALM mixtures, without a campaign.

mod info;
mod score;
mod scorer;

use super::{ExitStatus, Failure};

/// Inspect a CALM mixture, or grade structures with it
#[derive(Debug, clap::Subcommand)]
pub enum Calm {
    Info(info::Info),
    Score(score::Score),
}

impl Calm {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        match self {
            Self::Info(command) => command.run(),
            Self::Score(command) => command.run(),
        }
    }
}
