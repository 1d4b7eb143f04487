//! `calmwalk versions`

mod compare;
mod errors;
mod export;
mod files;
mod list;
mod roll_back;
mod show;

use monitor::versions::taken_up;
use store::{Location, Store, VersionRecord, VersionState};

use super::{CampaignArgs, CommandError, ExitStatus, block_on};

/// List the versions of a campaign's potential, compare or export them, or go back to one
///
/// A version is a model with its mixture. Version 0 is that of the configuration. A campaign with [refit] trains further versions while it
/// runs, and keeps them in its store. A refused version has a number too, but no files. Without a subcommand, lists all versions.
#[derive(Debug, clap::Args)]
pub struct VersionsArgs {
    #[command(flatten)]
    location: CampaignArgs,
    #[command(subcommand)]
    action: Option<VersionsCommand>,
    /// Print JSON (docs/versions.md)
    #[arg(long, global = true)]
    json: bool,
}

#[derive(Debug, clap::Subcommand)]
enum VersionsCommand {
    /// List all versions and refused attempts
    List,
    Show(show::VersionsShowArgs),
    Compare(compare::VersionsCompareArgs),
    Export(export::VersionsExportArgs),
    RollBack(roll_back::VersionsRollBackArgs),
}

impl VersionsArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let (location, json) = (self.location.get()?, self.json);
        match self.action.unwrap_or(VersionsCommand::List) {
            VersionsCommand::List => list::run(&location, json),
            VersionsCommand::Show(command) => command.run(&location, json),
            VersionsCommand::Compare(command) => command.run(&location, json),
            VersionsCommand::Export(command) => command.run(&location, json),
            VersionsCommand::RollBack(command) => command.run(&location, json),
        }
    }
}

/// Reads from the store of a campaign, which may be running.
fn read<T>(
    location: &Location,
    read: impl AsyncFnOnce(&Store) -> Result<T, CommandError>,
) -> Result<T, CommandError> {
    block_on(async {
        let store = Store::open_read_only(location).await?;
        let found = read(&store).await;
        store.close().await;
        found
    })?
}

/// The versions of a campaign.
struct KnownVersions {
    /// Those from 1 on and refused attempts, by number.
    versions: Vec<VersionRecord>,
    /// Number of the version that the decision log last switched to.
    taken_up: u32,
}

impl KnownVersions {
    async fn read(store: &Store) -> Result<Self, CommandError> {
        Ok(Self { versions: store.versions().await?, taken_up: taken_up(&store.values().await?) })
    }

    /// The newest registered version; `None` for that of the configuration.
    fn newest(&self) -> Option<&VersionRecord> {
        self.versions.iter().rfind(|version| version.state == VersionState::Registered)
    }

    /// The newest version, if no walk runs with it.
    fn not_taken_up(&self) -> Option<u32> {
        self.newest().map(|newest| newest.number).filter(|newest| *newest > self.taken_up)
    }

    /// State of a version in words; version 0 is always registered.
    fn state(&self, number: u32) -> String {
        let found = self.versions.iter().find(|version| version.number == number);
        let state = found.map_or(VersionState::Registered, |version| version.state);
        let remark = if number == self.taken_up {
            ", in force"
        } else if self.not_taken_up() == Some(number) {
            ", not taken up"
        } else {
            ""
        };
        format!("{}{remark}", state.name())
    }
}

/// The version or refused attempt with this number, from 1.
///
/// # Errors
/// There is none.
fn numbered(versions: &[VersionRecord], number: u32) -> Result<&VersionRecord, CommandError> {
    versions.iter().find(|version| version.number == number).ok_or_else(|| {
        let expected = match versions.last() {
            Some(last) => format!("expected 0 to {}", last.number),
            None => "the campaign has version 0 only, that of its configuration".to_owned(),
        };
        CommandError::Input(format!("the potential has no version {number}: {expected}"))
    })
}

/// The same, if it has files.
///
/// # Errors
/// There is none, or it was refused.
fn registered(versions: &[VersionRecord], number: u32) -> Result<&VersionRecord, CommandError> {
    let found = numbered(versions, number)?;
    match found.state {
        VersionState::Registered => Ok(found),
        VersionState::Refused => Err(CommandError::Input(format!(
            "version {number} was refused and has no files: {}; expected a registered version",
            found.reason
        ))),
    }
}
