//! Runs a campaign in one process: walkers as threads, reactor and labellers as tasks.

use std::convert::Infallible;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use calm::Mixture;
use orchestrator::reactor;
use orchestrator::selector::Selector;
use potentials::grace::Threads;
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinSet};
use tokio_util::sync::CancellationToken;
use wire::shm_dir::ShmDir;
use wire::transport::{InProcess, Incoming};
use workers::labeller::{self, ExitPolicy, HEARTBEAT_INTERVAL, LabellerSettings, Shutdown, Timing};
use workers::walk::WalkContext;
use workers::walker;

use super::db_status::DbStatus;
use super::device_watch::{DeviceWatch, LABELS_GO_ON};
use super::label_order::CompletionModels;
use super::process_manager::LABEL_CHECK_INTERVAL;
use super::spawn::stop_labellers;
use super::{CHANNEL, ReactorTask, RunContext, start_reactor, wanted_walkers};
use crate::campaign::LoadedCampaign;
use crate::exit_status::CommandError;

/// Runs the campaign until it is finished or stopped.
pub async fn run(
    run: RunContext<'_>,
    selector: Selector,
    completion: CompletionModels,
) -> Result<reactor::RunOutcome, CommandError> {
    if let Ok(place) = ShmDir::for_campaign(run.directory) {
        // Removes what a killed run left in shared memory. This run needs nothing there.
        let _ = place.remove();
    }
    stop_labellers(run.store).await?;
    let actors = Tasks::start(run, selector, completion)?;
    let heartbeats = tokio::spawn(write_heartbeats(run.store.clone(), run.process.clone()));
    let ended = actors.finish().await;
    heartbeats.abort();
    ended
}

/// Keeps the heartbeat in `status` fresh.
pub(super) async fn write_heartbeats(store: Store, mut process: ProcessRecord) -> Infallible {
    let mut db_status = DbStatus::default();
    loop {
        tokio::time::sleep(HEARTBEAT_INTERVAL).await;
        process.last_seen = unix_milliseconds();
        // A busy database may miss a heartbeat.
        db_status.observe(&store.upsert_process(&process).await);
    }
}

/// Walkers, reactor and labellers.
struct Tasks {
    walkers: Vec<JoinHandle<walker::WalkerExit>>,
    labellers: JoinSet<Result<(), StoreError>>,
    reactor: ReactorTask,
    /// Cancelled when walks have made room for a newer version of the potential, whose walks do not wait for labels.
    superseded: CancellationToken,
    /// The store to poll for labels that other processes make, if this one makes none.
    external_labels: Option<Store>,
    closing: Arc<Shutdown>,
    /// Stops walkers and reactor, but not the labellers.
    stopping: CancellationToken,
    _watch: DeviceWatch,
}

impl Tasks {
    /// Starts all of them.
    fn start(
        run: RunContext<'_>,
        selector: Selector,
        completion: CompletionModels,
    ) -> Result<Self, CommandError> {
        let stopping = run.stop.child_token();
        let closing = Arc::new(Shutdown::new(run.stop.child_token()));
        let (to_reactor, incoming) = mpsc::channel(CHANNEL);
        let walkers = start_walkers(run.campaign, selector.original(), &to_reactor, &stopping)?;
        let labellers = start_labellers(run, &closing)?;
        let reactor = start_reactor(run, selector, incoming, stopping.clone(), completion);
        let external_labels = labellers.is_empty().then(|| run.store.clone());
        let superseded = run.superseded.clone();
        let devices = run.campaign.model.devices();
        let _watch = DeviceWatch::start(devices, Some(run.store), &stopping, LABELS_GO_ON);
        Ok(Self { walkers, labellers, reactor, superseded, external_labels, closing, stopping, _watch })
    }

    /// Waits for all of them. A labeller that cannot continue stops the campaign, because its queue could only grow.
    async fn finish(mut self) -> Result<reactor::RunOutcome, CommandError> {
        let mut failure = None;
        let ended = loop {
            tokio::select! {
                ended = &mut self.reactor => break ended.map_err(CommandError::failed)?,
                Some(labeller) = self.labellers.join_next() => {
                    failure = failure_of(labeller).or(failure);
                    self.stopping.cancel();
                }
            }
        };
        self.closing.set_no_more_jobs(true);
        if ended.is_err() || failure.is_some() {
            self.stopping.cancel();
            self.closing.stop.cancel();
        }
        let waits = matches!(ended, Ok(reactor::RunOutcome::Finished)) && !self.superseded.is_cancelled();
        if let Some(store) = self.external_labels.filter(|_| waits) {
            self.closing.stop.run_until_cancelled(wait_for_labels(&store)).await.transpose()?;
        }
        let panicked = self.walkers.into_iter().map(JoinHandle::join).filter(Result::is_err).count();
        while let Some(labeller) = self.labellers.join_next().await {
            failure = failure_of(labeller).or(failure);
        }
        if panicked > 0 {
            return Err(CommandError::Failed(format!("{panicked} walkers crashed: see the message above")));
        }
        let ended = ended.map_err(CommandError::failed)?;
        match failure {
            Some(failure) => Err(failure),
            // Every walk is over, but the labellers were asked to stop and may have left jobs.
            None if self.closing.stop.is_cancelled() => Ok(reactor::RunOutcome::Stopped),
            None => Ok(ended),
        }
    }
}

/// Waits until no structure lacks a label.
async fn wait_for_labels(store: &Store) -> Result<(), StoreError> {
    loop {
        match store.has_pending_labels(unix_milliseconds()).await {
            Ok(false) => return Ok(()),
            Err(error) if !error.is_transient() => return Err(error),
            _ => tokio::time::sleep(LABEL_CHECK_INTERVAL).await,
        }
    }
}

/// Why a labeller failed, if it did.
fn failure_of(labeller: Result<Result<(), StoreError>, JoinError>) -> Option<CommandError> {
    match labeller {
        Ok(ended) => ended.err().map(CommandError::from),
        Err(crash) => Some(CommandError::Failed(format!("a labeller crashed: {crash}"))),
    }
}

fn start_walkers(
    campaign: &LoadedCampaign,
    original: &Arc<Mixture>,
    to_reactor: &mpsc::Sender<Incoming>,
    stopping: &CancellationToken,
) -> Result<Vec<JoinHandle<walker::WalkerExit>>, CommandError> {
    let (model, settings) = (campaign.model.shared(), Arc::new(campaign.walk_settings()));
    let start = |number| {
        let mut transport = InProcess::new(number, to_reactor.clone(), stopping.clone());
        let threads =
            Threads::new(campaign.config.run.threads_per_walker.get()).map_err(CommandError::failed)?;
        let (model, settings, original) = (Arc::clone(&model), Arc::clone(&settings), Arc::clone(original));
        let context = WalkContext { model, threads, settings, original };
        thread::Builder::new()
            .name(format!("walker-{number}"))
            .spawn(move || walker::run(&context, &mut transport))
            .map_err(|error| CommandError::Failed(format!("cannot start walker {number}: {error}")))
    };
    (0..wanted_walkers(&campaign.config)).map(start).collect()
}

fn start_labellers(
    run: RunContext<'_>,
    closing: &Arc<Shutdown>,
) -> Result<JoinSet<Result<(), StoreError>>, CommandError> {
    let RunContext { campaign, store, process, .. } = run;
    let label = &campaign.config.label;
    let mut labellers = JoinSet::new();
    for worker in 0..label.concurrency {
        let method = campaign.method()?.load(&campaign.protocol)?;
        let settings = LabellerSettings {
            holder: format!("{}/{worker}", process.id),
            protocol: campaign.protocol.clone(),
            attempts: label.max_attempts.get(),
            bounds: label.bounds(),
            exit_policy: ExitPolicy::UntilEmpty,
            timing: Timing { lease: label.lease_timeout.get(), ..Timing::default() },
        };
        let (store, closing) = (store.clone(), Arc::clone(closing));
        labellers.spawn(async move {
            labeller::run(store, method, settings, &closing, unix_milliseconds, |_| ()).await
        });
    }
    Ok(labellers)
}
