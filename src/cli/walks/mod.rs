//! `calmwalk walks`

mod trace;
mod trajectory;

use store::{Location, Store, unix_milliseconds};
use wire::WalkId;

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::print;
pub use trace::TraceArgs;
pub use trajectory::TrajectoryArgs;

/// Show or pause walks
///
/// A walk pauses at the end of its current assignment (run.steps_per_assignment), and resumes from there. It stays paused when you stop and
/// resume the campaign. In reproducible mode, the other walks of the same round wait for it, because decisions must not depend on when
/// you pause a walk.
#[derive(Debug, clap::Args)]
#[command(subcommand_required = true, arg_required_else_help = true)]
pub struct WalksArgs {
    #[command(flatten)]
    location: CampaignArgs,
    #[command(subcommand)]
    action: WalksAction,
}

#[derive(Debug, clap::Subcommand)]
enum WalksAction {
    #[command(flatten)]
    Change(WalksCommand),
    /// Write the trace of a walk as CSV (docs/walk-diagnostics.md)
    Trace(TraceArgs),
    /// Write the recorded trajectory of a walk as extended XYZ or a LAMMPS dump (docs/walk-diagnostics.md)
    Trajectory(TrajectoryArgs),
}

#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub enum WalksCommand {
    /// Pause walks
    Pause(WalkSelectionArgs),
    /// Resume paused walks
    Resume(WalkSelectionArgs),
}

#[derive(Clone, Debug, PartialEq, clap::Args)]
pub struct WalkSelectionArgs {
    /// Numbers of the walks, as in calmwalk status
    #[arg(value_name = "WALK", required_unless_present = "all", conflicts_with = "all", value_parser = walk_number)]
    pub walks: Vec<u32>,
    /// All walks that have not ended
    #[arg(long)]
    pub all: bool,
}

impl WalksArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let location = self.location.get()?;
        match self.action {
            WalksAction::Change(change) => {
                let messages = block_on(self::change(&location, &change))??;
                print(|out| messages.iter().try_for_each(|line| writeln!(out, "{line}")))?;
            }
            WalksAction::Trace(trace) => block_on(trace.run(&location))??,
            WalksAction::Trajectory(trajectory) => block_on(trajectory.run(&location))??,
        }
        Ok(ExitStatus::Done)
    }
}

/// Pauses or resumes walks. Returns messages.
pub async fn change(location: &Location, action: &WalksCommand) -> Result<Vec<String>, CommandError> {
    let (selection, paused) = match action {
        WalksCommand::Pause(selection) => (selection, true),
        WalksCommand::Resume(selection) => (selection, false),
    };
    let store = Store::open(location).await?;
    let walks = match selection.all {
        true => store.active_walks().await?,
        false => selection.walks.iter().copied().map(WalkId).collect(),
    };
    let changed = store.pause_walks(&walks, paused, unix_milliseconds()).await?;
    store.close().await;
    let state = if paused { "paused" } else { "resumed" };
    Ok(match changed.as_slice() {
        [] => vec!["nothing to do".to_owned()],
        changed => changed.iter().map(|walk| format!("walk {walk} {state}")).collect(),
    })
}

/// Parses the number of a walk.
fn walk_number(text: &str) -> Result<u32, String> {
    text.parse().map_err(|_| match text.eq_ignore_ascii_case("all") {
        true => "to select all walks, use --all".to_owned(),
        false => "expected the number of a walk, as in calmwalk status, or --all".to_owned(),
    })
}
