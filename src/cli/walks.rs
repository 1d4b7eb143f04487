//! `calmwalk walks`

use store::{Location, Store, unix_milliseconds};
use wire::WalkId;

use super::{CampaignLocation, Ended, Failure, block_on};
use crate::output::print;

/// Pause walks, and resume them
///
/// A paused walk gets no turn when the one that a walker has in hand is over (run.turn_steps). Resumed, it goes on where it
/// stands. It stays paused when the campaign is stopped and run again. In reproducible mode the round of a paused walk waits
/// for it, and so the other walks do: what is decided must not depend on who was paused when.
#[derive(Debug, clap::Args)]
#[command(subcommand_required = true, arg_required_else_help = true)]
pub struct Walks {
    #[command(flatten)]
    location: CampaignLocation,
    #[command(subcommand)]
    action: Action,
}

#[derive(Clone, Debug, PartialEq, clap::Subcommand)]
pub enum Action {
    /// Give them no turns
    Pause(Which),
    /// Give them turns again
    Resume(Which),
}

#[derive(Clone, Debug, PartialEq, clap::Args)]
pub struct Which {
    /// Numbers of walks, as calmwalk status shows them
    #[arg(value_name = "WALK", required_unless_present = "all", conflicts_with = "all", value_parser = walk)]
    pub walks: Vec<u32>,
    /// Every walk that has more steps to make
    #[arg(long)]
    pub all: bool,
}

impl Walks {
    pub fn run(self) -> Result<Ended, Failure> {
        let location = self.location.get()?;
        let done = block_on(change(&location, &self.action))??;
        print(|out| done.iter().try_for_each(|line| writeln!(out, "{line}")))?;
        Ok(Ended::Done)
    }
}

/// Pauses or resumes; what was done, in words.
pub async fn change(location: &Location, action: &Action) -> Result<Vec<String>, Failure> {
    let (which, paused) = match action {
        Action::Pause(which) => (which, true),
        Action::Resume(which) => (which, false),
    };
    let store = Store::open(location).await?;
    let walks = match which.all {
        true => store.active_walks().await?,
        false => which.walks.iter().copied().map(WalkId).collect(),
    };
    let changed = store.pause_walks(&walks, paused, unix_milliseconds()).await?;
    store.close().await;
    let state = if paused { "is paused" } else { "goes on" };
    Ok(match changed.as_slice() {
        [] => vec!["nothing to do: it was so already".to_owned()],
        changed => changed.iter().map(|walk| format!("walk {walk} {state}")).collect(),
    })
}

/// The number of a walk, as an argument.
fn walk(text: &str) -> Result<u32, String> {
    text.parse().map_err(|_| match text.eq_ignore_ascii_case("all") {
        true => "every walk is named by --all".to_owned(),
        false => "expected the number of a walk, as calmwalk status shows it, or --all".to_owned(),
    })
}
