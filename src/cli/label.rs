//! `calmwalk label`

mod once;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use store::{Location, Store, StoreError};
use tokio::sync::Notify;

use super::{ExitStatus, Failure, block_on, place};
use crate::config::Config;
use crate::label_setup::{HostOptions, LabelSetup};
use crate::log::Options;
use crate::output::{log_and_print, warn_if_unencrypted};
use crate::runtime::label_pool::{self, LabelPool};
use crate::runtime::stop_signal;

/// Between two looks whether the campaign is there.
const PAUSE: Duration = Duration::from_secs(2);

/// Label what a campaign collects, anywhere that reaches its store
///
/// Method, protocol and limits are those of the campaign's [label] section. Labels as many structures side by side as there
/// are slots, each in a process of its own. Waits for work while the campaign is run or may be run again, and ends when it
/// is finished (exit code 0), or on Ctrl-C or SIGTERM (130): labels in hand are finished then, or given back if they take
/// longer than --grace.
#[derive(Debug, clap::Args)]
pub struct Label {
    /// Directory of the campaign (on its host), or the postgres:// URL of its store
    #[arg(long, value_name = "LOCATION", required_unless_present = "once")]
    store: Option<PathBuf>,
    /// Instead: label every structure of a file (extended XYZ or POSCAR) by the [label] section of --config, print the results
    /// and end. No campaign is needed, and none changes
    #[arg(long, value_name = "STRUCTURES", requires = "config", conflicts_with = "store")]
    once: Option<PathBuf>,
    /// With --once: where the labelled structures go, extended XYZ
    #[arg(long, value_name = "FILE", requires = "once")]
    output: Option<PathBuf>,
    /// With --once: print JSON
    #[arg(long, requires = "once")]
    json: bool,
    /// Labels to make side by side
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1024))]
    slots: u32,
    /// The method that the campaign must have, to be sure [default: whatever its configuration says]
    #[arg(long, value_name = "NAME")]
    method: Option<String>,
    /// A configuration whose [label] section says how the method's program is called on this host, and where its files are;
    /// its protocol must be the campaign's [default: as on the host of `calmwalk run`]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// A file that the method needs and that is not where the campaign's leader has it; known by its content. May be given
    /// several times
    #[arg(long = "file", value_name = "PATH")]
    files: Vec<PathBuf>,
    /// End when no label is waited for and nobody runs the campaign
    #[arg(long)]
    until_empty: bool,
    /// After a stop, labels in hand have so long to be finished, s: less than a batch system leaves between SIGTERM and SIGKILL
    #[arg(long, value_name = "SECONDS", default_value_t = 20.0, value_parser = seconds)]
    grace: f64,
    /// Wait so long for a campaign that has not begun yet, or whose store cannot be reached yet, min
    #[arg(long, value_name = "MINUTES", default_value_t = 0.0, value_parser = seconds)]
    wait: f64,
    #[command(flatten)]
    log: Options,
}

impl Label {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        self.log.init("label")?;
        block_on(self.label())?
    }

    async fn label(self) -> Result<ExitStatus, Failure> {
        let (stopping, stop) = stop_signal("stopping: labels in hand are finished or given back …")?;
        if let (Some(structures), Some(config)) = (&self.once, &self.config) {
            let (output, json) = (self.output.as_deref(), self.json);
            return once::label(once::Task { structures, config, output, json }, &stop).await;
        }
        let store = self.store.clone().unwrap_or_default();
        warn_if_unencrypted(&place::location(&store)?);
        loop {
            let Some((opened, label_setup)) = self.begin(&store, &stopping, &stop).await? else {
                return Ok(ExitStatus::Interrupted);
            };
            let place = match place::location(&store)? {
                Location::Directory(directory) => std::path::absolute(directory).map_err(Failure::failed)?,
                // With its password, if it has one.
                Location::Server(_) if store.to_str().is_some_and(Location::is_server) => store.clone(),
                Location::Server(url) => url.as_str().into(),
            };
            let protocol = label_setup.protocol.clone();
            let slots = LabelPool {
                number: self.slots,
                location: place,
                label_setup,
                until_empty: self.until_empty,
                grace: Duration::from_secs_f64(self.grace),
            };
            let ended = label_pool::run(&opened, slots, &stopping, &stop).await?;
            let is_in_force = opened.is_in_force(protocol.hash).await?;
            opened.close().await;
            if ended == ExitStatus::Interrupted || is_in_force {
                return Ok(ended);
            }
            let name = protocol.name;
            log_and_print(format_args!(
                "the campaign labels by another protocol than '{name}' now: going on with that"
            ));
        }
    }

    /// Opens the store, as soon as there is a campaign in it; `None` if somebody asked to stop first.
    async fn begin(
        &self,
        store: &Path,
        stopping: &Arc<AtomicBool>,
        stop: &Notify,
    ) -> Result<Option<(Store, LabelSetup)>, Failure> {
        let (begun, mut told) = (Instant::now(), false);
        while !stopping.load(Ordering::Relaxed) {
            // A campaign that begins meanwhile may be below the directory.
            let error = match self.open(&place::location(store)?).await {
                Ok(opened) => return Ok(Some(opened)),
                Err(Early::NotYet(error)) if begun.elapsed().as_secs_f64() < 60.0 * self.wait => error,
                Err(Early::NotYet(error)) => return Err(error.into()),
                Err(Early::Never(failure)) => return Err(failure),
            };
            if !std::mem::replace(&mut told, true) {
                log_and_print(format_args!("waiting for the campaign: {error}"));
            }
            tokio::select! { () = tokio::time::sleep(PAUSE) => {}, () = stop.notified() => {} }
        }
        Ok(None)
    }

    async fn open(&self, location: &Location) -> Result<(Store, LabelSetup), Early> {
        let store = Store::open(location).await?;
        let Some(protocol) = store.protocol_in_force().await? else {
            let lacks = "label protocol yet";
            return Err(Early::NotYet(StoreError::Missing { location: location.to_string(), lacks }));
        };
        let label = self.config.as_deref().map(Config::load_label).transpose();
        let label = label.map_err(|error| Early::Never(error.into()))?;
        let here = HostOptions { method: self.method.as_deref(), files: &self.files, label };
        match LabelSetup::read(&store, protocol, here).await {
            Ok(label_setup) => Ok((store, label_setup)),
            Err(failure) => Err(Early::Never(failure)),
        }
    }
}

/// Why there is nothing to label yet.
enum Early {
    NotYet(StoreError),
    Never(Failure),
}

impl From<StoreError> for Early {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::Missing { .. } | StoreError::Unreachable(_) => Self::NotYet(error),
            error => Self::Never(error.into()),
        }
    }
}

fn seconds(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (0.0..=1e6).contains(number));
    number.ok_or_else(|| "expected 0 to 1e6".to_owned())
}
