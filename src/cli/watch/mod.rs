//! `calmwalk watch`

mod charts;
mod draw;
mod entries;
mod keys;
mod messages;
mod pane;
mod reader;
mod screen;
mod state;
#[cfg(test)]
mod tests;

use std::io::{self, IsTerminal};
use std::thread;

use monitor::history::CampaignHistory;
use ratatui::crossterm::event::{self, Event};
use store::{Location, Store, unix_milliseconds};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use self::draw::Theme;
use self::keys::HISTORY;
use self::messages::{Completed, JobView, WatchRequest};
use self::reader::{CampaignReader, Poller};
use self::screen::Screen;
use self::state::WatchState;
use super::{CampaignArgs, CommandError, ExitStatus, block_on, duration_between, explain, queue, walks};
use crate::duration::Duration;
use crate::wording;

/// Monitor and control a campaign in the terminal
///
/// Shows walks, label queue and recent decisions with filters, the distribution of γ and the acceptance rate of candidates.
/// Press Enter for the history of a candidate. Keys drop, retry and prioritise structures in the queue, and pause and resume
/// walks; F1 or ? lists them (docs/watch.md). Works on running and finished campaigns and on backups, and does not block a run.
/// Set NO_COLOR for output without colours.
#[derive(Debug, clap::Args)]
pub struct WatchArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Refresh interval, such as 500ms
    #[arg(long, value_name = "TIME", default_value_t = Duration::from_seconds(2), value_parser = duration_between("200ms", "1h"))]
    interval: Duration,
}

impl WatchArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let location = self.location.get()?;
        if !io::stdout().is_terminal() {
            return Err(CommandError::Input(
                "standard output is not a terminal: use calmwalk status, or calmwalk status --json for other programs"
                    .into(),
            ));
        }
        block_on(watch(location, self.interval.get()))?
    }
}

/// Polls, draws and handles keys until the user quits.
async fn watch(location: Location, interval: std::time::Duration) -> Result<ExitStatus, CommandError> {
    let mut reader = CampaignReader::new(location.clone());
    // Before the screen opens, so that an error is printed normally.
    let mut state = WatchState::new(reader.poll(JobView::default()).await?);
    let mut interrupt = signal(SignalKind::interrupt()).map_err(CommandError::failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(CommandError::failed)?;
    let mut hangup = signal(SignalKind::hangup()).map_err(CommandError::failed)?;
    let theme = Theme::from_environment();
    let mut screen = Screen::open()?;
    let (mut poller, mut events, mut requests) =
        (Poller::start(reader, interval), terminal_events(), JoinSet::new());
    loop {
        screen.draw(|frame| draw::draw(frame, &mut state, &theme))?;
        let request = tokio::select! {
            event = events.recv() => match event {
                Some(Event::Key(key)) => state.key(key),
                Some(_) => None,
                None => return Err(CommandError::Failed("the terminal was closed".into())),
            },
            reading = poller.next() => match reading {
                Some(reading) => {
                    state.apply(reading);
                    None
                }
                None => return Err(CommandError::Failed("the task that reads the campaign ended unexpectedly".into())),
            },
            Some(completed) = requests.join_next() => {
                state.complete(completed.map_err(CommandError::failed)?);
                poller.poll_now(state.view);
                None
            }
            _ = interrupt.recv() => return Ok(ExitStatus::Interrupted),
            _ = terminate.recv() => return Ok(ExitStatus::Interrupted),
            _ = hangup.recv() => return Ok(ExitStatus::Interrupted),
        };
        match request {
            None => {}
            Some(WatchRequest::Quit(ended)) => return Ok(ended),
            Some(WatchRequest::Refresh) => poller.poll_now(state.view),
            Some(request) => drop(requests.spawn(perform(location.clone(), request))),
        }
    }
}

/// Does what the commands of the same names do.
async fn perform(location: Location, request: WatchRequest) -> Completed {
    let message = |failure: CommandError| failure.to_string();
    match request {
        WatchRequest::Explain(id) => {
            let history = explain::text(location, &id).await.map_err(message);
            Completed::Text(id, history)
        }
        WatchRequest::History => {
            Completed::Text(HISTORY.to_owned(), history(&location).await.map_err(message))
        }
        WatchRequest::Queue(action) => {
            let mut changed = Vec::new();
            let result = queue::change(&location, &action, &mut changed).await.map_err(message);
            let messages = changed.iter().map(|job| queue::message(&action, job));
            Completed::Change(result.map(|()| messages.collect::<Vec<_>>().join("; ")))
        }
        WatchRequest::Walks(action) => {
            let messages = walks::change(&location, &action).await.map_err(message);
            Completed::Change(messages.map(|lines| lines.join("; ")))
        }
        WatchRequest::Quit(_) | WatchRequest::Refresh => Completed::Change(Ok(String::new())),
    }
}

/// The history of the campaign as text.
async fn history(location: &Location) -> Result<String, CommandError> {
    let store = Store::open_read_only(location).await?;
    let history = CampaignHistory::read(&store, unix_milliseconds()).await?;
    store.close().await;
    Ok(wording::history::text(&history))
}

/// Events of the terminal, read by a thread that ends with the process.
fn terminal_events() -> mpsc::Receiver<Event> {
    let (sender, events) = mpsc::channel(64);
    thread::spawn(move || {
        while let Ok(event) = event::read() {
            if sender.blocking_send(event).is_err() {
                return;
            }
        }
    });
    events
}
