//! `calmwalk run`

mod lock;
mod registration;
mod resume;

use std::fs::DirBuilder;
use std::io::ErrorKind;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use monitor::candidate_details;
use monitor::disk;
use monitor::mixture_status::InitialMixture;
use monitor::mixture_values::MixtureValues;
use monitor::provenance::Provenance;
use monitor::walk_ends::WalkEnds;
use orchestrator::launcher::raise_descriptor_limit;
use orchestrator::reactor;
use orchestrator::selector::{OnForgetting, Selector};
use serde::Deserialize;
use store::{CampaignLock, DATABASE, Location, Store, StoreError, unix_milliseconds};
use tokio_util::sync::CancellationToken;
use wire::net::{Endpoint, Tls};
use workers::labeller::GUARD;

use super::campaign_location::{self, shell_argument};
use super::{CommandError, ExitStatus, block_on, duration_between};
use crate::campaign::LoadedCampaign;
use crate::disk_forecast;
use crate::duration::Duration;
use crate::forgetting::{ForgettingMeasurement, ForgettingRule};
use crate::label_line::LabelLine;
use crate::label_setup::LABEL_METHOD_KEY;
use crate::output::{count, log_and_print, log_and_warn, print, warn_if_unencrypted};
use crate::refit::schedule;
use crate::runtime::campaign_watch;
use crate::runtime::notify::{self, Notifier};
use crate::runtime::reference_check::{self, ANY_CHECK};
use crate::runtime::{self, time_budget, version_loop};
use crate::wording::disk::megabytes;
use crate::wording::{self, walk_ends};
use crate::{log, summary, web};

/// Run a campaign until it is finished, or resume it
///
/// The same command starts a campaign and resumes it after any interruption. Ctrl-C or SIGTERM checkpoints the walks and exits
/// within seconds (exit code 130); a second Ctrl-C exits at once.
#[derive(Debug, clap::Args)]
pub struct RunArgs {
    /// Configuration of the campaign (TOML)
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// Directory of the campaign, created if it does not exist [default: path of the configuration without its extension]
    #[arg(long, value_name = "DIR")]
    directory: Option<PathBuf>,
    /// Accept CONFIG for a campaign that was started with another configuration file [default: refuse it]
    #[arg(long)]
    adopt: bool,
    /// Start the walks although the reference check failed, that is, labels differ from the known values by more than the bounds of
    /// label.reference_check. calmwalk records this, and repeats the check when protocol, structures or bounds change. =ID accepts only the
    /// check with this identity
    #[arg(long, value_name = "ID", num_args = 0..=1, require_equals = true, default_missing_value = ANY_CHECK)]
    accept_reference_check: Option<String>,
    /// Run walkers and labellers as threads of this process instead of as separate processes; uses no shared memory
    #[arg(long)]
    in_process: bool,
    /// Accept agents of other hosts (calmwalk agent --join) at this endpoint, such as tcp/0.0.0.0:7447
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "in_process")]
    listen: Option<Endpoint>,
    /// Directory with authority.pem, certificate.pem and key.pem; required unless the endpoint is a loopback address
    #[arg(long, value_name = "DIR", requires = "listen")]
    tls: Option<PathBuf>,
    /// Write the address of this process to FILE, for agents on other hosts (agent --join @FILE). When the campaign is finished,
    /// FILE says so and the agents exit
    #[arg(long, value_name = "FILE", requires = "listen")]
    announce: Option<PathBuf>,
    /// Host name or address to announce to agents [default: host name of this host]
    #[arg(long, value_name = "NAME", requires = "announce")]
    host: Option<String>,
    #[command(flatten)]
    web: web::ListenArgs,
    #[command(flatten)]
    log: log::LogArgs,
    /// How long to wait for another run to release the campaign, such as 15m
    #[arg(long, value_name = "TIME", default_value_t = Duration::from_seconds(0), value_parser = duration_between("0s", "10000h"))]
    wait_timeout: Duration,
}

impl RunArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        self.log.init("orchestrator")?;
        let campaign = LoadedCampaign::load(&self.config)?;
        campaign.print_warnings();
        // The job of a campaign keeps its command when the configuration changes.
        if self.accept_reference_check.as_deref() == Some(ANY_CHECK) {
            reference_check::identity(&campaign)?;
        }
        let directory = match self.directory {
            Some(directory) => directory,
            None => {
                let directory = campaign_location::default_directory(&self.config);
                block_on(campaign_location::check_former_locations(&campaign, &directory))??;
                directory
            }
        };
        create_directory(&directory)?;
        let listen = self.listen.map(|endpoint| runtime::Listen {
            endpoint,
            tls: self.tls.as_deref().map(Tls::from_directory),
            announce: self.announce,
            host: self.host.unwrap_or_else(store::this_host),
        });
        listen.iter().try_for_each(runtime::Listen::check)?;
        if !self.in_process {
            raise_descriptor_limit();
        }
        let wait_timeout = self.wait_timeout.get();
        let ended = block_on(async {
            let location = campaign.config.location(&directory)?;
            warn_if_unencrypted(&location);
            let web = self.web.listen().await?;
            let _lock = lock::directory(&directory, &location, wait_timeout).await?;
            listen.iter().try_for_each(runtime::Listen::clear_announcement)?;
            let (in_process, adopt, accept_reference_check) =
                (self.in_process, self.adopt, self.accept_reference_check.as_deref());
            let options = RunOptions {
                in_process,
                adopt,
                accept_reference_check,
                listen: listen.as_ref(),
                web,
                wait_timeout,
            };
            run(&campaign, &directory, &location, options).await
        })?
        .map_err(|failure| failure.in_campaign(&directory))?;
        listen.iter().try_for_each(|listen| listen.announce_end(ended))?;
        if ended == ExitStatus::Interrupted {
            log_and_print("stopped; run the same command again to resume the campaign");
        }
        Ok(ended)
    }
}

/// Creates the directory of the campaign, readable by this user only.
fn create_directory(directory: &Path) -> Result<(), CommandError> {
    if directory.to_string_lossy().contains("://") {
        // A URL may have a password in it.
        return Err(CommandError::Input(
            "--directory is a URL; expected a directory of this host. Set the URL of a database with run.store in the configuration"
                .to_owned(),
        ));
    }
    let failed = |source| StoreError::Directory { directory: directory.into(), source };
    let created = DirBuilder::new().recursive(true).mode(0o700).create(directory);
    created.map_err(|source| match source.kind() {
        ErrorKind::StorageFull => StoreError::DiskFull.into(),
        ErrorKind::AlreadyExists => {
            failed(std::io::Error::new(ErrorKind::NotADirectory, "it is a file")).into()
        }
        _ => CommandError::Input(format!("{}; choose another one with --directory", failed(source))),
    })
}

/// Options of the command line, without the configuration.
struct RunOptions<'a> {
    in_process: bool,
    /// Whether the campaign may have been started with another configuration file.
    adopt: bool,
    /// The check whose differences from the reference are accepted.
    accept_reference_check: Option<&'a str>,
    listen: Option<&'a runtime::Listen>,
    web: web::BoundListeners,
    wait_timeout: std::time::Duration,
}

async fn run(
    campaign: &LoadedCampaign,
    directory: &Path,
    location: &Location,
    options: RunOptions<'_>,
) -> Result<ExitStatus, CommandError> {
    let RunOptions { in_process, adopt, accept_reference_check, listen, web, wait_timeout } = options;
    let lock = lock::server(location, wait_timeout).await?;
    let origin = Provenance::new(&campaign.path, &campaign.text, directory);
    let store = open_store(campaign, location, &origin, adopt).await?;
    let store = lock.iter().fold(store, Store::fenced_by);
    if let Location::Directory(directory) = &location {
        warn_if_disk_is_too_small(campaign, directory, &store).await?;
    }
    // Everything but the identity of the campaign follows the version of its potential.
    let versioned = version_loop::in_force(campaign, &store, directory).await?;
    let campaign = &versioned;
    let selector = version_loop::restore_selector(campaign, &store).await?;
    let schedule = schedule::read(&store, &campaign.config).await?;
    if let Some(why) = schedule::why_no_walk_starts(&schedule).filter(|_| selector.is_done()) {
        log_and_print(why);
    }
    let pauses = campaign.config.calm.on_forgetting == OnForgetting::Pause;
    if pauses && selector.forgetting_level() > 1.0 && !selector.is_done() {
        return Err(paused_by_alarm(campaign, &store).await?);
    }
    let process = registration::register(&store).await?;
    warn_about_idle_walkers(campaign, location);
    let (stop, superseded) = (CancellationToken::new(), CancellationToken::new());
    let walks_end = superseded.child_token();
    let labels = LabelLine::default();
    let run = runtime::RunContext {
        campaign,
        store: &store,
        process: &process,
        directory,
        listen,
        labels: &labels,
        stop: &stop,
        superseded: &superseded,
        walks_end: &walks_end,
    };
    let mode = runtime::RunMode { in_process, accepted_check: accept_reference_check };
    let surroundings = Surroundings { location, lock: lock.as_ref(), web };
    let worked = work(run, surroundings, selector, mode).await;
    let store = registration::unregister(store, &process, worked.as_ref()).await;
    let outcome = worked?;
    let store = store?;
    let status = store.status().await?;
    // A refit may be left although every walk has ended, unless a budget of time allows no further work.
    let may_refit = campaign.config.refit.is_some()
        && outcome == reactor::RunOutcome::Stopped
        && status.budget.limits.time_used_up(&status.budget.used).is_none();
    if may_refit || !status.finished {
        if pauses && MixtureValues(store.values().await?).training_frames()["alarm"] == true {
            return Err(paused_by_alarm(campaign, &store).await?);
        }
        store.close().await;
        return Ok(ExitStatus::Interrupted);
    }
    let ended = print_end(campaign, location, &store).await;
    store.close().await;
    ended
}

/// Says which walkers will idle, and that labellers must be started.
fn warn_about_idle_walkers(campaign: &LoadedCampaign, location: &Location) {
    if let Some(idle) = runtime::idle_walkers(campaign) {
        log_and_warn(format_args!("WARNING: {idle}"));
    }
    if campaign.config.label.concurrency == 0 {
        let store = shell_argument(location);
        log_and_print(format_args!(
            "label.concurrency = 0: start labellers with calmwalk label --store {store}"
        ));
    }
}

/// Prints the summary of a finished campaign and what to do next.
async fn print_end(
    campaign: &LoadedCampaign,
    location: &Location,
    store: &Store,
) -> Result<ExitStatus, CommandError> {
    let summary = summary::read(store, campaign.protocol.hash).await?;
    let status = store.status().await?;
    let (failed, labelled) = (status.labels.failed, status.labels.labelled);
    let ends = WalkEnds::from_walks(&status.walks);
    let argument = shell_argument(location);
    let file = match location {
        Location::Directory(_) => format!("/{DATABASE}"),
        Location::Server(_) => String::new(),
    };
    print(|out| {
        writeln!(out, "{summary}")?;
        writeln!(out, "the campaign is in {argument}{file}; next:")?;
        let mut hint = |command: &str, what: &str| writeln!(out, "  {command:<52}  # {what}");
        hint(&format!("calmwalk report {argument} --output report"), "figures and tables as one page")?;
        hint(&format!("calmwalk force-errors {argument}"), "where the potential errs")?;
        hint(&format!("calmwalk dashboard {argument}"), "the structures in a browser")?;
        if failed > 0 {
            let what = format!("{failed} without a label, and why");
            hint(&format!("calmwalk queue {argument} list --state failed"), &what)?;
        }
        if labelled > 0 {
            let what = format!("{} ready", count(labelled, "label"));
            hint(&format!("calmwalk export {argument} --output dataset.extxyz"), &what)?;
            if campaign.config.refit.is_none() && campaign.config.potential.python.is_none() {
                let model = campaign.config.potential.model.get_ref().display();
                let upfit = format!("calmwalk upfit --model '{model}' dataset.extxyz -o improved.npz");
                hint(&upfit, "train the potential on them")?;
            }
        }
        Ok(())
    })?;
    if ends.all_early() {
        log_and_warn(format_args!("calmwalk: the campaign has failed: {}", walk_ends::warning(&ends)));
        return Ok(ExitStatus::NoWalkCompleted);
    }
    Ok(ExitStatus::Done)
}

/// What a run has beside its work.
struct Surroundings<'a> {
    location: &'a Location,
    /// The lock on the server.
    lock: Option<&'a CampaignLock>,
    web: web::BoundListeners,
}

/// Does the work of a run until it is finished or stopped, and meanwhile serves HTTP and notifies.
async fn work(
    run: runtime::RunContext<'_>,
    surroundings: Surroundings<'_>,
    selector: Selector,
    mode: runtime::RunMode<'_>,
) -> Result<reactor::RunOutcome, CommandError> {
    let runtime::RunContext { campaign, store, process, labels, stop, .. } = run;
    let Surroundings { location, lock, web } = surroundings;
    let (limits, used_up) = (campaign.config.budget(), time_budget::exhausted_time_limit(store).await?);
    let work = async {
        if used_up.is_some() {
            // The budget allows no further work.
            return Ok(reactor::RunOutcome::Stopped);
        }
        version_loop::run(run, selector, mode).await
    };
    let artifact = Some(&campaign.artifact).filter(|_| campaign.config.refit.is_none());
    let initial = artifact.map(|artifact| InitialMixture {
        symbols: artifact.symbols.clone(),
        mixture: artifact.mixture.clone(),
    });
    let serving = web.serve(location, store, initial).await?;
    let mut notifier = Notifier::new(&campaign.config, store, location).await?;
    let worked = tokio::select! {
        ended = work => ended,
        error = time_budget::track(store, &limits, stop) => Err(error.into()),
        error = lock::lost(lock) => Err(error.into()),
        never = notify::run(&mut notifier) => match never {},
        never = campaign_watch::watch(store, process.started, labels) => match never {},
    };
    // Where the next run, or a view, finds the campaign; other parts of the run report a broken database.
    let _ = store.add_history_sample(process.started, unix_milliseconds()).await;
    notify::finish(notifier, worked.as_ref().err()).await;
    serving.end().await;
    worked
}

/// Creates the campaign, or opens an existing one and checks that it belongs to this configuration.
async fn open_store(
    campaign: &LoadedCampaign,
    location: &Location,
    origin: &Provenance,
    adopt: bool,
) -> Result<Store, CommandError> {
    let now = unix_milliseconds();
    let resolved = campaign.resolved();
    let store = match Store::open(location).await {
        Err(StoreError::Missing { .. }) => {
            let record = store::CampaignRecord {
                id: campaign.id(),
                program_version: env!("CARGO_PKG_VERSION").to_owned(),
                mode: campaign.config.campaign.mode.name().to_owned(),
                configuration: campaign.text.clone(),
                resolved_configuration: resolved.to_string(),
                configuration_in_force: resolved.to_string(),
            };
            let store = Store::create(location, &record, &campaign.stored_seed_structures(), now).await?;
            resume::record_start(&store, origin, location).await?;
            store
        }
        opened => {
            let store = opened?;
            resume::resume(campaign, &store, location, origin, adopt).await?;
            store
        }
    };
    if let Some(supercells) = campaign.supercells() {
        log_and_print(format_args!("supercells: {supercells}"));
    }
    store.set_budget(&campaign.config.budget()).await?;
    store.set_lower_state_rule(&campaign.config.label.lower_state_rule()).await?;
    store.set_grade_files(&campaign.grade_files()).await?;
    write_metadata(campaign, &store).await?;
    // Last: labellers that wait for the campaign start as soon as it has a protocol.
    store.add_protocol(&campaign.protocol, now).await?;
    Ok(store)
}

/// Stores what other processes need to know: the label method, the guard, the elements of the model and the disk forecast.
async fn write_metadata(campaign: &LoadedCampaign, store: &Store) -> Result<(), CommandError> {
    let text = |json: serde_json::Result<String>| json.map_err(CommandError::failed);
    let method = campaign.method()?;
    store.set_metadata(LABEL_METHOD_KEY, &text(serde_json::to_string(&method))?).await?;
    store.set_metadata(GUARD, &text(serde_json::to_string(&campaign.config.label.guard))?).await?;
    let elements: Vec<_> = campaign.model.elements().iter().map(|species| species.symbol()).collect();
    store.set_metadata(candidate_details::ELEMENTS_KEY, &text(serde_json::to_string(&elements))?).await?;
    store
        .set_metadata(disk::METADATA_KEY, &text(serde_json::to_string(&disk_forecast::estimate(campaign)))?)
        .await?;
    Ok(())
}

/// Warns if the disk is too small for the campaign.
async fn warn_if_disk_is_too_small(
    campaign: &LoadedCampaign,
    directory: &Path,
    store: &Store,
) -> Result<(), CommandError> {
    let forecast = disk_forecast::estimate(campaign);
    let needed = (forecast.bytes() + disk_forecast::WAL_BYTES).saturating_sub(store.size().await?);
    let free = store::free_space(directory)?;
    if free < needed {
        log_and_warn(format_args!(
            "WARNING: the campaign needs {} more on the disk of {}, but only {} are free (forecast: {})",
            megabytes(needed),
            directory.display(),
            megabytes(free),
            wording::disk::forecast(&forecast)
        ));
    }
    Ok(())
}

/// Why the campaign does not continue, and what makes it continue.
async fn paused_by_alarm(campaign: &LoadedCampaign, store: &Store) -> Result<CommandError, CommandError> {
    let values = MixtureValues(store.values().await?).training_frames();
    let measured = ForgettingMeasurement::deserialize(values).map_err(CommandError::failed)?;
    Ok(CommandError::Failed(format!(
        "the campaign is paused: {}, then run it again",
        ForgettingRule::new(&campaign.config.calm).raised_message(&measured)
    )))
}
