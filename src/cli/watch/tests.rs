use ratatui::Terminal;
use ratatui::backend::TestBackend;
use ratatui::crossterm::event::{KeyCode, KeyEvent, KeyModifiers};
use ratatui::style::{Color, Modifier};
use store::{DecidedCandidate, JobState, QueueEntry, RecentDecision};
use wire::Origin;

use super::draw::{Theme, draw};
use super::messages::{Completed, JobView, Reading, WatchRequest};
use super::state::{DECISIONS, InputMode, QUEUE, StatusMessage, WALKS, WatchState};
use super::*;
use crate::cli::queue::QueueCommand;
use crate::cli::status;

const PLAIN: Theme = Theme { colours: false };

fn job(number: i64, state: JobState) -> QueueEntry {
    QueueEntry {
        excluded: None,
        job: number,
        candidate: format!("07070707-3.0.{number}-0123456789abcdef"),
        protocol: "dft".into(),
        state,
        priority: 10,
        holder: None,
        expires: None,
        attempts: 0,
        failures: 0,
        atoms: 54,
        formula: if number % 2 == 0 { "CMo53" } else { "Mo54" }.into(),
        selector_gamma: Some(1.0 + number as f64 / 20.0),
        original_gamma: Some(1.0 + number as f64 / 10.0),
        original_gamma_nbr: None,
        origin: "biased".into(),
        seed_structure: "bcc-100".into(),
        walk: 3,
        step: number as u64,
        temperature: Some(300.0),
        relative_volume: Some(1.01),
        overruled: false,
        relabel: None,
        value: None,
        value_factors: None,
    }
}

fn decision(sequence: i64) -> RecentDecision {
    let accepted = sequence % 4 == 0;
    let candidate = DecidedCandidate {
        candidate: format!("07070707-3.0.{sequence}-fedcba9876543210"),
        origin: Origin::Biased,
        reason: (!accepted).then(|| "covered".into()),
        step: sequence as u64,
        seed_structure: "bcc-100".into(),
        atoms: 54,
        formula: "Mo54".into(),
        temperature: Some(301.0),
        relative_volume: Some(1.02),
        selector_gamma: Some(1.2),
        original_gamma: Some(1.0 + sequence as f64 / 100.0),
        original_gamma_nbr: Some(1.1),
    };
    RecentDecision {
        sequence,
        kind: if accepted { "accepted" } else { "declined" }.into(),
        walk: Some(3),
        mixture_version: 7,
        detail: serde_json::Value::Null,
        candidate: Some(candidate),
    }
}

fn reading(jobs: Vec<QueueEntry>, decisions: std::ops::Range<i64>) -> Reading {
    Reading {
        snapshot: status::tests::large(),
        view: JobView::Waiting,
        jobs,
        decisions: decisions.rev().map(decision).collect(),
    }
}

fn state() -> WatchState {
    let jobs = vec![job(1, JobState::Leased), job(2, JobState::Queued), job(3, JobState::Queued)];
    WatchState::new(reading(jobs, 1..101))
}

fn press(state: &mut WatchState, keys: &str) -> Option<WatchRequest> {
    let code = |key: &str| match key {
        "Tab" => KeyCode::Tab,
        "Enter" => KeyCode::Enter,
        "Esc" => KeyCode::Esc,
        "Down" => KeyCode::Down,
        "End" => KeyCode::End,
        "Back" => KeyCode::Backspace,
        key => KeyCode::Char(key.chars().next().unwrap()),
    };
    let press = |key| state.key(KeyEvent::new(code(key), KeyModifiers::NONE));
    keys.split(' ').map(press).last().flatten()
}

fn write(state: &mut WatchState, text: &str) {
    for character in text.chars() {
        assert_eq!(state.key(KeyEvent::new(KeyCode::Char(character), KeyModifiers::NONE)), None);
    }
}

fn terminal(state: &mut WatchState, width: u16, height: u16, theme: Theme) -> Terminal<TestBackend> {
    let mut terminal = Terminal::new(TestBackend::new(width, height)).unwrap();
    terminal.draw(|frame| draw(frame, state, &theme)).unwrap();
    terminal
}

fn screen(state: &mut WatchState, width: u16, height: u16) -> String {
    terminal(state, width, height, PLAIN).backend().to_string()
}

#[test]
fn all_panes_fit_a_small_terminal() {
    let mut state = state();
    let text = screen(&mut state, 80, 24);
    for words in [
        "07070707070707070707070707070707, reproducible mode",
        "1 walks: 1000",
        "2 queue: 3",
        "3 decisions: 100",
        "a-lo…re-0",
        "3.0.1-01234567 ",
        "accepted",
        "declined: covered",
        "γ₀_max of 100: median 1.51, max 2.0",
        "accepted: 25 % of the last 100",
        "expected within 30 h",
        "training version 4: epoch 12 of 50; version 3 in force",
        "p pause",
    ] {
        assert!(text.contains(words), "{words}:\n{text}");
    }
}

#[test]
fn a_campaign_in_which_nothing_has_begun_and_a_stopped_one_say_so() {
    let of = |snapshot| Reading { snapshot, ..reading(Vec::new(), 1..1) };
    let mut empty = WatchState::new(of(status::tests::empty()));
    let text = screen(&mut empty, 80, 24);
    for words in [
        "reproducible mode: not running",
        "walks       none yet; mixture version 0",
        "candidates  none yet",
        "labels      none yet",
        "end         –",
        "1 walks: 0",
        "γ₀_max: no candidates yet",
        "accepted: no candidates yet",
    ] {
        assert!(text.contains(words), "{words}:\n{text}");
    }
    let mut stopped = WatchState::new(of(status::tests::stopped()));
    let text = screen(&mut stopped, 80, 24);
    for words in ["walks       2 unfinished; 1 ended; mixture version 9", "stopped", "end         –"] {
        assert!(text.contains(words), "{words}:\n{text}");
    }
}

#[test]
fn terminals_of_every_size_are_supported() {
    for width in [1, 2, 10, 40, 79, 150, 300] {
        for height in [1, 2, 3, 7, 13, 14, 16, 20, 22, 70] {
            let mut state = state();
            for keys in ["1", "G", "2", "3", "i", "q", "?", "q", "2", "d", "n", "/"] {
                press(&mut state, keys);
                screen(&mut state, width, height);
            }
        }
    }
    let text = screen(&mut state(), 200, 40);
    assert!(text.lines().any(|line| line.contains("1 walks") && line.contains("2 queue")), "{text}");
    // Columns are left out so that the others are whole.
    let narrow = screen(&mut state(), 150, 40);
    let titles = narrow.lines().find(|line| line.contains("number  what")).unwrap();
    assert!(titles.contains("γ₀_max") && !titles.contains("V/V₀"), "{narrow}");
    assert!(!narrow.contains("steps/s  "), "{narrow}");
    let flat = screen(&mut state(), 60, 12);
    assert!(flat.contains("1 walks") && !flat.contains("queue:"), "{flat}");
}

#[test]
fn no_color_removes_all_colours() {
    let colours = |theme| {
        let terminal = terminal(&mut state(), 80, 24, theme);
        let cells = terminal.backend().buffer().content.clone();
        cells.iter().filter(|cell| cell.fg != Color::Reset || cell.bg != Color::Reset).count()
    };
    assert_eq!(colours(PLAIN), 0);
    assert!(colours(Theme { colours: true }) > 0);
}

#[test]
fn filters_apply_to_their_pane_and_errors_are_shown() {
    let mut state = state();
    press(&mut state, "2 /");
    write(&mut state, "gamma > 1.1 and element = C");
    assert!(screen(&mut state, 80, 24).contains("filter: gamma > 1.1 and element = C"));
    press(&mut state, "Enter");
    assert_eq!((state.panes[QUEUE].entries.len(), state.panes[QUEUE].all), (1, 3));
    assert!(screen(&mut state, 80, 24).contains("2 queue: 1 of 3  where"), "{}", screen(&mut state, 80, 24));
    // The filter also applies to new entries, and only to this pane.
    state.apply(Ok(reading(vec![job(4, JobState::Queued), job(5, JobState::Queued)], 101..103)));
    assert_eq!((state.panes[QUEUE].entries.len(), state.panes[DECISIONS].entries.len()), (1, 102));
    press(&mut state, "Esc");
    assert_eq!(state.panes[QUEUE].entries.len(), 2);
    press(&mut state, "/");
    write(&mut state, "gamma >");
    press(&mut state, "Enter");
    assert!(matches!(&state.message, Some(StatusMessage::Error(why)) if why.contains("expected a number")));
    write(&mut state, " 1.45");
    press(&mut state, "Enter");
    assert_eq!((state.panes[QUEUE].entries.len(), &state.message), (1, &None));
    // A property that the pane lacks is an error.
    press(&mut state, "Esc /");
    write(&mut state, "max_force > 5");
    press(&mut state, "Enter");
    assert!(
        matches!(&state.message, Some(StatusMessage::Error(why)) if why.contains("max_force is not available for label jobs")),
        "{:?}",
        state.message
    );
    assert_eq!(state.panes[QUEUE].entries.len(), 2);
    press(&mut state, "Esc");
    // Another view is empty until its jobs are read.
    press(&mut state, "Esc");
    assert_eq!((press(&mut state, "s"), state.panes[QUEUE].all), (Some(WatchRequest::Refresh), 0));
    state.apply(Ok(reading(vec![job(4, JobState::Queued)], 103..103)));
    assert_eq!(state.panes[QUEUE].all, 0);
    state.apply(Ok(Reading { view: JobView::Failed, ..reading(vec![job(4, JobState::Failed)], 103..103) }));
    assert!(screen(&mut state, 80, 24).contains("2 failed labels: 1"));
    press(&mut state, "s s s");
    // Enter on a walk shows its decisions.
    press(&mut state, "1 Down Down Down Enter");
    assert_eq!(state.focus, DECISIONS);
    assert_eq!(state.panes[DECISIONS].entries.len(), 102);
    press(&mut state, "1 Down Enter");
    assert_eq!(state.panes[DECISIONS].entries.len(), 0);
}

#[test]
fn irreversible_changes_need_confirmation() {
    let mut state = state();
    press(&mut state, "2 Down");
    assert_eq!(press(&mut state, "d"), None);
    let text = screen(&mut state, 100, 24);
    assert!(text.contains("drop 3.0.2-0123456789abcdef (queued)?") && text.contains("y: yes"), "{text}");
    // New jobs do not change the pending request.
    state.apply(Ok(reading(vec![job(9, JobState::Leased), job(8, JobState::Queued)], 101..101)));
    let id = |number| job(number, JobState::Queued).candidate;
    assert_eq!(press(&mut state, "y"), Some(WatchRequest::Queue(QueueCommand::Drop { ids: vec![id(2)] })));
    assert_eq!(press(&mut state, "d n"), None);
    assert_eq!(state.message, Some(StatusMessage::Success("cancelled".into())));
    assert_eq!(press(&mut state, "t"), None);
    assert!(
        matches!(&state.message, Some(StatusMessage::Error(why)) if why.contains("only failed or dropped"))
    );

    press(&mut state, "g =");
    write(&mut state, "x");
    assert_eq!(press(&mut state, "Enter"), None);
    assert!(
        matches!(&state.message, Some(StatusMessage::Error(why)) if why.contains("'10x' is not a priority"))
    );
    let request = press(&mut state, "Back Back Back - 5 Enter");
    assert_eq!(request, Some(WatchRequest::Queue(QueueCommand::Prioritise { id: id(9), priority: -5 })));

    let walks = |walks: &[u32], all| walks::WalkSelectionArgs { walks: walks.to_vec(), all };
    assert_eq!(press(&mut state, "d"), None);
    press(&mut state, "n");
    let request = press(&mut state, "1 Down p");
    assert_eq!(request, Some(WatchRequest::Walks(walks::WalksCommand::Pause(walks(&[1], false)))));
    assert_eq!(press(&mut state, "R"), None);
    assert_eq!(
        press(&mut state, "y"),
        Some(WatchRequest::Walks(walks::WalksCommand::Resume(walks(&[], true))))
    );
    assert_eq!(press(&mut state, "3 p"), None);
    assert!(
        matches!(&state.message, Some(StatusMessage::Error(why)) if why.contains("the pane of the walks"))
    );
}

#[test]
fn a_history_is_shown_if_its_text_view_is_still_open() {
    let mut state = state();
    let id = job(2, JobState::Queued).candidate;
    assert_eq!(press(&mut state, "2 Down Enter"), Some(WatchRequest::Explain(id.clone())));
    assert!(screen(&mut state, 80, 24).contains("reading …"));
    state.complete(Completed::Text("another".into(), Ok("wrong".into())));
    let lines: Vec<_> = (1..=50).map(|k| format!("line {k}.")).collect();
    state.complete(Completed::Text(id.clone(), Ok(lines.join("\n"))));
    let text = screen(&mut state, 80, 24);
    assert!(text.contains("line 1.") && text.contains(&id) && text.contains("lines 1 to 21 of 50"), "{text}");
    press(&mut state, "End");
    let text = screen(&mut state, 80, 24);
    assert!(text.contains("line 50.") && !text.contains("line 29."), "{text}");
    press(&mut state, "k");
    assert!(screen(&mut state, 80, 24).contains("line 29."), "one line up from the end");
    press(&mut state, "q");
    state.complete(Completed::Text(id, Ok("late".into())));
    assert!(matches!(state.mode, InputMode::Panes));
    assert_eq!(press(&mut state, "q"), Some(WatchRequest::Quit(ExitStatus::Done)));
}

#[test]
fn the_key_h_shows_the_history_of_the_campaign() {
    let mut state = state();
    assert_eq!(press(&mut state, "h"), Some(WatchRequest::History));
    assert!(screen(&mut state, 80, 24).contains("reading …"));
    state.complete(Completed::Text(keys::HISTORY.into(), Ok("accepted  12 34".into())));
    let text = screen(&mut state, 80, 24);
    assert!(text.contains(keys::HISTORY) && text.contains("accepted  12 34"), "{text}");
    press(&mut state, "q");
    assert!(matches!(state.mode, InputMode::Panes));
}

#[test]
fn the_last_state_stays_while_the_campaign_cannot_be_read() {
    let mut state = state();
    state.apply(Err(CommandError::Failed("the server is away".into())));
    let text = screen(&mut state, 80, 24);
    assert!(
        text.contains("outdated, cannot read the campaign: the server is away")
            && text.contains("1 walks: 1000")
    );
    state.apply(Ok(reading(Vec::new(), 101..102)));
    assert!(!screen(&mut state, 80, 24).contains("outdated"));
    assert_eq!((state.focus, state.panes[QUEUE].entries.len()), (WALKS, 0));
    let control_c = KeyEvent::new(KeyCode::Char('c'), KeyModifiers::CONTROL);
    assert_eq!(state.key(control_c), Some(WatchRequest::Quit(ExitStatus::Interrupted)));
}

#[test]
fn the_selected_line_is_visible_without_colours() {
    let terminal = terminal(&mut state(), 80, 24, PLAIN);
    let reversed =
        terminal.backend().buffer().content.iter().filter(|cell| cell.modifier.contains(Modifier::REVERSED));
    assert_eq!(reversed.count(), 160, "title and first line of the focused pane");
}
