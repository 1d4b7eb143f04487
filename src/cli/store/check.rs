//! `calmwalk store check`

use std::io::Write;

use calm::Component;
use serde_json::json;
use store::{ComponentRecord, Finding, Store, StoreError};

use super::{CampaignArgs, CommandError, ExitStatus};
use crate::cli::block_on;
use crate::output::{Bar, print, print_json};

const BAR: &str = "checking {bar:32} {pos}/{len} rows  {eta} left";

/// Check the integrity of a campaign's store
///
/// Runs the integrity check of the database, then verifies that
///
/// - the decision log has no gaps, and each accepted candidate has a decision and a label job;
///
/// - labels belong to their jobs, contents match their hashes, and every row with numbers matches its checksum;
///
/// - components are readable, and archived calculation directories can be unpacked;
///
/// - no dead process holds a lease.
///
/// Prints each problem with its meaning and what to do; the exit code is 1 if there are any. Only reads, and works while the campaign
/// runs.
#[derive(Debug, clap::Args)]
pub struct StoreCheckArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl StoreCheckArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let (findings, rows) = block_on(self.check())??;
        if self.json {
            let problems =
                findings.iter().map(|Finding { what, then }| json!({ "what": what, "then": then }));
            print_json(&json!({ "rows": rows, "problems": problems.collect::<Vec<_>>() }))?;
        }
        let print_text = |out: &mut dyn Write| {
            findings.iter().try_for_each(|finding| writeln!(out, "{finding}"))?;
            if findings.is_empty() { writeln!(out, "no problems found in {rows} rows") } else { Ok(()) }
        };
        if !self.json {
            print(print_text)?;
        }
        match findings.len() {
            0 => Ok(ExitStatus::Done),
            found => Err(CommandError::Failed(format!("{found} findings in {}", self.location.get()?))),
        }
    }

    async fn check(&self) -> Result<(Vec<Finding>, u64), CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let (mut bar, mut rows) = (None, 0);
        let mut findings = store
            .check(|read, all| {
                rows = read;
                bar.get_or_insert_with(|| Bar::new(Some(all), BAR)).set(read, String::new);
            })
            .await?;
        match store.load_components().await {
            Ok(components) => findings.extend(components.iter().filter_map(check_component)),
            // Reported by the check above.
            Err(StoreError::Damaged { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        store.close().await;
        Ok((findings, rows))
    }
}

fn check_component(record: &ComponentRecord) -> Option<Finding> {
    let ComponentRecord { element, slot, bytes } = record;
    let error = Component::from_bytes(bytes).err()?;
    let what = format!("component {slot} of element {element} cannot be read ({error})");
    Some(Finding { what, then: "the mixture is damaged; restore the campaign from a backup" })
}
