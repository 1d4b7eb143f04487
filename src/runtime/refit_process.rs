//! The process that trains a new version of the potential: starts it, and starts it again when it is killed.

use std::path::{Path, PathBuf};
use std::time::Duration;

use monitor::refit_schedule::BesideWalks;
use orchestrator::launcher::{ChildEvent, Children, Launch};
use orchestrator::selector::CampaignMode;
use orchestrator::supervisor::{ChildState, Limits};
use store::{Store, StoreError, VersionRecord, VersionState, unix_milliseconds};
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::RunContext;
use super::process_manager::all_failed_message;
use crate::campaign::LoadedCampaign;
use crate::config::RefitSection;
use crate::exit_status::CommandError;
use crate::log;
use crate::output::{log_and_print, log_and_warn};
use crate::process_config;
use crate::refit::settings::RefitterConfig;
use crate::refit::{self, schedule};

/// Interval between checks for a due refit and for newer versions of a live campaign.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);
/// A refit writes its own heartbeats, and a training takes as long as it takes: it is never considered hung.
const NO_TIMEOUT: Duration = Duration::from_secs(1 << 32);

/// Time after which a refit that cannot go on is tried again beside the walks of a live campaign.
const RETRY_INTERVAL: Duration = Duration::from_secs(300);

/// How a refit failed, after all its attempts.
enum RefitEnd {
    /// Its process reported what it cannot go on without: a disk, the database, a file of the configuration.
    CannotGoOn(CommandError),
    /// Its process crashed, or was killed.
    Crashed(CommandError),
}

/// The refit of a run.
pub struct RefitProcess<'a> {
    run: RunContext<'a>,
    refit: &'a RefitSection,
    /// While one is running.
    children: Option<Children>,
    /// When the next one may begin, after one that could not go on.
    wait_until: Option<Instant>,
}

impl<'a> RefitProcess<'a> {
    /// None is running yet.
    pub fn new(run: RunContext<'a>, refit: &'a RefitSection) -> Self {
        Self { run, refit, children: None, wait_until: None }
    }

    /// Starts a refit, unless one is running. [`Self::finish`] drives it.
    fn start(&mut self) -> Result<(), CommandError> {
        if self.children.is_some() {
            return Ok(());
        }
        log_and_print("training a new version of the potential …");
        let config = configuration(self.run.campaign, self.refit, self.run.directory)?;
        let config = RefitterConfig { parent: Some(std::process::id()), ..config };
        let limits = Limits {
            heartbeat_timeout: NO_TIMEOUT,
            max_restarts: self.refit.max_attempts.get() - 1,
            ..Limits::default()
        };
        self.children = Some(Children::new(1, limits, move |_, _| {
            Launch::this_program(["refitter"], process_config::to_bytes(&config))
        }));
        Ok(())
    }

    /// Runs the refit that is due to its end. Await it on the main thread, see [`orchestrator::launcher`].
    ///
    /// # Errors
    /// A refit that cannot go on; in reproducible mode also one that crashes again and again. The same run continues it.
    pub async fn run_to_end(&mut self) -> Result<(), CommandError> {
        self.start()?;
        let stop = self.run.stop.clone();
        let ended = tokio::select! {
            ended = self.finish() => Some(ended),
            () = stop.cancelled() => None,
        };
        match ended {
            None => self.stop().await,
            Some(Err(RefitEnd::Crashed(why))) if self.is_live() => self.refuse(&why).await,
            Some(ended) => ended.map_err(CommandError::from),
        }
    }

    fn is_live(&self) -> bool {
        self.run.campaign.config.campaign.mode == CampaignMode::Live
    }

    /// Whether one is running.
    pub fn is_running(&self) -> bool {
        self.children.is_some()
    }

    /// Asks the running refit to end, if there is one, and waits for that. A later one continues it.
    pub async fn stop(&mut self) -> Result<(), CommandError> {
        if let Some(children) = &mut self.children {
            children.stop();
        }
        self.finish().await.map_err(CommandError::from)
    }

    /// Beside the walks of a live campaign: starts refits that are due, and cancels [`RunContext::superseded`] or
    /// [`RunContext::walks_end`] when a version is registered that is newer than that of the walks. Never ends without an error.
    /// Cancel-safe.
    pub async fn watch(&mut self) -> CommandError {
        if !self.is_live() {
            return std::future::pending().await;
        }
        let mut ticks = interval(CHECK_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                // The walks need no new version.
                ended = self.finish(), if self.children.is_some() => match ended {
                    Ok(()) => {}
                    Err(RefitEnd::CannotGoOn(why)) => self.try_again_later(&why),
                    Err(RefitEnd::Crashed(why)) => if let Err(error) = self.refuse(&why).await {
                        return error;
                    },
                },
                _ = ticks.tick() => {}
            }
            match self.check().await {
                Err(CommandError::Failed(error)) => {
                    log_and_warn(format_args!("cannot look for refits: {error}"))
                }
                Err(error) => return error,
                Ok(()) => {}
            }
        }
    }

    /// Leaves the refit where it is. Its directory keeps what it has done.
    fn try_again_later(&mut self, why: &CommandError) {
        self.wait_until = Some(Instant::now() + RETRY_INTERVAL);
        log_and_warn(format_args!(
            "{why}; the walks go on, and it is tried again after {} s",
            RETRY_INTERVAL.as_secs()
        ));
    }

    /// Records that no version comes of a refit that crashes again and again.
    async fn refuse(&self, why: &CommandError) -> Result<(), CommandError> {
        let RunContext { store, campaign, .. } = self.run;
        let number = VersionRecord::next_number(&store.versions().await?);
        let record = VersionRecord {
            number,
            parent: campaign.version_number(),
            state: VersionState::Refused,
            reason: why.to_string(),
            method: self.refit.method.name().to_owned(),
            structures: store.accepted_structures().await?,
            last_decision: store.newest_mixture().await?.decision,
            labels: 0,
            model_hash: String::new(),
            mixture_hash: String::new(),
            figures: refit::figures_of_crashed((store, &campaign.config), self.run.directory, number).await?,
            seconds: 0.0,
            core_hours: 0.0,
            time: unix_milliseconds(),
        };
        log_and_warn(format_args!("version {} is refused: {why}", record.number));
        Ok(store.add_version(&record, None).await?)
    }

    async fn check(&mut self) -> Result<(), CommandError> {
        let RunContext { store, campaign, superseded, walks_end, .. } = self.run;
        let schedule = schedule::read(store, &campaign.config).await?;
        let begin = campaign_begin(store).await?;
        match schedule.beside_walks(campaign.version_number(), begin, unix_milliseconds()) {
            BesideWalks::Superseded => {
                if !superseded.is_cancelled() {
                    log_and_print(
                        "a newer version of the potential is registered: the walks with this one end",
                    );
                }
                superseded.cancel();
            }
            BesideWalks::WalksEnd => walks_end.cancel(),
            BesideWalks::RefitDue => {
                let may_start =
                    self.children.is_none() && self.wait_until.is_none_or(|time| Instant::now() >= time);
                if may_start
                    && !store.is_refit_running().await?
                    && let Err(why) = self.start()
                {
                    self.try_again_later(&why);
                }
            }
            BesideWalks::GoOn => {}
        }
        Ok(())
    }

    /// Drives the running refit, if there is one, to its end. Cancel-safe.
    async fn finish(&mut self) -> Result<(), RefitEnd> {
        let Some(children) = &mut self.children else { return Ok(()) };
        loop {
            match children.next().await {
                ChildEvent::Started { .. } => {}
                ChildEvent::Stderr { line, .. } => log_and_print(line),
                ChildEvent::Ended { ended, .. } => {
                    if ended.then != ChildState::Exited {
                        log_and_warn(format_args!("refit: {}; {}", ended.reason, ended.then));
                    }
                    // A database that is busy for a moment has the record a little longer.
                    let _ = self.run.store.remove_dead_refits().await;
                }
                ChildEvent::AllExited => {
                    let failed = how_it_failed(children);
                    self.children = None;
                    return failed.map_or(Ok(()), Err);
                }
            }
        }
    }
}

impl From<RefitEnd> for CommandError {
    fn from(end: RefitEnd) -> Self {
        let (RefitEnd::CannotGoOn(why) | RefitEnd::Crashed(why)) = end;
        why
    }
}

/// How the refit failed, if it did.
fn how_it_failed(children: &mut Children) -> Option<RefitEnd> {
    let how = all_failed_message(children)?;
    let error = CommandError::Failed(format!("the refit failed: {how}; the same command continues it"));
    let last = children.status().into_iter().next_back().and_then(|child| child.last_failure);
    Some(if last.is_some_and(|reason| reason.is_reported()) {
        RefitEnd::CannotGoOn(error)
    } else {
        RefitEnd::Crashed(error)
    })
}

/// When the campaign began, ms since 1970.
async fn campaign_begin(store: &Store) -> Result<i64, StoreError> {
    Ok(store.operations(0, 1).await?.first().map_or(0, |created| created.time))
}

/// What a refit of this campaign needs to know.
///
/// # Errors
/// A campaign without a file that a refit needs.
pub fn configuration(
    campaign: &LoadedCampaign,
    refit: &RefitSection,
    directory: &Path,
) -> Result<RefitterConfig, CommandError> {
    let absolute = |path: &Path| std::path::absolute(path).map_err(CommandError::failed);
    let directory = absolute(directory)?;
    let location = campaign.config.run.store.as_ref().map_or_else(|| directory.clone(), PathBuf::from);
    let first_model = campaign.first_model()?;
    Ok(RefitterConfig {
        parent: None,
        location,
        directory,
        parent_version: campaign.version_number(),
        parent_model: campaign.model_files()?.export,
        first_model,
        parent_mixture: campaign.mixture_file()?,
        precision: campaign.config.potential.precision,
        rng_seed: campaign.config.campaign.rng_seed,
        settings: campaign.refit_settings(refit)?,
        log: log::child_config(),
    })
}
