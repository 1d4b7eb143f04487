//! `calmwalk exclude`

use std::io::{self, Write};

use store::{ExcludedLabel, ExclusionChange, Store, unix_milliseconds};

use super::{CampaignLocation, ExitStatus, Failure, block_on};
use crate::output::{Table, print, print_json, warn_if_unencrypted};

/// Take labels that turn out to be bad out of the data set, and take them in again
///
/// An excluded label stays in the store with its history, and counts nowhere: it is left out of exports, of force and energy errors, of
/// the offsets of the elements, and of summaries, reports and the dashboard's statistics. What it cost stays in the bill. A further result for
/// the structure does not take its place; `calmwalk relabel` asks for another label, which does, and counts.
///
/// Works while the campaign runs. All structures that are named are changed, or none.
#[derive(Debug, clap::Args)]
pub struct Exclude {
    #[command(flatten)]
    location: CampaignLocation,
    /// Candidates, by their ids, the beginning of these or the number of the decision; or imported structures, as import-3
    #[arg(value_name = "ID", required_unless_present = "list")]
    ids: Vec<String>,
    /// Why, for those who look at the labels later
    #[arg(long, value_name = "TEXT", required_unless_present_any = ["undo", "list"], value_parser = parse_reason)]
    reason: Option<String>,
    /// Take them in again
    #[arg(long, conflicts_with = "reason")]
    undo: bool,
    /// Only list what is excluded
    #[arg(long, conflicts_with_all = ["ids", "reason", "undo"])]
    list: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn parse_reason(text: &str) -> Result<String, String> {
    match text.trim() {
        "" => Err("expected some words that say why".to_owned()),
        text => Ok(text.to_owned()),
    }
}

impl Exclude {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        if self.list {
            let excluded = block_on(self.read())??;
            if self.json {
                print_json(&excluded)?
            } else {
                print(|out| write_list(out, &excluded))?
            }
            return Ok(ExitStatus::Done);
        }
        let changes = block_on(self.change())??;
        if self.json {
            print_json(&changes)?;
        } else {
            print(|out| changes.iter().try_for_each(|change| writeln!(out, "{}", self.outcome(change))))?;
        }
        Ok(ExitStatus::Done)
    }

    async fn read(&self) -> Result<Vec<ExcludedLabel>, Failure> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let excluded = store.excluded().await?;
        store.close().await;
        Ok(excluded)
    }

    async fn change(&self) -> Result<Vec<ExclusionChange>, Failure> {
        let location = self.location.get()?;
        warn_if_unencrypted(&location);
        let store = Store::open(&location).await?;
        let now = unix_milliseconds();
        let changes = match &self.reason {
            Some(reason) => store.exclude(&self.ids, reason, now).await?,
            None => store.include(&self.ids, now).await?,
        };
        store.close().await;
        Ok(changes)
    }

    /// What was done, in words.
    fn outcome(&self, change: &ExclusionChange) -> String {
        let ExclusionChange { id, protocols, changed, excluded } = change;
        let by = protocols.iter().map(|name| format!("'{name}'")).collect::<Vec<_>>().join(", ");
        match (excluded, changed) {
            (Some(_), true) => format!(
                "{id}: its label by {by} is excluded from exports and statistics (--undo takes it in again, calmwalk relabel asks for \
                 another)"
            ),
            (Some(reason), false) => format!("{id}: its label by {by} is excluded already: {reason}"),
            (None, true) => format!("{id}: its label by {by} counts again"),
            (None, false) => format!("{id}: its label by {by} was not excluded"),
        }
    }
}

fn write_list(out: &mut dyn Write, excluded: &[ExcludedLabel]) -> io::Result<()> {
    if excluded.is_empty() {
        return writeln!(out, "no label is excluded");
    }
    let mut table = Table::new(&["id", "protocol", "reason"]);
    for ExcludedLabel { id, protocol, exclusion } in excluded {
        table.push(vec![id.clone(), protocol.clone(), exclusion.reason.clone()]);
    }
    table.write(out)
}
