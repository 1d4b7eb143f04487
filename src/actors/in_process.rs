//! Everything in one process: walkers as threads, reactor and labellers as tasks.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};

use orchestrator::reactor;
use orchestrator::selector::Selector;
use potentials::grace::Threads;
use store::{ProcessRecord, Store, StoreError, unix_milliseconds};
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinSet};
use wire::place::Place;
use wire::transport::{InProcess, Incoming};
use workers::labeller::{self, Closing, LabellerSettings, SIGN_OF_LIFE, Stay, Timing};
use workers::walk::WalkContext;
use workers::walker;

use super::answers::Answers;
use super::crew::LAST_LABELS;
use super::starts::no_labellers;
use super::{
    CHANNEL, ReactorTask, Run, STOPPING, start_reactor, stop_on_signals, stop_when_over, wanted_walkers,
};
use crate::campaign::Campaign;
use crate::outcome::Failure;

/// Runs the campaign until it is done or stopped.
pub async fn work(run: Run<'_>, selector: Selector) -> Result<reactor::Ended, Failure> {
    if let Ok(place) = Place::of(run.directory) {
        // What a killed run left; this one needs nothing there.
        let _ = place.remove();
    }
    no_labellers(run.store).await?;
    let actors = Actors::start(run, selector)?;
    let alive = tokio::spawn(say_alive(run.store.clone(), run.process.clone()));
    let ended = actors.finish().await;
    alive.abort();
    ended
}

/// Keeps the sign of life in `status` fresh.
async fn say_alive(store: Store, mut process: ProcessRecord) {
    let mut answers = Answers::default();
    loop {
        tokio::time::sleep(SIGN_OF_LIFE).await;
        process.last_seen = unix_milliseconds();
        // A busy database can do without this one.
        answers.tried(&store.upsert_process(&process).await);
    }
}

/// Walkers, reactor and labellers at work.
struct Actors {
    walkers: Vec<JoinHandle<walker::Ended>>,
    labellers: JoinSet<Result<(), StoreError>>,
    reactor: ReactorTask,
    /// Where labels of others are waited for, if nobody makes any here.
    labels_of_others: Option<Store>,
    closing: Arc<Closing>,
    stopping: Arc<AtomicBool>,
}

impl Actors {
    /// Starts them all.
    fn start(run: Run<'_>, selector: Selector) -> Result<Self, Failure> {
        let stopping = Arc::new(AtomicBool::new(false));
        let closing = Arc::new(Closing::default());
        let asked = (Arc::clone(&stopping), Arc::clone(&closing));
        let stop = move || {
            asked.0.store(true, Ordering::Relaxed);
            asked.1.stop();
        };
        stop_when_over(run.over, stop.clone());
        stop_on_signals(STOPPING, stop)?;
        let (to_reactor, incoming) = mpsc::channel(CHANNEL);
        let walkers = start_walkers(run.campaign, &to_reactor, &stopping)?;
        let labellers = start_labellers(run, &closing)?;
        let reactor = start_reactor(run, selector, incoming, &stopping);
        let labels_of_others = labellers.is_empty().then(|| run.store.clone());
        Ok(Self { walkers, labellers, reactor, labels_of_others, closing, stopping })
    }

    /// Waits for all of them. A labeller that cannot go on stops the campaign: without labels its queue only grows.
    async fn finish(mut self) -> Result<reactor::Ended, Failure> {
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
        self.closing.set_no_more_jobs(true);
        if ended.is_err() || failure.is_some() {
            self.stopping.store(true, Ordering::Relaxed);
            self.closing.stop();
        }
        if let Some(store) = self.labels_of_others.filter(|_| matches!(ended, Ok(reactor::Ended::Done))) {
            wait_for_labels(&store, &self.closing).await?;
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
            None if self.closing.is_stopping() => Ok(reactor::Ended::Stopped),
            None => Ok(ended),
        }
    }
}

/// Waits until no structure waits for a label, or somebody asks to stop.
async fn wait_for_labels(store: &Store, closing: &Closing) -> Result<(), StoreError> {
    while !closing.is_stopping() {
        match store.awaits_labels(unix_milliseconds()).await {
            Ok(false) => break,
            Err(error) if !error.is_transient() => return Err(error),
            _ => tokio::time::sleep(LAST_LABELS).await,
        }
    }
    Ok(())
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
) -> Result<Vec<JoinHandle<walker::Ended>>, Failure> {
    let (model, settings) = (Arc::clone(&campaign.model), Arc::new(campaign.walk_settings()));
    let start = |number| {
        let mut transport = InProcess::new(number, to_reactor.clone(), Arc::clone(stopping));
        let threads = Threads::new(campaign.config.run.threads.get()).map_err(Failure::failed)?;
        let context = WalkContext { model: Arc::clone(&model), threads, settings: Arc::clone(&settings) };
        thread::Builder::new()
            .name(format!("walker-{number}"))
            .spawn(move || walker::run(&context, &mut transport))
            .map_err(|error| Failure::Failed(format!("cannot start walker {number}: {error}")))
    };
    (0..wanted_walkers(campaign)).map(start).collect()
}

fn start_labellers(run: Run<'_>, closing: &Arc<Closing>) -> Result<JoinSet<Result<(), StoreError>>, Failure> {
    let Run { campaign, store, process, .. } = run;
    let label = &campaign.config.label;
    let mut labellers = JoinSet::new();
    for slot in 0..label.slots {
        let method = campaign.method()?.load(&campaign.protocol)?;
        let settings = LabellerSettings {
            holder: format!("{}/{slot}", process.id),
            protocol: campaign.protocol.clone(),
            attempts: label.attempts.get(),
            bounds: label.bounds(),
            stay: Stay::UntilEmpty,
            timing: Timing { lease: label.lease.get(), ..Timing::default() },
        };
        let (store, closing) = (store.clone(), Arc::clone(closing));
        labellers.spawn(async move {
            labeller::run(store, method, settings, &closing, unix_milliseconds, |_| ()).await
        });
    }
    Ok(labellers)
}
