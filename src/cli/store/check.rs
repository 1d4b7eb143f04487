//! `calmwalk store check`

use calm::Component;
use store::{ComponentRecord, Finding, Store, StoreError};

use super::{CampaignLocation, ExitStatus, Failure};
use crate::cli::block_on;
use crate::output::{Bar, print};

const BAR: &str = "checking {bar:32} {pos}/{len} rows  {eta} left";

/// Check that a campaign's store is whole
///
/// The database's own check first, then everything that calmwalk promises of it: a decision log without gaps, the decision
/// and the job of each accepted candidate, labels that belong to their jobs, contents that have their hashes, components that
/// can be read, directories of calculations that can be unpacked, no lease of a process that is gone; and the checksum of
/// every row with numbers. Only reads, and a campaign may run meanwhile. Each finding is a line that says what it means and what to do; with any of them the exit code
/// is 1.
#[derive(Debug, clap::Args)]
pub struct Check {
    #[command(flatten)]
    location: CampaignLocation,
}

impl Check {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let (findings, rows) = block_on(self.check())??;
        print(|out| {
            findings.iter().try_for_each(|finding| writeln!(out, "{finding}"))?;
            if findings.is_empty() {
                writeln!(out, "nothing found: {rows} rows are as they should be")
            } else {
                Ok(())
            }
        })?;
        match findings.len() {
            0 => Ok(ExitStatus::Done),
            found => Err(Failure::Failed(format!("{found} findings in {}", self.location.get()?))),
        }
    }

    async fn check(&self) -> Result<(Vec<Finding>, u64), Failure> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let (mut bar, mut rows) = (None, 0);
        let mut findings = store
            .check(|read, all| {
                rows = read;
                bar.get_or_insert_with(|| Bar::new(Some(all), BAR)).set(read, String::new);
            })
            .await?;
        match store.load_components().await {
            Ok(components) => findings.extend(components.iter().filter_map(of_component)),
            // That was found already.
            Err(StoreError::Damaged { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        store.close().await;
        Ok((findings, rows))
    }
}

fn of_component(record: &ComponentRecord) -> Option<Finding> {
    let ComponentRecord { element, slot, bytes } = record;
    let error = Component::from_bytes(bytes).err()?;
    let what = format!("component {slot} of element {element} cannot be read ({error})");
    Some(Finding { what, then: "the mixture is damaged; restore the campaign from a backup" })
}
