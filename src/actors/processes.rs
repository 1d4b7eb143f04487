//! Walkers and labellers in processes of their own: started, listened to, replaced.
//!
//! Walkers end with this process; labellers go on without it, and the next run adopts them.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use orchestrator::launcher::Children;
use orchestrator::reactor;
use orchestrator::selector::Selector;
use orchestrator::supervisor::Limits;
use store::ProcessRecord;
use tokio::sync::{Notify, mpsc};
use tokio::task::{JoinError, JoinHandle};
use tokio::time::{Sleep, sleep};
use wire::ipc::{Server, Sizes, space_needed};
use wire::mixture::SharedMixture;
use wire::place::Place;

use super::agents::{self, Agents};
use super::crew::{self, Crew};
use super::{
    CHANNEL, ReactorTask, Run, STOPPING, asked_to_stop, start_reactor, starts, stop_when_over, wanted_walkers,
};
use crate::outcome::Failure;

/// What is on its way to the database when everybody is gone may take so long.
const LAST_WORDS: Duration = Duration::from_secs(60);
/// Labellers give their signs of life in the database, which may be busy for a while.
pub const LABELLER_SILENCE: Duration = Duration::from_secs(60);

/// Runs the campaign until it is done or stopped. To be awaited on the main thread: the walkers end with the thread that
/// starts them.
pub async fn work(run: Run<'_>, selector: Selector) -> Result<reactor::Ended, Failure> {
    let place = Place::of(run.directory).map_err(Failure::failed)?;
    let ended = work_in(&place, run, selector).await;
    // Nobody is left who could need it. What cannot be removed now is at the next start.
    let removed = place.remove().map_err(Failure::failed);
    let ended = ended?;
    removed?;
    Ok(ended)
}

async fn work_in(place: &Place, run: Run<'_>, selector: Selector) -> Result<reactor::Ended, Failure> {
    let Run { campaign, store, process, .. } = run;
    let walkers = wanted_walkers(campaign);
    let mixture = Arc::clone(selector.mixture());
    let sizes = Sizes { walkers, message_bytes: campaign.largest_message() };
    let needed =
        SharedMixture::space_needed(&mixture, walkers).map_err(Failure::failed)? + space_needed(&sizes);
    let _prepared = place.prepare(needed).map_err(Failure::failed)?;
    let shared = SharedMixture::create(&place.mixture(), &mixture, walkers);
    let shared = shared.map_err(Failure::failed)?;
    let server = Server::open(place, sizes, session(process)).map_err(Failure::failed)?;

    let (stopping, stop) = asked_to_stop(STOPPING)?;
    let asked = (Arc::clone(&stopping), Arc::clone(&stop));
    stop_when_over(run.over, move || {
        asked.0.store(true, Ordering::Relaxed);
        asked.1.notify_one();
    });
    let limits = Limits {
        silence: campaign.config.run.silence_limit.get(),
        restarts: campaign.config.run.restarts,
        ..Limits::default()
    };
    let line = server.handle();
    let walkers = Children::new(walkers, limits, starts::walker(campaign, line.clone())?);
    let limits = Limits { silence: limits.silence.max(LABELLER_SILENCE), outlives: true, ..limits };
    let labellers = starts::labellers(run, limits).await?;
    let crew = Crew::new(store, process.clone(), line, walkers, labellers, Arc::clone(&stopping));

    let (to_reactor, incoming) = mpsc::channel(CHANNEL);
    let here = server.run(shared, to_reactor.clone(), crew.listener());
    let agents = Agents::open(run, session(process), &mixture).await?;
    let agents_line = agents.handle();
    let elsewhere = agents.run(Arc::clone(&stopping), to_reactor);
    let serving = tokio::spawn(async {
        tokio::try_join!(async { here.await.map_err(Failure::failed) }, elsewhere).map(|_| ())
    });
    let reactor = start_reactor(run, selector, incoming, &stopping);
    lead(crew, reactor, agents_line, serving, &stop).await
}

/// Tells the walkers of this run from those of any other.
fn session(process: &ProcessRecord) -> u64 {
    let hash = blake3::hash(process.id.as_bytes());
    let [a, b, c, d, e, f, g, h, ..] = *hash.as_bytes();
    u64::from_le_bytes([a, b, c, d, e, f, g, h])
}

/// What the leader of a crew has to answer.
enum Happened {
    /// To a process.
    InCrew(crew::Event),
    /// Somebody asked to stop.
    Asked,
    /// The reactor has ended.
    Decided(Result<reactor::Ended, Failure>),
    /// The transport has ended.
    Closed(Result<(), Failure>),
}

/// Leads the crew until all walks are over and every structure has its label, or until somebody asks to stop; then until
/// everybody is gone.
async fn lead(
    mut crew: Crew<'_>,
    mut reactor: ReactorTask,
    agents: agents::Handle,
    mut serving: JoinHandle<Result<(), Failure>>,
    stop: &Notify,
) -> Result<reactor::Ended, Failure> {
    let (mut decided, mut closed, mut asked) = (None, None, false);
    let mut last_words = None;
    while decided.is_none() || closed.is_none() || !crew.is_gone() {
        if asked && decided.is_none() && crew.is_gone() {
            last_words.get_or_insert_with(|| Box::pin(sleep(LAST_WORDS)));
        }
        let happened = tokio::select! {
            () = over(&mut last_words) => return Err(unheard()),
            event = crew.event() => Happened::InCrew(event),
            () = stop.notified() => Happened::Asked,
            ended = &mut reactor, if decided.is_none() => Happened::Decided(plain(ended)),
            ended = &mut serving, if closed.is_none() => Happened::Closed(plain(ended)),
        };
        match happened {
            Happened::InCrew(event) => crew.take_in(event).await,
            Happened::Asked => {
                asked = true;
                crew.stop();
            }
            Happened::Decided(ended) => {
                agents.close();
                match ended {
                    Ok(reactor::Ended::Done) => crew.wait_for_labels(),
                    _ => crew.stop(),
                }
                decided = Some(ended);
            }
            Happened::Closed(ended) => {
                if ended.is_err() {
                    crew.stop();
                }
                closed = Some(ended);
            }
        }
    }
    closed.transpose()?;
    crew.failure()?;
    match decided.transpose()? {
        Some(reactor::Ended::Done) if !asked => Ok(reactor::Ended::Done),
        // Every walk may be over, but the labellers were asked to stop and may have left jobs.
        _ => Ok(reactor::Ended::Stopped),
    }
}

/// The end of a time, if it has begun.
async fn over(time: &mut Option<Pin<Box<Sleep>>>) {
    match time {
        Some(time) => time.await,
        None => std::future::pending().await,
    }
}

fn unheard() -> Failure {
    Failure::Failed(format!(
        "asked to stop, but the database has not answered for {} s: walks are where they were checkpointed last; the same command goes on with the campaign",
        LAST_WORDS.as_secs()
    ))
}

/// A task's own result; a crash is one too.
fn plain<T>(ended: Result<Result<T, impl ToString>, JoinError>) -> Result<T, Failure> {
    ended.map_err(Failure::failed)?.map_err(Failure::failed)
}
