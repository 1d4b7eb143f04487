//! `calmwalk run`

mod begin;
mod lock;

use std::fs::DirBuilder;
use std::io::ErrorKind;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use orchestrator::launcher::raise_descriptor_limit;
use orchestrator::reactor;
use orchestrator::selector::{Selector, SelectorSnapshot};
use serde_json::json;
use store::{DATABASE, Location, ProcessRecord, SERVER_AWAY, Store, StoreError, unix_milliseconds};
use tokio::sync::Notify;
use wire::net::{Endpoint, Tls};
use workers::labeller::GUARD;

use super::place::{self, shown};
use super::{Ended, Failure, block_on};
use crate::actors::notify::{self, Notifier};
use crate::actors::{self, budget, in_process, processes};
use crate::campaign::Campaign;
use crate::ends::Ends;
use crate::forecast::{self, Forecast, megabytes};
use crate::labelling::LABEL_METHOD;
use crate::origin::Origin;
use crate::output::{print, say, say_if_unprotected, warn};
use crate::{log, story, summary, web};

/// Run a campaign to its end, or go on with one that was interrupted
///
/// The same command starts a campaign and continues it, whatever stopped it. Ctrl-C or SIGTERM stops in order within
/// seconds; a second one at once.
#[derive(Debug, clap::Args)]
pub struct Run {
    /// Configuration of the campaign
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// Directory of the campaign [default: beside the configuration, with its name but no extension]
    #[arg(long, value_name = "DIR")]
    directory: Option<PathBuf>,
    /// Go on with a campaign that belongs to another configuration file: this one takes its place
    #[arg(long)]
    adopt: bool,
    /// Walkers and labellers as threads of this process, not as processes of their own; needs no shared memory
    #[arg(long)]
    in_process: bool,
    /// Let agents of other hosts take part (calmwalk agent --join), as tcp/0.0.0.0:7447
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "in_process")]
    listen: Option<Endpoint>,
    /// Directory with authority.pem, certificate.pem and key.pem: needed for everything but loopback
    #[arg(long, value_name = "DIR", requires = "listen")]
    tls: Option<PathBuf>,
    /// Write into this file where agents find this process (calmwalk agent --join @FILE), and in the end that there is no
    /// more work
    #[arg(long, value_name = "FILE", requires = "listen")]
    announce: Option<PathBuf>,
    /// Name by which other hosts know this one, to be announced [default: its host name]
    #[arg(long, value_name = "NAME", requires = "announce")]
    host: Option<String>,
    #[command(flatten)]
    shown_at: web::Addresses,
    #[command(flatten)]
    log: log::Options,
    /// Wait so long for another process that runs this campaign, which may be about to end, min
    #[arg(long, value_name = "MINUTES", default_value_t = 0.0, value_parser = minutes)]
    patience: f64,
}

impl Run {
    pub fn run(self) -> Result<Ended, Failure> {
        self.log.begin("orchestrator")?;
        let campaign = Campaign::load(&self.config)?;
        campaign.print_warnings();
        let directory = match self.directory {
            Some(directory) => directory,
            None => {
                let directory = place::default_directory(&self.config);
                block_on(place::refuse_if_kept_elsewhere(&campaign, &directory))??;
                directory
            }
        };
        make(&directory)?;
        let listen = self.listen.map(|endpoint| actors::Listen {
            endpoint,
            tls: self.tls.as_deref().map(Tls::from_directory),
            announce: self.announce,
            host: self.host.unwrap_or_else(store::this_host),
        });
        listen.iter().try_for_each(actors::Listen::check)?;
        if !self.in_process {
            raise_descriptor_limit();
        }
        let patience = Duration::from_secs_f64(60.0 * self.patience);
        let ended = block_on(async {
            let location = campaign.config.location(&directory)?;
            say_if_unprotected(&location);
            let web = self.shown_at.listen().await?;
            let _lock = lock::directory(&directory, &location, patience).await?;
            listen.iter().try_for_each(actors::Listen::begins)?;
            let (in_process, adopt) = (self.in_process, self.adopt);
            let how = How { in_process, adopt, listen: listen.as_ref(), web, patience };
            run(&campaign, &directory, &location, how).await
        })?
        .map_err(|failure| failure.in_campaign(&directory))?;
        listen.iter().try_for_each(|listen| listen.has_ended(ended))?;
        if ended == Ended::Interrupted {
            say("stopped in order; the same command goes on with the campaign");
        }
        Ok(ended)
    }
}

/// Makes the campaign's directory, which only this user needs to read.
fn make(directory: &Path) -> Result<(), Failure> {
    if directory.to_string_lossy().contains("://") {
        // A URL may have a password in it.
        return Err(Failure::Input(
            "--directory is a URL; expected a directory of this host: the URL of a database is run.store of the configuration"
                .to_owned(),
        ));
    }
    let failed = |source| StoreError::Directory { directory: directory.into(), source };
    let made = DirBuilder::new().recursive(true).mode(0o700).create(directory);
    made.map_err(|source| match source.kind() {
        ErrorKind::StorageFull => StoreError::DiskFull.into(),
        ErrorKind::AlreadyExists => {
            failed(std::io::Error::new(ErrorKind::NotADirectory, "it is a file")).into()
        }
        _ => Failure::Input(format!("{}; --directory names another one", failed(source))),
    })
}

/// What the command line says besides the configuration.
struct How<'a> {
    in_process: bool,
    /// Whether the campaign may belong to another configuration file.
    adopt: bool,
    listen: Option<&'a actors::Listen>,
    web: web::Listening,
    patience: Duration,
}

async fn run(
    campaign: &Campaign,
    directory: &Path,
    location: &Location,
    how: How<'_>,
) -> Result<Ended, Failure> {
    let How { in_process, adopt, listen, web, patience } = how;
    let lock = lock::server(location, patience).await?;
    let origin = Origin::new(&campaign.path, &campaign.text, directory);
    let store = open_store(campaign, location, &origin, adopt).await?;
    let store = lock.iter().fold(store, Store::led_by);
    if let Location::Directory(directory) = &location {
        warn_of_the_disk(campaign, directory, &store).await?;
    }
    let process = register(&store).await?;
    let selector = restore_selector(campaign, &store).await?;
    if campaign.config.label.slots == 0 {
        let shown = shown(location);
        say(format_args!("label.slots = 0: labels come from calmwalk label --store {shown}"));
    }
    let over = Arc::new(Notify::new());
    let run = actors::Run { campaign, store: &store, process: &process, directory, listen, over: &over };
    let (limits, used_up) = (campaign.config.budget(), budget::time_used_up(&store).await?);
    let work = async {
        if used_up.is_some() {
            // Nothing may be begun.
            return Ok(reactor::RunOutcome::Stopped);
        }
        if in_process { in_process::work(run, selector).await } else { processes::work(run, selector).await }
    };
    let serving = web.serve(location, &store, &campaign.artifact).await?;
    let mut notifier = Notifier::new(&campaign.config, &store, location).await?;
    let worked = tokio::select! {
        ended = work => ended,
        error = budget::keep(&store, &limits, &over) => Err(error.into()),
        error = lock::lost(lock.as_ref()) => Err(error.into()),
        never = notify::keep(&mut notifier) => match never {},
    };
    notify::finish(notifier, worked.as_ref().err()).await;
    serving.end().await;
    let ended = worked?;
    // Hours of work do not end as a failure because a server is away in the last second.
    let store = store.patient(SERVER_AWAY);
    loop {
        match leave(&store, &process, ended).await {
            Err(StoreError::Unreachable(_)) => {}
            left => break left?,
        }
    }
    if !store.status().await?.finished {
        store.close().await;
        return Ok(Ended::Interrupted);
    }
    let summary = summary::of(&store, campaign.protocol.hash).await?;
    let status = store.status().await?;
    let (failed, ends) = (status.labels.failed, Ends::of(&status.walks));
    let (shown, file) = match location {
        Location::Directory(_) => (shown(location), format!("/{DATABASE}")),
        Location::Server(_) => (shown(location), String::new()),
    };
    print(|out| {
        writeln!(out, "{summary}")?;
        writeln!(out, "the campaign is in {shown}{file}; look further with")?;
        writeln!(out, "  calmwalk status {shown}")?;
        writeln!(out, "  calmwalk queue {shown} list")?;
        if failed > 0 {
            writeln!(out, "  calmwalk queue {shown} list --state failed")?;
        }
        writeln!(out, "  calmwalk export {shown} --output dataset.extxyz")
    })?;
    store.close().await;
    if ends.none_in_order() {
        warn(format_args!("calmwalk: the campaign has failed: {}", ends.warning()));
        return Ok(Ended::NoneInOrder);
    }
    Ok(Ended::Done)
}

/// Begins the campaign, or opens the one that is there and checks that it is the same.
async fn open_store(
    campaign: &Campaign,
    location: &Location,
    origin: &Origin,
    adopt: bool,
) -> Result<Store, Failure> {
    let now = unix_milliseconds();
    let resolved = campaign.resolved();
    let store = match Store::open(location).await {
        Err(StoreError::Missing { .. }) => {
            let record = store::Campaign {
                id: campaign.id(),
                program_version: env!("CARGO_PKG_VERSION").to_owned(),
                mode: campaign.config.campaign.mode.name().to_owned(),
                configuration: campaign.text.clone(),
                resolved_configuration: resolved.to_string(),
                configuration_in_force: resolved.to_string(),
            };
            let store = Store::create(location, &record, &campaign.stored_seeds(), now).await?;
            begin::begun(&store, origin, location).await?;
            store
        }
        opened => {
            let store = opened?;
            begin::go_on(campaign, &store, location, origin, adopt).await?;
            store
        }
    };
    store.set_budget(&campaign.config.budget()).await?;
    store.set_grade_files(&campaign.grade_files()).await?;
    leave_notes(campaign, &store).await?;
    // Labellers that wait for the campaign begin with its protocol.
    store.add_protocol(&campaign.protocol, now).await?;
    Ok(store)
}

/// Says in the store what others do not know: how labels are made, which elements the model has, how much disk is needed.
async fn leave_notes(campaign: &Campaign, store: &Store) -> Result<(), Failure> {
    let text = |note: serde_json::Result<String>| note.map_err(Failure::failed);
    let method = campaign.method()?;
    store.leave_note(LABEL_METHOD, &text(serde_json::to_string(&method))?).await?;
    store.leave_note(GUARD, &text(serde_json::to_string(&campaign.config.label.guard))?).await?;
    let elements: Vec<_> = campaign.model.elements().iter().map(|species| species.symbol()).collect();
    store.leave_note(story::ELEMENTS, &text(serde_json::to_string(&elements))?).await?;
    store.leave_note(forecast::NOTE, &text(serde_json::to_string(&Forecast::of(campaign)))?).await?;
    Ok(())
}

/// A campaign that will not have room on its disk is better stopped now.
async fn warn_of_the_disk(campaign: &Campaign, directory: &Path, store: &Store) -> Result<(), Failure> {
    let forecast = Forecast::of(campaign);
    let needed = (forecast.bytes() + forecast::LOG).saturating_sub(store.size().await?);
    let free = store::free_space(directory)?;
    if free < needed {
        warn(format_args!(
            "WARNING: the campaign will take {} more on the disk of {}, where {} are free (forecast: {forecast})",
            megabytes(needed),
            directory.display(),
            megabytes(free)
        ));
    }
    Ok(())
}

/// Makes this process known, and takes back what dead ones held: the lock says that there is no other.
async fn register(store: &Store) -> Result<ProcessRecord, StoreError> {
    let now = unix_milliseconds();
    store.take_over(now).await?;
    let record = ProcessRecord::new(ProcessRecord::ORCHESTRATOR, None, std::process::id(), now);
    store.upsert_process(&record).await?;
    let detail = json!({ "process": record.id, "program_version": env!("CARGO_PKG_VERSION") });
    store.log_operation(now, "started", &detail).await?;
    Ok(record)
}

/// Gives back what is held, at an end in order.
async fn leave(store: &Store, process: &ProcessRecord, ended: reactor::RunOutcome) -> Result<(), StoreError> {
    let now = unix_milliseconds();
    store.release_all(&process.id, now).await?;
    store.remove_process(&process.id).await?;
    let how = match ended {
        reactor::RunOutcome::Finished => "done",
        reactor::RunOutcome::Stopped => "stopped",
    };
    store.log_operation(now, "ended", &json!({ "process": process.id, "how": how })).await
}

async fn restore_selector(campaign: &Campaign, store: &Store) -> Result<Selector, Failure> {
    let snapshot = SelectorSnapshot {
        walks: store.load_walks().await?,
        components: store.load_components().await?,
        known: store.known_hashes().await?,
        imported: store.status().await?.imported,
        values: store.values().await?,
    };
    let mut selector = Selector::restore(
        campaign.selector_settings(),
        store.campaign().await?.id,
        campaign.seeds.iter().map(|named| named.seed.clone()).collect(),
        campaign.grader(),
        Arc::new(campaign.artifact.mixture.clone()),
        campaign.training.clone(),
        snapshot,
    )
    .map_err(Failure::failed)?;
    let begun = selector.start_walks();
    if !begun.decisions.is_empty() {
        store.commit(&begun).await?;
    }
    Ok(selector)
}

fn minutes(text: &str) -> Result<f64, String> {
    let minutes = text.parse().ok().filter(|minutes| (0.0..=1e6).contains(minutes));
    minutes.ok_or_else(|| "expected 0 to 1e6".to_owned())
}
