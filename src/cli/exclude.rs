//! `calmwalk exclude`

use std::io::{self, Write};

use store::{ExcludedLabel, ExclusionChange, Store, unix_milliseconds};

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::{TextTable, print, print_json, warn_if_unencrypted};

/// Exclude bad labels from exports and statistics, or include them again
///
/// An excluded label stays in the store with its history. Exports, reports and all statistics (force and energy errors, energy offsets,
/// summaries, the dashboard) ignore it; its cost still counts. Another result for the structure does not replace it unless you request
/// one with `calmwalk relabel`.
///
/// Works while the campaign runs. Changes either all given structures or none.
#[derive(Debug, clap::Args)]
pub struct ExcludeArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Candidates: ids, unique prefixes of ids, or decision numbers; or imported structures, such as import-3
    #[arg(value_name = "ID", required_unless_present = "list")]
    ids: Vec<String>,
    /// Reason, stored with the labels
    #[arg(long, value_name = "TEXT", required_unless_present_any = ["undo", "list"], value_parser = parse_reason)]
    reason: Option<String>,
    /// Include the labels again
    #[arg(long, conflicts_with = "reason")]
    undo: bool,
    /// List the excluded labels
    #[arg(long, conflicts_with_all = ["ids", "reason", "undo"])]
    list: bool,
    /// Only show what would be changed
    #[arg(long, conflicts_with = "list")]
    dry_run: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn parse_reason(text: &str) -> Result<String, String> {
    match text.trim() {
        "" => Err("expected a reason".to_owned()),
        text => Ok(text.to_owned()),
    }
}

impl ExcludeArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        if self.list {
            let excluded = block_on(self.read())??;
            if self.json {
                print_json(&excluded)?
            } else {
                print(|out| write_list(out, &excluded))?
            }
            return Ok(ExitStatus::Done);
        }
        let changes = match self.dry_run {
            true => block_on(self.planned())??,
            false => block_on(self.change())??,
        };
        if self.json {
            print_json(&changes)?;
        } else {
            print(|out| changes.iter().try_for_each(|change| writeln!(out, "{}", self.message(change))))?;
        }
        Ok(ExitStatus::Done)
    }

    async fn read(&self) -> Result<Vec<ExcludedLabel>, CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let excluded = store.excluded().await?;
        store.close().await;
        Ok(excluded)
    }

    async fn planned(&self) -> Result<Vec<ExclusionChange>, CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let changes = store.exclusion_changes(&self.ids, self.reason.as_deref()).await?;
        store.close().await;
        Ok(changes)
    }

    async fn change(&self) -> Result<Vec<ExclusionChange>, CommandError> {
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

    fn message(&self, change: &ExclusionChange) -> String {
        let ExclusionChange { id, protocols, changed, excluded } = change;
        let protocols = protocols.iter().map(|name| format!("'{name}'")).collect::<Vec<_>>().join(", ");
        match (excluded, changed) {
            (Some(_), true) if self.dry_run => {
                format!("{id}: label of {protocols} would be excluded; nothing was changed")
            }
            (None, true) if self.dry_run => {
                format!("{id}: label of {protocols} would be included again; nothing was changed")
            }
            (Some(_), true) => format!(
                "{id}: label of {protocols} excluded from exports and statistics (undo with --undo, replace with calmwalk \
                 relabel)"
            ),
            (Some(reason), false) => format!("{id}: label of {protocols} was already excluded: {reason}"),
            (None, true) => format!("{id}: label of {protocols} included again"),
            (None, false) => format!("{id}: label of {protocols} was not excluded"),
        }
    }
}

fn write_list(out: &mut dyn Write, excluded: &[ExcludedLabel]) -> io::Result<()> {
    if excluded.is_empty() {
        return writeln!(out, "no excluded labels");
    }
    let mut table = TextTable::new(&["id", "protocol", "reason"]);
    for ExcludedLabel { id, protocol, exclusion } in excluded {
        table.push(vec![id.clone(), protocol.clone(), exclusion.reason.clone()]);
    }
    table.write(out)
}
