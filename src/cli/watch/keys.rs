//! Key bindings.

use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use store::JobState;

use super::super::ExitStatus;
use super::entries::{UNKNOWN_QUANTITIES, without_campaign};
use super::messages::WatchRequest;
use super::state::{
    DECISIONS, InputMode, Prompt, PromptKind, QUEUE, StatusMessage, TextView, WALKS, WatchState,
};
use crate::cli::queue::QueueCommand;
use crate::cli::status;
use crate::cli::walks::{WalkSelectionArgs, WalksCommand};
use crate::filter::StructureFilter;

/// Title of the history of the campaign.
pub const HISTORY: &str = "history of the campaign";

/// The text of F1.
pub const HELP: &str = "\
Tab, 1 2 3       next pane; walks, queue, decisions
↑ ↓, j k         select a line; also PgUp PgDn, Home End (g G)
/                filter the pane, e.g. gamma > 2 and element = Mo (syntax: docs/export.md); Esc removes the filter
Enter            history of the candidate (calmwalk explain); of a walk: its decisions
i                output of calmwalk status --all
h                history of the campaign since its beginning

p, r             pause, resume the selected walk;  P, R  all walks
s                view of the queue: waiting, failed, dropped, labelled
=                change the priority of the selected structure
d                drop it;  t  retry it, if it failed or was dropped

q                quit, or close a text; Ctrl-C quits at once

γ_max is under the current mixture: of a walk, that of its last graded step; of a candidate, that at the decision. γ₀_max is under the
original mixture: of a walk, at the last point of its trace. Filters call them gamma_current and gamma.
Changes are recorded in the operations log, as those by commands. In reproducible mode the other walks of the same round wait for a
paused walk.";

impl WatchState {
    /// Handles a key.
    pub fn key(&mut self, key: KeyEvent) -> Option<WatchRequest> {
        if key.kind == KeyEventKind::Release {
            return None;
        }
        let control = key.modifiers.contains(KeyModifiers::CONTROL);
        if control && key.code == KeyCode::Char('c') {
            return Some(WatchRequest::Quit(ExitStatus::Interrupted));
        }
        self.message = None;
        match std::mem::take(&mut self.mode) {
            InputMode::Panes => self.key_in_panes(key.code),
            InputMode::Text(text) => self.key_in_text(text, key.code),
            InputMode::Prompt(prompt) => self.key_in_prompt(prompt, key.code, control),
            InputMode::Confirm(_, request) => match key.code {
                KeyCode::Char('y' | 'Y') => Some(request),
                _ => {
                    self.message = Some(StatusMessage::Success("cancelled".into()));
                    None
                }
            },
        }
    }

    fn key_in_panes(&mut self, code: KeyCode) -> Option<WatchRequest> {
        match code {
            KeyCode::Char('q') => return Some(WatchRequest::Quit(ExitStatus::Done)),
            KeyCode::Tab => self.focus = (self.focus + 1) % self.panes.len(),
            KeyCode::BackTab => self.focus = (self.focus + self.panes.len() - 1) % self.panes.len(),
            KeyCode::Char('1') => self.focus = WALKS,
            KeyCode::Char('2') => self.focus = QUEUE,
            KeyCode::Char('3') => self.focus = DECISIONS,
            KeyCode::Char('?') | KeyCode::F(1) => self.show("keys", HELP.to_owned()),
            KeyCode::Char('i') => {
                self.show("calmwalk status --all", status::text(&self.snapshot, usize::MAX))
            }
            KeyCode::Char('h') => {
                self.mode = InputMode::Text(TextView { title: HISTORY.to_owned(), ..TextView::default() });
                return Some(WatchRequest::History);
            }
            KeyCode::Char('/') => {
                let text = self.pane().filter.as_ref().map_or(String::new(), ToString::to_string);
                self.mode = InputMode::Prompt(Prompt { kind: PromptKind::Filter, text });
            }
            KeyCode::Esc => self.filter(None),
            KeyCode::Enter => return self.open(),
            KeyCode::Char('p' | 'r' | 'P' | 'R') if self.focus == WALKS => return self.pause(code),
            KeyCode::Char('s') => {
                self.focus = QUEUE;
                self.next_view();
                return Some(WatchRequest::Refresh);
            }
            KeyCode::Char('d' | 't' | '=') if self.focus == QUEUE => self.change(code),
            KeyCode::Char('p' | 'r' | 'P' | 'R') => self.report_wrong_pane("walks", '1'),
            KeyCode::Char('d' | 't' | '=') => self.report_wrong_pane("queue", '2'),
            code => {
                let page = self.pane().page();
                if let Some(lines) = lines(code, page) {
                    self.pane().move_by(lines);
                }
            }
        }
        None
    }

    fn report_wrong_pane(&mut self, pane: &str, key: char) {
        self.message = Some(StatusMessage::Error(format!(
            "this key works only in the pane of the {pane}: press {key} first"
        )));
    }

    fn show(&mut self, title: &str, text: String) {
        self.mode =
            InputMode::Text(TextView { title: title.to_owned(), text: Some(text), ..TextView::default() });
    }

    fn filter(&mut self, filter: Option<StructureFilter>) {
        self.pane().filter = filter;
        self.update_panes();
    }

    /// Opens the history of a candidate, or the decisions of a walk.
    fn open(&mut self) -> Option<WatchRequest> {
        if let Some(walk) = self.walk().filter(|_| self.focus == WALKS) {
            self.focus = DECISIONS;
            // The same filter as if typed.
            self.filter(format!("walk = {walk}").parse().ok());
            return None;
        }
        let Some(id) = self.pane().selected().and_then(|entry| entry.candidate.clone()) else {
            self.message = Some(StatusMessage::Error("no candidate is selected".into()));
            return None;
        };
        self.mode = InputMode::Text(TextView { title: id.clone(), ..TextView::default() });
        Some(WatchRequest::Explain(id))
    }

    fn pause(&mut self, code: KeyCode) -> Option<WatchRequest> {
        let all = matches!(code, KeyCode::Char('P' | 'R'));
        let pauses = matches!(code, KeyCode::Char('p' | 'P'));
        let walks: Vec<u32> = self.walk().filter(|_| !all).into_iter().collect();
        if !all && walks.is_empty() {
            self.message = Some(StatusMessage::Error("no walk is selected".into()));
            return None;
        }
        let selection = WalkSelectionArgs { walks, all };
        let action = if pauses { WalksCommand::Pause(selection) } else { WalksCommand::Resume(selection) };
        let request = WatchRequest::Walks(action);
        if !all {
            return Some(request);
        }
        let what = if pauses { "pause" } else { "resume" };
        self.mode = InputMode::Confirm(format!("{what} all walks that have not ended?"), request);
        None
    }

    fn change(&mut self, code: KeyCode) {
        let Some(job) = self.job() else {
            self.message = Some(StatusMessage::Error("no structure is selected".into()));
            return;
        };
        let (id, state, priority) = (job.candidate.clone(), job.state, job.priority);
        let short = without_campaign(&id).to_owned();
        let is_over = matches!(state, JobState::Failed | JobState::Dropped);
        self.mode = match code {
            KeyCode::Char('d') => InputMode::Confirm(
                format!("drop {short} ({state})? It will not be labelled or exported"),
                WatchRequest::Queue(QueueCommand::Drop { ids: vec![id] }),
            ),
            KeyCode::Char('=') => {
                InputMode::Prompt(Prompt { kind: PromptKind::Priority(id), text: priority.to_string() })
            }
            _ if is_over => InputMode::Confirm(
                format!("queue {short} ({state}) again?"),
                WatchRequest::Queue(QueueCommand::Retry { ids: vec![id] }),
            ),
            _ => {
                let message = format!(
                    "{short} is {state}: only failed or dropped structures can be retried (press s to show them)"
                );
                self.message = Some(StatusMessage::Error(message));
                InputMode::Panes
            }
        };
    }

    fn key_in_text(&mut self, mut text: TextView, code: KeyCode) -> Option<WatchRequest> {
        if matches!(code, KeyCode::Char('q') | KeyCode::Esc | KeyCode::Enter) {
            return None;
        }
        if let Some(lines) = lines(code, text.rows.max(1) as isize) {
            // Limited to the end of the text when drawn.
            text.top = text.top.saturating_add_signed(lines);
        }
        self.mode = InputMode::Text(text);
        None
    }

    fn key_in_prompt(&mut self, mut prompt: Prompt, code: KeyCode, control: bool) -> Option<WatchRequest> {
        match code {
            KeyCode::Esc => return None,
            KeyCode::Enter => return self.submit(prompt),
            KeyCode::Backspace => drop(prompt.text.pop()),
            KeyCode::Char('u') if control => prompt.text.clear(),
            KeyCode::Char(_) if control => {}
            KeyCode::Char(character) => prompt.text.push(character),
            _ => {}
        }
        self.mode = InputMode::Prompt(prompt);
        None
    }

    /// Applies a line of input. If it is invalid, shows the error and lets the user correct it.
    fn submit(&mut self, prompt: Prompt) -> Option<WatchRequest> {
        let text = prompt.text.trim();
        let error = match &prompt.kind {
            PromptKind::Filter if text.is_empty() => {
                self.filter(None);
                return None;
            }
            PromptKind::Filter => match self.parse_filter(text) {
                Ok(filter) => {
                    self.filter(Some(filter));
                    return None;
                }
                Err(error) => error,
            },
            PromptKind::Priority(id) => match text.parse() {
                Ok(priority) => {
                    return Some(WatchRequest::Queue(QueueCommand::Prioritise { id: id.clone(), priority }));
                }
                Err(_) => format!("'{text}' is not a priority: expected an integer (larger values first)"),
            },
        };
        self.message = Some(StatusMessage::Error(error));
        self.mode = InputMode::Prompt(prompt);
        None
    }
}

impl WatchState {
    /// Parses a filter, and checks that the pane has its quantities.
    fn parse_filter(&self, text: &str) -> Result<StructureFilter, String> {
        let filter: StructureFilter = text.parse().map_err(|error| format!("invalid filter: {error}"))?;
        let is_not_known = |name: &&str| UNKNOWN_QUANTITIES[self.focus].contains(name);
        match filter.names().into_iter().find(is_not_known) {
            None => Ok(filter),
            Some(name) => {
                let pane = ["walks", "label jobs", "decisions"][self.focus];
                Err(format!(
                    "{name} is not available for {pane} here: use the dashboard's table or calmwalk export --where"
                ))
            }
        }
    }
}

/// The number of lines by which a key moves.
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
