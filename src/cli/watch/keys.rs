//! What keys do.

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use store::JobState;

use super::super::ExitStatus;
use super::entries::{NOT_KNOWN, without_campaign};
use super::state::{Ask, DECISIONS, Message, Mode, QUEUE, State, Text, WALKS, Wanted};
use crate::cli::queue::Action as QueueAction;
use crate::cli::walks::{Action as WalksAction, Which};
use crate::filter::Filter;

/// What is to be done outside.
#[derive(Clone, Debug, PartialEq)]
pub enum Request {
    /// Stop watching.
    Leave(ExitStatus),
    /// Look at once: something else is to be seen.
    Look,
    /// Read the story of a candidate.
    Story(String),
    /// Change label jobs.
    Queue(QueueAction),
    /// Pause or resume walks.
    Walks(WalksAction),
}

/// The keys, as they are shown by F1.
pub const HELP: &str = "\
Tab, 1 2 3       the next pane; walks, queue, decisions
↑ ↓, j k         choose a line; PgUp PgDn, Home End (g G)
/                filter the pane: gamma > 2 and element = Mo (docs/export.md has the language); Esc shows all again
Enter            the story of the candidate, as calmwalk explain tells it; of a walk: its decisions
i                all that calmwalk status --all shows

p, r             pause, resume the chosen walk;  P, R  all walks
s                the queue: what waits, then what failed, what was dropped, what is labelled
=                give the chosen structure another priority
d                drop it;  t  try it again, if it failed or was dropped

q                leave, or back from a text; Ctrl-C leaves at once

γ_max of walks is that of their last graded step; that of the queue, of decisions and of the distribution is under the
original mixture. What is changed here stands in the operations log, as what is changed by commands. In reproducible mode a paused
walk holds back the others of its round.";

impl State {
    /// Obeys a key.
    pub fn key(&mut self, key: KeyEvent) -> Option<Request> {
        if key.kind == KeyEventKind::Release {
            return None;
        }
        let control = key.modifiers.contains(KeyModifiers::CONTROL);
        if control && key.code == KeyCode::Char('c') {
            return Some(Request::Leave(ExitStatus::Interrupted));
        }
        self.message = None;
        match std::mem::take(&mut self.mode) {
            Mode::Panes => self.in_panes(key.code),
            Mode::Text(text) => self.in_text(text, key.code),
            Mode::Ask(ask) => self.in_line(ask, key.code, control),
            Mode::Confirm(_, request) => match key.code {
                KeyCode::Char('y' | 'Y') => Some(request),
                _ => {
                    self.message = Some(Message::Done("nothing was changed".into()));
                    None
                }
            },
        }
    }

    fn in_panes(&mut self, code: KeyCode) -> Option<Request> {
        match code {
            KeyCode::Char('q') => return Some(Request::Leave(ExitStatus::Done)),
            KeyCode::Tab => self.focus = (self.focus + 1) % self.panes.len(),
            KeyCode::BackTab => self.focus = (self.focus + self.panes.len() - 1) % self.panes.len(),
            KeyCode::Char('1') => self.focus = WALKS,
            KeyCode::Char('2') => self.focus = QUEUE,
            KeyCode::Char('3') => self.focus = DECISIONS,
            KeyCode::Char('?') | KeyCode::F(1) => self.show("keys", HELP.to_owned()),
            KeyCode::Char('i') => self.show("calmwalk status --all", self.snapshot.text(usize::MAX)),
            KeyCode::Char('/') => {
                let text = self.pane().filter.as_ref().map_or(String::new(), ToString::to_string);
                self.mode = Mode::Ask(Ask { what: Wanted::Filter, text });
            }
            KeyCode::Esc => self.filter(None),
            KeyCode::Enter => return self.open(),
            KeyCode::Char('p' | 'r' | 'P' | 'R') if self.focus == WALKS => return self.pause(code),
            KeyCode::Char('s') => {
                self.focus = QUEUE;
                self.next_jobs();
                return Some(Request::Look);
            }
            KeyCode::Char('d' | 't' | '=') if self.focus == QUEUE => self.change(code),
            KeyCode::Char('p' | 'r' | 'P' | 'R') => self.only_in("walks", '1'),
            KeyCode::Char('d' | 't' | '=') => self.only_in("queue", '2'),
            code => {
                let page = self.pane().page();
                if let Some(lines) = lines(code, page) {
                    self.pane().go(lines);
                }
            }
        }
        None
    }

    fn only_in(&mut self, pane: &str, key: char) {
        self.message = Some(Message::Failed(format!("that is for the {pane}: {key} goes there")));
    }

    fn show(&mut self, title: &str, text: String) {
        self.mode = Mode::Text(Text { title: title.to_owned(), text: Some(text), ..Text::default() });
    }

    fn filter(&mut self, filter: Option<Filter>) {
        self.pane().filter = filter;
        self.arrange();
    }

    /// Of a candidate the story, of a walk its decisions.
    fn open(&mut self) -> Option<Request> {
        if let Some(walk) = self.walk().filter(|_| self.focus == WALKS) {
            self.focus = DECISIONS;
            // As somebody would write it.
            self.filter(format!("walk = {walk}").parse().ok());
            return None;
        }
        let Some(id) = self.pane().chosen().and_then(|entry| entry.candidate.clone()) else {
            self.message = Some(Message::Failed("no candidate is chosen here".into()));
            return None;
        };
        self.mode = Mode::Text(Text { title: id.clone(), ..Text::default() });
        Some(Request::Story(id))
    }

    fn pause(&mut self, code: KeyCode) -> Option<Request> {
        let all = matches!(code, KeyCode::Char('P' | 'R'));
        let pauses = matches!(code, KeyCode::Char('p' | 'P'));
        let walks: Vec<u32> = self.walk().filter(|_| !all).into_iter().collect();
        if !all && walks.is_empty() {
            self.message = Some(Message::Failed("no walk is chosen".into()));
            return None;
        }
        let which = Which { walks, all };
        let action = if pauses { WalksAction::Pause(which) } else { WalksAction::Resume(which) };
        let request = Request::Walks(action);
        if !all {
            return Some(request);
        }
        let what = if pauses { "pause" } else { "resume" };
        self.mode = Mode::Confirm(format!("{what} every walk that has more steps to make?"), request);
        None
    }

    fn change(&mut self, code: KeyCode) {
        let Some(job) = self.job() else {
            self.message = Some(Message::Failed("no structure is chosen".into()));
            return;
        };
        let (id, state, priority) = (job.candidate.clone(), job.state, job.priority);
        let short = without_campaign(&id).to_owned();
        let is_over = matches!(state, JobState::Failed | JobState::Dropped);
        self.mode = match code {
            KeyCode::Char('d') => Mode::Confirm(
                format!("drop {short} ({state})? It will not be labelled, and not exported"),
                Request::Queue(QueueAction::Drop { ids: vec![id] }),
            ),
            KeyCode::Char('=') => Mode::Ask(Ask { what: Wanted::Priority(id), text: priority.to_string() }),
            _ if is_over => Mode::Confirm(
                format!("put {short} ({state}) back into the queue?"),
                Request::Queue(QueueAction::Retry { ids: vec![id] }),
            ),
            _ => {
                let message = format!(
                    "{short} is {state}: only what failed or was dropped is tried again (s shows it)"
                );
                self.message = Some(Message::Failed(message));
                Mode::Panes
            }
        };
    }

    fn in_text(&mut self, mut text: Text, code: KeyCode) -> Option<Request> {
        if matches!(code, KeyCode::Char('q') | KeyCode::Esc | KeyCode::Enter) {
            return None;
        }
        if let Some(lines) = lines(code, text.rows.max(1) as isize) {
            // Drawing sees to it that the last lines stay at the bottom.
            text.top = text.top.saturating_add_signed(lines);
        }
        self.mode = Mode::Text(text);
        None
    }

    fn in_line(&mut self, mut ask: Ask, code: KeyCode, control: bool) -> Option<Request> {
        match code {
            KeyCode::Esc => return None,
            KeyCode::Enter => return self.written(ask),
            KeyCode::Backspace => drop(ask.text.pop()),
            KeyCode::Char('u') if control => ask.text.clear(),
            KeyCode::Char(_) if control => {}
            KeyCode::Char(character) => ask.text.push(character),
            _ => {}
        }
        self.mode = Mode::Ask(ask);
        None
    }

    /// Takes in a line that is written; what is wrong with it is said, and it can be mended.
    fn written(&mut self, ask: Ask) -> Option<Request> {
        let text = ask.text.trim();
        let wrong = match &ask.what {
            Wanted::Filter if text.is_empty() => {
                self.filter(None);
                return None;
            }
            Wanted::Filter => match self.condition(text) {
                Ok(condition) => {
                    self.filter(Some(condition));
                    return None;
                }
                Err(why) => why,
            },
            Wanted::Priority(id) => match text.parse() {
                Ok(priority) => {
                    return Some(Request::Queue(QueueAction::Prioritise { id: id.clone(), priority }));
                }
                Err(_) => format!("'{text}' is no priority: expected a whole number, higher first"),
            },
        };
        self.message = Some(Message::Failed(wrong));
        self.mode = Mode::Ask(ask);
        None
    }
}

impl State {
    /// The condition that a text is, if this pane knows everything that it asks for.
    fn condition(&self, text: &str) -> Result<Filter, String> {
        let condition: Filter = text.parse().map_err(|error| format!("no condition: {error}"))?;
        let is_not_known = |name: &&str| NOT_KNOWN[self.focus].contains(name);
        match condition.names().into_iter().find(is_not_known) {
            None => Ok(condition),
            Some(name) => {
                let pane = ["walks", "label jobs", "decisions"][self.focus];
                Err(format!(
                    "{name} is not known of {pane} here: use the dashboard's table, or export --where"
                ))
            }
        }
    }
}

/// How far a key goes.
fn lines(code: KeyCode, page: isize) -> Option<isize> {
    Some(match code {
        KeyCode::Up | KeyCode::Char('k') => -1,
        KeyCode::Down | KeyCode::Char('j') => 1,
        KeyCode::PageUp => -page,
        KeyCode::PageDown | KeyCode::Char(' ') => page,
        KeyCode::Home | KeyCode::Char('g') => isize::MIN,
        KeyCode::End | KeyCode::Char('G') => isize::MAX,
        _ => return None,
    })
}
