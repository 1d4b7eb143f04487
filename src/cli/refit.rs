//! `calmwalk refit`

use std::path::{Path, PathBuf};

use monitor::provenance::Provenance;
use orchestrator::selector::CampaignMode;
use serde_json::Value;
use store::{CampaignLock, Location, ProcessRecord, Store, StoreError};
use tokio_util::sync::CancellationToken;

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::campaign::LoadedCampaign;
use crate::config::{self, RefitSection, compare};
use crate::output::{count, log_and_print, print, warn_if_unencrypted};
use crate::refit::RefitOutcome;
use crate::refit::settings::RefitterConfig;
use crate::refit::{process, schedule};
use crate::runtime::refit_process;
use crate::signals::stop_token;
use crate::versions::VersionOnDisk;

/// The name of the lock holder in messages of other processes.
const HOLDER: &str = "calmwalk refit";

/// Train a new version of a campaign's potential now, from the labels so far
///
/// Trains one version in the foreground, without waiting for after_structures or after_time of section [refit]. It also trains when
/// max_versions or stop.min_improvement has ended the refits of the campaign; walks then do not use the new version. The same rules
/// register or refuse the version as in calmwalk run. The same command continues an interrupted refit.
///
/// Live mode: use it at any time; a running campaign switches to the new version. Reproducible mode: use it when nothing runs the
/// campaign, all walks have ended and all labels are final, so that the result does not depend on the moment. The next calmwalk run
/// switches to the new version.
///
/// Exit codes: 0 registered, or nothing new since the last attempt; 1 refused, or another failure; 2 invalid input; 130
/// interrupted.
#[derive(Debug, clap::Args)]
pub struct RefitArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Configuration of the campaign [default: that of the last calmwalk run]
    #[arg(long, value_name = "CONFIG")]
    config: Option<PathBuf>,
}

/// A refit that can begin.
struct PreparedRefit {
    config: RefitterConfig,
    /// So that nothing runs the campaign meanwhile.
    _lock: Option<CampaignLock>,
}

impl RefitArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let location = self.location.get()?;
        warn_if_unencrypted(&location);
        let stop = stop_token()?;
        let Some(outcome) = block_on(self.refit(&location, &stop))?? else {
            print(|out| {
                writeln!(
                    out,
                    "nothing is new since the last attempt: no structure was accepted, and the labels are the same"
                )
            })?;
            return Ok(ExitStatus::Done);
        };
        match outcome {
            RefitOutcome::Registered(version) => {
                let (number, labels) = (version.number, count(version.labels, "label"));
                print(|out| writeln!(out, "version {number} is registered, trained on {labels}"))?;
                Ok(ExitStatus::Done)
            }
            RefitOutcome::Refused(version) => Err(CommandError::Failed(format!(
                "version {} was refused: {}",
                version.number, version.reason
            ))),
            RefitOutcome::Stopped => {
                log_and_print("stopped; run the same command again to continue the refit");
                Ok(ExitStatus::Interrupted)
            }
        }
    }

    /// `None` if nothing is new.
    async fn refit(
        &self,
        location: &Location,
        stop: &CancellationToken,
    ) -> Result<Option<RefitOutcome>, CommandError> {
        let store = Store::open(location).await?;
        let prepared = self.prepare(&store, location).await;
        store.close().await;
        let Some(prepared) = prepared? else { return Ok(None) };
        process::run(&prepared.config, stop).await.map(Some)
    }

    async fn prepare(
        &self,
        store: &Store,
        location: &Location,
    ) -> Result<Option<PreparedRefit>, CommandError> {
        let known = Provenance::read(store).await?;
        let campaign = LoadedCampaign::load(&self.config_path(known.as_ref())?)?;
        let refit = section(&campaign)?;
        check_identity(store, &campaign).await?;
        let mode = campaign.config.campaign.mode;
        let lock = match mode {
            CampaignMode::Reproducible => Some(CampaignLock::acquire_at(location, HOLDER).await?),
            CampaignMode::Live => None,
        };
        if mode == CampaignMode::Reproducible {
            check_is_over(store, &campaign).await?;
        }
        check_is_alone(store).await?;
        let schedule = schedule::read(store, &campaign.config).await?;
        if !schedule.progress.has_news() {
            return Ok(None);
        }
        let directory = directory(location, known.as_ref())?;
        // The newest version, although no walk may have it.
        let versioned = match schedule.newest() {
            Some(newest) => campaign.with_version(VersionOnDisk::find(store, newest, &directory).await?)?,
            None => campaign.clone(),
        };
        let config = refit_process::configuration(&versioned, refit, &directory)?;
        // The campaign that the command line names, which may be a copy.
        let location = match location {
            Location::Directory(_) => config.directory.clone(),
            Location::Server(_) => self.location.location.clone(),
        };
        Ok(Some(PreparedRefit { config: RefitterConfig { location, ..config }, _lock: lock }))
    }

    fn config_path(&self, known: Option<&Provenance>) -> Result<PathBuf, CommandError> {
        if let Some(path) = &self.config {
            return Ok(path.clone());
        }
        let known = known.ok_or_else(|| {
            CommandError::input(
                "the store does not name the configuration of the campaign: give it with --config CONFIG",
            )
        })?;
        let path = PathBuf::from(&known.file.path);
        match path.is_file() {
            true => Ok(path),
            false => Err(CommandError::Input(format!(
                "{}, the configuration of the last calmwalk run, does not exist on this host: give it with --config CONFIG",
                path.display()
            ))),
        }
    }
}

/// The section `[refit]`.
fn section(campaign: &LoadedCampaign) -> Result<&RefitSection, CommandError> {
    campaign.config.refit.as_ref().ok_or_else(|| {
        CommandError::Input(format!(
            "{}: the configuration has no section [refit], so the campaign keeps its potential. A started campaign cannot get one: \
             add [refit] with replay = [\"FILE.extxyz\"] (labelled structures that the potential knows) to the configuration \
             of a new campaign. calmwalk upfit trains on an export of any campaign",
            campaign.path.display()
        ))
    })
}

/// Checks that the configuration is that of the campaign, as a run does. Changes that a run may make come into force with the
/// next run.
async fn check_identity(store: &Store, campaign: &LoadedCampaign) -> Result<(), CommandError> {
    let in_force = store.campaign().await?.configuration_in_force;
    let in_force: Value = serde_json::from_str(&in_force)
        .map_err(|error| StoreError::damaged("the configuration in force", error))?;
    match compare(&in_force, &campaign.resolved()) {
        Ok(_) => Ok(()),
        Err(refused) => {
            let at = config::location(&campaign.path, &campaign.text, refused.key());
            Err(CommandError::Input(format!(
                "{at}: {refused}, or name the campaign's configuration with --config"
            )))
        }
    }
}

/// Checks that nothing of a reproducible campaign is left that a training set would depend on.
async fn check_is_over(store: &Store, campaign: &LoadedCampaign) -> Result<(), CommandError> {
    let config = campaign.path.display();
    let walks = store.active_walks().await?.len() as u64;
    if walks > 0 {
        return Err(CommandError::Input(format!(
            "{} of this reproducible campaign {} not ended: calmwalk run {config} continues them, and trains a version by \
             itself when one is due",
            count(walks, "walk"),
            if walks == 1 { "has" } else { "have" }
        )));
    }
    let status = store.status().await?;
    match status.labels.queued + status.labels.leased {
        labels if labels > 0 && !status.finished => Err(CommandError::Input(format!(
            "{} of this reproducible campaign {} still missing: calmwalk run {config} computes them",
            count(labels, "label"),
            if labels == 1 { "is" } else { "are" }
        ))),
        _ => Ok(()),
    }
}

/// Checks that no other process trains a version.
async fn check_is_alone(store: &Store) -> Result<(), CommandError> {
    let others = store.processes(Some(ProcessRecord::REFITTER)).await?;
    match others.iter().find(|other| !other.is_dead() && !other.is_unresponsive()) {
        Some(ProcessRecord { pid, host, .. }) => Err(CommandError::Input(format!(
            "process {pid} on {host} is training a version of this campaign: wait for it, or stop it"
        ))),
        None => Ok(()),
    }
}

/// Directory of the campaign on this host.
fn directory(location: &Location, known: Option<&Provenance>) -> Result<PathBuf, CommandError> {
    if let Location::Directory(directory) = location {
        return Ok(directory.clone());
    }
    let directory = known.map(|known| known.directory.as_str()).unwrap_or_default();
    match Path::new(directory).is_dir() {
        true => Ok(PathBuf::from(directory)),
        false => Err(CommandError::Input(format!(
            "'{directory}', the directory of the campaign in its last run, does not exist on this host: run calmwalk refit on the host of that run"
        ))),
    }
}
