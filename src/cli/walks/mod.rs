//! `calmwalk walks`

mod trace;
mod trajectory;

use serde_json::json;
use store::{Location, Store, unix_milliseconds};
use wire::WalkId;

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::{print, print_json};
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
    /// With pause and resume: print JSON
    #[arg(long, global = true)]
    json: bool,
    /// With pause and resume: print what would change without changing it
    #[arg(long, global = true)]
    dry_run: bool,
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
                let changed = match self.dry_run {
                    true => block_on(would_change(&location, &change))??,
                    false => block_on(changed_walks(&location, &change))??,
                };
                let paused = matches!(change, WalksCommand::Pause(_));
                if self.json {
                    let walks: Vec<_> = changed.iter().map(|walk| walk.0).collect();
                    print_json(&json!({ "walks": walks, "paused": paused, "dry_run": self.dry_run }))?;
                } else {
                    let messages = messages(&changed, paused, self.dry_run);
                    print(|out| messages.iter().try_for_each(|line| writeln!(out, "{line}")))?;
                }
            }
            WalksAction::Trace(trace) => block_on(trace.run(&location))??,
            WalksAction::Trajectory(trajectory) => block_on(trajectory.run(&location))??,
        }
        Ok(ExitStatus::Done)
    }
}

/// Pauses or resumes walks. Returns messages.
pub async fn change(location: &Location, action: &WalksCommand) -> Result<Vec<String>, CommandError> {
    let changed = changed_walks(location, action).await?;
    Ok(messages(&changed, matches!(action, WalksCommand::Pause(_)), false))
}

/// Pauses or resumes walks. Returns those that changed.
async fn changed_walks(location: &Location, action: &WalksCommand) -> Result<Vec<WalkId>, CommandError> {
    let (selection, paused) = action.selection();
    let store = Store::open(location).await?;
    let walks = selection.walks(&store).await?;
    let changed = store.pause_walks(&walks, paused, unix_milliseconds()).await?;
    store.close().await;
    Ok(changed)
}

/// The walks that would change.
async fn would_change(location: &Location, action: &WalksCommand) -> Result<Vec<WalkId>, CommandError> {
    let (selection, paused) = action.selection();
    let store = Store::open_read_only(location).await?;
    let (walks, status) = (selection.walks(&store).await?, store.status().await?);
    store.close().await;
    let find = |walk: &WalkId| status.walks.iter().find(|found| found.walk == walk.0);
    if let Some(unknown) = walks.iter().find(|walk| find(walk).is_none()) {
        return Err(CommandError::Input(format!("there is no walk {unknown}: see calmwalk status --all")));
    }
    let changes = |walk: &WalkId| find(walk).is_some_and(|found| found.is_active() && found.paused != paused);
    Ok(walks.into_iter().filter(changes).collect())
}

/// A line for each walk that changed, or would change.
fn messages(changed: &[WalkId], paused: bool, dry_run: bool) -> Vec<String> {
    let state = match (paused, dry_run) {
        (true, false) => "paused",
        (false, false) => "resumed",
        (true, true) => "would be paused",
        (false, true) => "would be resumed",
    };
    match changed {
        [] => vec!["nothing to do".to_owned()],
        changed => changed.iter().map(|walk| format!("walk {walk} {state}")).collect(),
    }
}

impl WalksCommand {
    /// Which walks, and whether they pause.
    fn selection(&self) -> (&WalkSelectionArgs, bool) {
        match self {
            Self::Pause(selection) => (selection, true),
            Self::Resume(selection) => (selection, false),
        }
    }
}

impl WalkSelectionArgs {
    async fn walks(&self, store: &Store) -> Result<Vec<WalkId>, CommandError> {
        Ok(match self.all {
            true => store.active_walks().await?,
            false => self.walks.iter().copied().map(WalkId).collect(),
        })
    }
}

/// Parses the number of a walk.
fn walk_number(text: &str) -> Result<u32, String> {
    text.parse().map_err(|_| match text.eq_ignore_ascii_case("all") {
        true => "to select all walks, use --all".to_owned(),
        false => "expected the number of a walk, as in calmwalk status, or --all".to_owned(),
    })
}
