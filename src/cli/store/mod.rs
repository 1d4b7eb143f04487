//! `calmwalk store`

mod backup;
mod check;
mod compact;

use super::{CampaignLocation, ExitStatus, Failure};

/// Check, back up or compact the store of a campaign
#[derive(Debug, clap::Args)]
#[command(subcommand_required = true, arg_required_else_help = true)]
pub struct StoreCommand {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    Check(check::Check),
    Backup(backup::Backup),
    Compact(compact::Compact),
}

impl StoreCommand {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        match self.action {
            Action::Check(command) => command.run(),
            Action::Backup(command) => command.run(),
            Action::Compact(command) => command.run(),
        }
    }
}
