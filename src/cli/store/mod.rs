//! `calmwalk store`

mod backup;
mod check;
mod compact;

use super::{CampaignArgs, CommandError, ExitStatus};

/// Check, back up or compact the store of a campaign
#[derive(Debug, clap::Args)]
#[command(subcommand_required = true, arg_required_else_help = true)]
pub struct StoreArgs {
    #[command(subcommand)]
    action: StoreCommand,
}

#[derive(Debug, clap::Subcommand)]
enum StoreCommand {
    Check(check::StoreCheckArgs),
    Backup(backup::StoreBackupArgs),
    Compact(compact::StoreCompactArgs),
}

impl StoreArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        match self.action {
            StoreCommand::Check(command) => command.run(),
            StoreCommand::Backup(command) => command.run(),
            StoreCommand::Compact(command) => command.run(),
        }
    }
}
