//! `calmwalk watch`

mod charts;
mod draw;
mod entries;
mod keys;
mod pane;
mod reader;
mod screen;
mod state;
#[cfg(test)]
mod tests;

use std::io::{self, IsTerminal};
use std::thread;
use std::time::Duration;

use ratatui::crossterm::event::{self, Event};
use store::Location;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use self::draw::Theme;
use self::keys::Request;
use self::reader::{Looks, Reader};
use self::screen::Screen;
use self::state::State;
use super::{CampaignLocation, ExitStatus, Failure, block_on, explain, queue, walks};

/// Watch a campaign live in the terminal
///
/// Walks, label queue and recent decisions, which can be filtered, with the distribution of γ and the share of candidates that are
/// accepted. Enter tells the story of a candidate; structures in the queue are dropped, tried again and given other
/// priorities, walks are paused and resumed. F1 or ? shows the keys (docs/watch.md). Works while the campaign runs and after it ended,
/// also on a copy, and disturbs nobody. No colours where NO_COLOR is set.
#[derive(Debug, clap::Args)]
pub struct Watch {
    #[command(flatten)]
    location: CampaignLocation,
    /// Time between two looks, s
    #[arg(long, value_name = "SECONDS", default_value_t = 2.0, value_parser = seconds)]
    every: f64,
}

impl Watch {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let location = self.location.get()?;
        if !io::stdout().is_terminal() {
            return Err(Failure::Input(
                "watch draws on a terminal, and the standard output is none: calmwalk status shows a campaign once, \
                 calmwalk status --json for other programs"
                    .into(),
            ));
        }
        block_on(watch(location, Duration::from_secs_f64(self.every)))?
    }
}

/// Looks, draws and obeys until somebody leaves.
async fn watch(location: Location, every: Duration) -> Result<ExitStatus, Failure> {
    let mut reader = Reader::new(location.clone());
    // What is wrong with it is said on the terminal as it was.
    let mut state = State::new(reader.look(state::Jobs::default()).await?);
    let mut interrupt = signal(SignalKind::interrupt()).map_err(Failure::failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(Failure::failed)?;
    let mut hangup = signal(SignalKind::hangup()).map_err(Failure::failed)?;
    let theme = Theme::of_environment();
    let mut screen = Screen::open()?;
    let (mut looks, mut events, mut orders) = (Looks::begin(reader, every), events(), JoinSet::new());
    loop {
        screen.draw(|frame| draw::draw(frame, &mut state, &theme))?;
        let request = tokio::select! {
            event = events.recv() => match event {
                Some(Event::Key(key)) => state.key(key),
                Some(_) => None,
                None => return Err(Failure::Failed("the terminal is gone".into())),
            },
            seen = looks.next() => match seen {
                Some(seen) => {
                    state.take_in(seen);
                    None
                }
                None => return Err(Failure::Failed("reading the campaign has ended unexpectedly".into())),
            },
            Some(done) = orders.join_next() => {
                state.done(done.map_err(Failure::failed)?);
                looks.now(state.which);
                None
            }
            _ = interrupt.recv() => return Ok(ExitStatus::Interrupted),
            _ = terminate.recv() => return Ok(ExitStatus::Interrupted),
            _ = hangup.recv() => return Ok(ExitStatus::Interrupted),
        };
        match request {
            None => {}
            Some(Request::Leave(ended)) => return Ok(ended),
            Some(Request::Look) => looks.now(state.which),
            Some(request) => drop(orders.spawn(carry_out(location.clone(), request))),
        }
    }
}

/// What came of something that was asked for.
#[derive(Debug, PartialEq)]
pub enum Done {
    /// The story of a candidate, or why there is none.
    Story(String, Result<String, String>),
    /// What was changed, in words, or why it was not.
    Change(Result<String, String>),
}

/// Does as the commands of the same names do.
async fn carry_out(location: Location, request: Request) -> Done {
    let said = |failure: Failure| failure.to_string();
    match request {
        Request::Story(id) => {
            let story = explain::text(location, &id).await.map_err(said);
            Done::Story(id, story)
        }
        Request::Queue(action) => {
            let mut changed = Vec::new();
            let ended = queue::change(&location, &action, &mut changed).await.map_err(said);
            let outcomes = changed.iter().map(|job| queue::outcome(&action, job));
            Done::Change(ended.map(|()| outcomes.collect::<Vec<_>>().join("; ")))
        }
        Request::Walks(action) => {
            let done = walks::change(&location, &action).await.map_err(said);
            Done::Change(done.map(|lines| lines.join("; ")))
        }
        Request::Leave(_) | Request::Look => Done::Change(Ok(String::new())),
    }
}

/// What happens at the terminal, from a thread that waits for it; it ends with the process.
fn events() -> mpsc::Receiver<Event> {
    let (send, events) = mpsc::channel(64);
    thread::spawn(move || {
        while let Ok(event) = event::read() {
            if send.blocking_send(event).is_err() {
                return;
            }
        }
    });
    events
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.2..=3600.0).contains(seconds));
    seconds.ok_or_else(|| "expected 0.2 to 3600".to_owned())
}
