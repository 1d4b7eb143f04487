//! `calmwalk calm`: what has to do with a mixture and needs no campaign.

mod info;
mod score;
mod scorer;

use super::{ExitStatus, Failure};

/// Look at a CALM mixture, or grade structures with it
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
