//! The actors of a campaign at work: walkers as threads, reactor and labellers as tasks of one process.

use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use orchestrator::reactor::{self, Reactor};
use orchestrator::selector::Selector;
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinSet};
use wire::transport::{InProcess, Incoming};
use workers::labeller::{self, Closing, LabellerSettings, ReferenceMethod};
use workers::walk::WalkContext;
use workers::walker;

use crate::campaign::Campaign;
use crate::outcome::Failure;
use crate::output::say;
use crate::progress::Display;

/// Reports under way between walkers and reactor.
const CHANNEL: usize = 64;

/// Walkers, reactor and labellers at work.
pub struct Actors {
    walkers: Vec<JoinHandle<()>>,
    labellers: JoinSet<Result<(), StoreError>>,
    reactor: tokio::task::JoinHandle<Result<reactor::Ended, reactor::ReactorError>>,
    closing: Arc<Closing>,
    stopping: Arc<AtomicBool>,
}

impl Actors {
    /// Starts them all.
    pub fn start(
        campaign: &Campaign,
        selector: Selector,
        store: &Store,
        process: &ProcessRecord,
    ) -> Result<Self, Failure> {
        let stopping = Arc::new(AtomicBool::new(false));
        let closing = Arc::new(Closing::default());
        stop_on_signals(Arc::clone(&stopping), Arc::clone(&closing))?;
        let (to_reactor, incoming) = mpsc::channel(CHANNEL);
        let walkers = start_walkers(campaign, &to_reactor, &stopping)?;
        let labellers = start_labellers(campaign, store, process, &closing)?;
        let walk_steps = campaign.config.walk.equilibration + campaign.config.walk.steps.get();
        let mut display = Display::new(walk_steps, selector.standing(walk_steps));
        let reactor = Reactor {
            selector,
            store: store.clone(),
            incoming,
            stopping: Arc::clone(&stopping),
            queue_limit: u64::from(campaign.config.label.queue_limit.get()),
        };
        let reactor = tokio::spawn(async move {
            let ended = reactor.run(|notice| display.notice(&notice)).await;
            display.finish();
            ended
        });
        Ok(Self { walkers, labellers, reactor, closing, stopping })
    }

    /// Waits for all of them. A labeller that cannot go on stops the campaign: without labels its queue only grows.
    pub async fn finish(mut self) -> Result<reactor::Ended, Failure> {
        let mut failure = None;
        let ended = loop {
            tokio::select! {
                ended = &mut self.reactor => break ended.map_err(Failure::failed)?,
                Some(labeller) = self.labellers.join_next() => {
                    failure = failure_of(labeller).or(failure);
                    self.stopping.store(true, Ordering::Relaxed);
                }
            }
        };
        self.closing.no_more_jobs.store(true, Ordering::Relaxed);
        if ended.is_err() || failure.is_some() {
            self.stopping.store(true, Ordering::Relaxed);
            self.closing.stopping.store(true, Ordering::Relaxed);
        }
        let panicked = self.walkers.into_iter().map(JoinHandle::join).filter(Result::is_err).count();
        while let Some(labeller) = self.labellers.join_next().await {
            failure = failure_of(labeller).or(failure);
        }
        if panicked > 0 {
            return Err(Failure::Failed(format!("{panicked} walkers crashed: see the message above")));
        }
        let ended = ended.map_err(Failure::failed)?;
        match failure {
            Some(failure) => Err(failure),
            // Every walk is over, but the labellers were asked to stop and may have left jobs.
            None if self.closing.stopping.load(Ordering::Relaxed) => Ok(reactor::Ended::Stopped),
            None => Ok(ended),
        }
    }
}

/// Why a labeller ended, if it could not go on.
fn failure_of(labeller: Result<Result<(), StoreError>, JoinError>) -> Option<Failure> {
    match labeller {
        Ok(ended) => ended.err().map(Failure::from),
        Err(crash) => Some(Failure::Failed(format!("a labeller crashed: {crash}"))),
    }
}

fn start_walkers(
    campaign: &Campaign,
    to_reactor: &mpsc::Sender<Incoming>,
    stopping: &Arc<AtomicBool>,
) -> Result<Vec<JoinHandle<()>>, Failure> {
    let context =
        WalkContext { model: Arc::clone(&campaign.model), settings: Arc::new(campaign.walk_settings()) };
    let wanted = campaign.config.run.walkers;
    let cores = thread::available_parallelism().map_or(1, |cores| cores.get());
    let start = |number| {
        let mut transport = InProcess::new(number, to_reactor.clone(), Arc::clone(stopping));
        let context = context.clone();
        thread::Builder::new()
            .name(format!("walker-{number}"))
            .spawn(move || walker::run(&context, &mut transport))
            .map_err(|error| Failure::Failed(format!("cannot start walker {number}: {error}")))
    };
    (0..if wanted == 0 { cores } else { wanted }).map(|number| start(number as u32)).collect()
}

fn start_labellers(
    campaign: &Campaign,
    store: &Store,
    process: &ProcessRecord,
    closing: &Arc<Closing>,
) -> Result<JoinSet<Result<(), StoreError>>, Failure> {
    let label = &campaign.config.label;
    let mut labellers = JoinSet::new();
    for slot in 0..label.slots.get() {
        let method = ReferenceMethod::new(campaign.reference_potential().map_err(Failure::Input)?);
        let settings = LabellerSettings {
            holder: format!("{}/{slot}", process.id),
            protocol: campaign.protocol.clone(),
            attempts: label.attempts.get(),
            largest_force: label.largest_force.get(),
        };
        let (store, closing) = (store.clone(), Arc::clone(closing));
        labellers
            .spawn(async move { labeller::run(store, method, settings, &closing, unix_milliseconds).await });
    }
    Ok(labellers)
}

/// Ctrl-C and SIGTERM: the first stops in order, the second at once (which is safe too).
fn stop_on_signals(stopping: Arc<AtomicBool>, closing: Arc<Closing>) -> Result<(), Failure> {
    let mut interrupt = signal(SignalKind::interrupt()).map_err(Failure::failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(Failure::failed)?;
    tokio::spawn(async move {
        loop {
            tokio::select! { _ = interrupt.recv() => (), _ = terminate.recv() => () };
            if stopping.swap(true, Ordering::Relaxed) {
                process::exit(130);
            }
            closing.stopping.store(true, Ordering::Relaxed);
            say("stopping: walks are checkpointed …");
        }
    });
    Ok(())
}
