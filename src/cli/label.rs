//! `calmwalk label`

use std::path::PathBuf;
use std::time::Instant;

use store::{Location, Store, StoreError};
use tokio_util::sync::CancellationToken;

use super::{CommandError, ExitStatus, block_on, campaign_location, duration_between};
use crate::config::Config;
use crate::duration::Duration;
use crate::label_setup::{HostOptions, LabelSetup, read_max_restarts};
use crate::log::LogArgs;
use crate::output::{log_and_print, warn_if_unencrypted};
use crate::runtime::label_pool::{self, LabelPool};
use crate::signals::cancel_on_signal;

/// Between two attempts to open a campaign that does not exist yet.
const RETRY_INTERVAL: std::time::Duration = std::time::Duration::from_secs(2);

/// Start labellers for a campaign on any host that reaches its store
///
/// Uses the method, protocol and limits of the campaign's [label] section, and starts --concurrency labellers as separate processes. Waits
/// for label jobs until the campaign is finished (exit code 0), also while no run is active. On Ctrl-C or SIGTERM, returns labels to the
/// queue that do not finish within --grace-period (exit code 130).
#[derive(Debug, clap::Args)]
pub struct LabelArgs {
    /// Store of the campaign: its directory (on the host that runs it), or the postgres:// URL
    #[arg(long, value_name = "LOCATION")]
    store: PathBuf,
    /// Number of labels to compute at the same time
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    concurrency: u32,
    /// Exit with an error unless the campaign uses this label method, such as vasp [default: accept any method]
    #[arg(long, value_name = "NAME")]
    method: Option<String>,
    /// Read the program's command and the file paths for this host from the [label] section of FILE; its protocol must equal the
    /// campaign's [default: as on the host of `calmwalk run`]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Path on this host of a file that the method needs (pseudopotential, potential); matched by content; may be repeated
    #[arg(long = "file", value_name = "PATH")]
    files: Vec<PathBuf>,
    /// Exit when the queue is empty and no run is active
    #[arg(long)]
    until_empty: bool,
    /// After Ctrl-C or SIGTERM, let labels in progress finish for this time. Choose less than the time between SIGTERM and
    /// SIGKILL of your batch system
    #[arg(long, value_name = "TIME", default_value_t = Duration::from_seconds(20), value_parser = duration_between("0s", "10000h"))]
    grace_period: Duration,
    /// How long to wait for a campaign that has not started or whose store cannot be reached, such as 15m
    #[arg(long, value_name = "TIME", default_value_t = Duration::from_seconds(0), value_parser = duration_between("0s", "10000h"))]
    wait_timeout: Duration,
    #[command(flatten)]
    log: LogArgs,
}

impl LabelArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        self.log.init("label")?;
        block_on(self.label())?
    }

    async fn label(self) -> Result<ExitStatus, CommandError> {
        let stop = CancellationToken::new();
        cancel_on_signal(stop.clone(), "stopping: labels in progress finish or return to the queue …")?;
        warn_if_unencrypted(&campaign_location::parse(&self.store)?);
        loop {
            let Some((opened, label_setup)) = self.wait_for_campaign(&stop).await? else {
                return Ok(ExitStatus::Interrupted);
            };
            let location = match campaign_location::parse(&self.store)? {
                Location::Directory(directory) => {
                    std::path::absolute(directory).map_err(CommandError::failed)?
                }
                // The text of the argument still has the password.
                Location::Server(_) if self.store.to_str().is_some_and(Location::is_server) => {
                    self.store.clone()
                }
                Location::Server(url) => url.as_str().into(),
            };
            let protocol = label_setup.protocol.clone();
            let pool = LabelPool {
                number: self.concurrency,
                location,
                label_setup,
                max_restarts: read_max_restarts(&opened).await?,
                until_empty: self.until_empty,
                grace_period: self.grace_period.get(),
            };
            let ended = label_pool::run(&opened, pool, &stop).await?;
            let is_in_force = opened.is_in_force(protocol.hash).await?;
            opened.close().await;
            if ended == ExitStatus::Interrupted || is_in_force {
                return Ok(ended);
            }
            let name = protocol.name;
            log_and_print(format_args!(
                "the campaign replaced label protocol '{name}': continuing with the new protocol"
            ));
        }
    }

    /// Opens the store once it contains a campaign. `None` if this process was asked to stop first.
    async fn wait_for_campaign(
        &self,
        stop: &CancellationToken,
    ) -> Result<Option<(Store, LabelSetup)>, CommandError> {
        let (started, mut reported) = (Instant::now(), false);
        while !stop.is_cancelled() {
            // Parsed at each attempt: the campaign may appear in a subdirectory.
            let error = match self.open(&campaign_location::parse(&self.store)?).await {
                Ok(opened) => return Ok(Some(opened)),
                Err(OpenError::NotReady(error)) if started.elapsed() < self.wait_timeout.get() => error,
                Err(OpenError::NotReady(error)) => return Err(error.into()),
                Err(OpenError::Fatal(failure)) => return Err(failure),
            };
            if !std::mem::replace(&mut reported, true) {
                log_and_print(format_args!("waiting for the campaign: {error}"));
            }
            stop.run_until_cancelled(tokio::time::sleep(RETRY_INTERVAL)).await;
        }
        Ok(None)
    }

    async fn open(&self, location: &Location) -> Result<(Store, LabelSetup), OpenError> {
        let store = Store::open(location).await?;
        let Some(protocol) = store.protocol_in_force().await? else {
            let lacks = "label protocol yet";
            return Err(OpenError::NotReady(StoreError::Missing { location: location.to_string(), lacks }));
        };
        let label = self.config.as_deref().map(Config::load_label).transpose();
        let label = label.map_err(|error| OpenError::Fatal(error.into()))?;
        let options = HostOptions { method: self.method.as_deref(), files: &self.files, label };
        match LabelSetup::read(&store, protocol, options).await {
            Ok(label_setup) => Ok((store, label_setup)),
            Err(failure) => Err(OpenError::Fatal(failure)),
        }
    }
}

/// Why the campaign could not be opened.
enum OpenError {
    /// It may be possible later.
    NotReady(StoreError),
    Fatal(CommandError),
}

impl From<StoreError> for OpenError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::Missing { .. } | StoreError::Unreachable(_) => Self::NotReady(error),
            error => Self::Fatal(error.into()),
        }
    }
}
