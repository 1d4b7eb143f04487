//! Drawing: from a state to the cells of a terminal of whatever size.

use std::env;

use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Paragraph, Sparkline};
use store::{Candidates, Labels};

use super::entries;
use super::pane::{Pane, Tone};
use super::state::{DECISIONS, Message, Mode, QUEUE, State, Text, WALKS, WINDOW, Wanted};
use crate::cli::status::page::cut;
use crate::cli::status::walks;
use crate::output::{Table, count, decimals};

/// Lines of the head, with the line below it.
const HEAD: u16 = 5;
/// Lines of a chart: title, two lines of bars, axis.
const CHART: u16 = 4;
/// From this width on, panes stand beside each other.
const WIDE: u16 = 150;
/// Below this height there are no charts.
const LOW: u16 = 20;
/// Below this height there is only the pane that has the keys.
const FLAT: u16 = 14;

/// Columns of a title and the blank behind it, in what commands print.
const TITLE: usize = 13;
/// Columns between two numbers below a histogram, at least.
const TICK: usize = 6;

/// Whether there are colours.
#[derive(Clone, Copy, Debug)]
pub struct Theme {
    /// Without them, words and weights say it.
    pub colours: bool,
}

impl Theme {
    /// See <https://no-color.org>.
    pub fn of_environment() -> Self {
        Self { colours: env::var_os("NO_COLOR").is_none_or(|value| value.is_empty()) }
    }

    /// Cyan and yellow are told apart by everybody.
    fn of(self, tone: Tone) -> Style {
        match (tone, self.colours) {
            (Tone::Good, true) => Style::new().fg(Color::Cyan),
            (Tone::Attention, true) => Style::new().fg(Color::Yellow),
            (Tone::Attention, false) => Style::new().add_modifier(Modifier::BOLD),
            (Tone::Past, _) => Style::new().add_modifier(Modifier::DIM),
            _ => Style::new(),
        }
    }
}

/// Draws everything.
pub fn draw(frame: &mut Frame<'_>, state: &mut State, theme: &Theme) {
    let area = frame.area();
    let [above, message, keys] =
        Layout::vertical([Constraint::Fill(1), Constraint::Length(1), Constraint::Length(1)]).areas(area);
    if let Mode::Text(text) = &mut state.mode {
        draw_text(frame, above, text);
    } else {
        draw_panes(frame, above, state, theme);
    }
    draw_message(frame, message, state, theme);
    frame.render_widget(Paragraph::new(Line::styled(keys_of(state), Modifier::DIM)), keys);
}

fn draw_panes(frame: &mut Frame<'_>, area: Rect, state: &mut State, theme: &Theme) {
    if area.height < FLAT {
        return draw_pane(frame, area, state, state.focus, theme);
    }
    let [head, body] = Layout::vertical([Constraint::Length(HEAD), Constraint::Fill(1)]).areas(area);
    draw_head(frame, head, state);
    let charts = if area.height < LOW { 0 } else { CHART };
    let share = |pane: usize| Constraint::Fill(if pane == state.focus { 3 } else { 2 });
    if area.width < WIDE {
        let rows = [share(WALKS), share(QUEUE), share(DECISIONS), Constraint::Length(charts)];
        let [walks, queue, decisions, charts] = Layout::vertical(rows).areas(body);
        for (pane, area) in [(WALKS, walks), (QUEUE, queue), (DECISIONS, decisions)] {
            draw_pane(frame, area, state, pane, theme);
        }
        return draw_charts(frame, charts, state, theme);
    }
    let [left, right] = Layout::horizontal([Constraint::Fill(1); 2]).spacing(2).areas(body);
    let [walks, decisions] = Layout::vertical([share(WALKS), share(DECISIONS)]).areas(left);
    let [queue, charts] = Layout::vertical([Constraint::Fill(1), Constraint::Length(charts)]).areas(right);
    for (pane, area) in [(WALKS, walks), (QUEUE, queue), (DECISIONS, decisions)] {
        draw_pane(frame, area, state, pane, theme);
    }
    draw_charts(frame, charts, state, theme);
}

fn draw_head(frame: &mut Frame<'_>, area: Rect, state: &State) {
    let (campaign, standing) = (state.snapshot.campaign(), state.snapshot.standing());
    let under_way = standing.walks.iter().filter(|walk| walk.is_active()).count();
    let paused = standing.walks.iter().filter(|walk| walk.paused).count();
    let paused = if paused == 0 { String::new() } else { format!(" ({paused} paused)") };
    let ended = standing.walks.len() - under_way;
    let are = if standing.led { "under way" } else { "not finished" };
    let speed = standing.steps_per_second.filter(|_| under_way > 0);
    let speed = speed.map_or(String::new(), |speed| format!("; {speed:.1} steps/s"));
    let Candidates { seen, accepted, control, .. } = &standing.candidates;
    let Labels { queued, leased, labelled, failed, .. } = &standing.labels;
    let lines = [
        ("campaign", format!("{}, {} mode: {}", campaign.id, campaign.mode, state.snapshot.state())),
        (
            "walks",
            format!(
                "{under_way} {are}{paused}, {ended} ended{speed}; mixture version {}",
                standing.mixture_version
            ),
        ),
        (
            "candidates",
            format!(
                "{seen} seen, {accepted} accepted, {} declined; {}",
                seen - accepted,
                count(*control, "control frame")
            ),
        ),
        (
            "labels",
            format!(
                "{queued} queued, {leased} leased, {labelled} labelled, {failed} failed; {} in the last hour",
                standing.labels_last_hour
            ),
        ),
        ("end", state.snapshot.end().shown().unwrap_or_else(|| "–".into())),
    ];
    let bold = Modifier::BOLD;
    let lines = lines.map(|(title, text)| {
        let text = cut(&text, usize::from(area.width).saturating_sub(12));
        Line::from(vec![Span::styled(format!("{title:<12}"), bold), Span::raw(text)])
    });
    frame.render_widget(Paragraph::new(lines.to_vec()), area);
}

fn draw_pane(frame: &mut Frame<'_>, area: Rect, state: &mut State, place: usize, theme: &Theme) {
    let (name, titles): (_, &[&str]) = match place {
        WALKS => ("walks", &walks::TITLES),
        QUEUE => (state.which.name(), &entries::JOBS),
        _ => ("decisions", &entries::DECISIONS),
    };
    let has_keys = place == state.focus;
    let pane = &mut state.panes[place];
    // Where there is little room, rows are worth more than what their columns are called.
    let titled = u16::from(has_keys || area.height > 4);
    let [title, head, rows] =
        Layout::vertical([Constraint::Length(1), Constraint::Length(titled), Constraint::Fill(1)])
            .areas(area);
    let width = usize::from(area.width);
    let text = cut(&title_of(pane, place, name), width);
    let style = if has_keys { Modifier::REVERSED | Modifier::BOLD } else { Modifier::UNDERLINED };
    frame.render_widget(Paragraph::new(Line::styled(format!("{text:<width$}"), style)), title);
    let (seen, at) = (pane.seen(rows.height.into()), pane.at());
    let mut table = Table::new(titles);
    pane.entries[seen.clone()].iter().for_each(|entry| table.push(entry.columns.clone()));
    let mut text = Vec::new();
    // Memory takes everything.
    let _ = table.write(&mut text);
    let text = String::from_utf8_lossy(&text);
    let mut lines = text.lines().map(|line| cut(line, width));
    let first = Line::styled(lines.next().unwrap_or_default(), Modifier::DIM);
    frame.render_widget(Paragraph::new(first), head);
    let line = |(k, line): (usize, String)| {
        let style = theme.of(pane.entries[k].tone);
        let chosen = has_keys && k == at;
        let style = if chosen { style.add_modifier(Modifier::REVERSED) } else { style };
        Line::styled(if chosen { format!("{line:<width$}") } else { line }, style)
    };
    frame.render_widget(Paragraph::new(seen.zip(lines).map(line).collect::<Vec<_>>()), rows);
}

/// What a pane shows of how much.
fn title_of(pane: &Pane, place: usize, name: &str) -> String {
    let shown = pane.entries.len();
    let number = if pane.all == shown { shown.to_string() } else { format!("{shown} of {}", pane.all) };
    let last = if place == DECISIONS && pane.all == WINDOW { "the last " } else { "" };
    let filter = pane.filter.as_ref().map_or(String::new(), |filter| format!("  where {filter}"));
    format!(" {} {name}: {last}{number}{filter}", place + 1)
}

fn draw_charts(frame: &mut Frame<'_>, area: Rect, state: &State, theme: &Theme) {
    let [left, right] = Layout::horizontal([Constraint::Fill(1); 2]).spacing(2).areas(area);
    let charts = &state.charts;
    let (counts, end) = charts.histogram(left.width.into());
    let spread = charts
        .gamma()
        .map_or(String::new(), |(median, largest)| format!(": median {median:.2}, most {largest:.1}"));
    let title = format!("γ_max of {}{spread}", charts.candidates());
    draw_chart(frame, left, &title, &counts, None, &axis(left.width, end), theme);
    let (shares, group) = charts.acceptances(right.width.into());
    let title = match charts.acceptance() {
        Some((share, of)) => format!("accepted: {} % of the last {of}", decimals(Some(share), 0)),
        None => "accepted: no candidates yet".to_owned(),
    };
    let legend = format!("0 to 100 %, newest right, {group} a column");
    draw_chart(frame, right, &title, &shares, Some(100), &legend, theme);
}

fn draw_chart(
    frame: &mut Frame<'_>,
    area: Rect,
    title: &str,
    values: &[u64],
    most: Option<u64>,
    below: &str,
    theme: &Theme,
) {
    let rows = [Constraint::Length(1), Constraint::Fill(1), Constraint::Length(1)];
    let [head, bars, axis] = Layout::vertical(rows).areas(area);
    let width = usize::from(area.width);
    let title = cut(title, width);
    frame.render_widget(Paragraph::new(Line::styled(format!("{title:<width$}"), Modifier::UNDERLINED)), head);
    let chart = Sparkline::default().data(values.iter().copied()).style(theme.of(Tone::Good));
    frame.render_widget(most.into_iter().fold(chart, Sparkline::max), bars);
    frame.render_widget(Paragraph::new(Line::styled(cut(below, width), Modifier::DIM)), axis);
}

/// Numbers below a histogram from 0 to `end`, at their places.
fn axis(width: u16, end: f64) -> String {
    let width = usize::from(width);
    let mut line = vec![' '; width];
    let ticks = [0.0, 0.25, 0.5, 0.75].map(|share| (share * end, (share * width as f64) as usize));
    let room = if width < 4 * TICK { 1 } else { ticks.len() };
    for (value, at) in ticks.into_iter().take(room) {
        let number = if value.fract() == 0.0 { format!("{value:.0}") } else { format!("{value:.1}") };
        line.iter_mut().skip(at).zip(number.chars()).for_each(|(cell, digit)| *cell = digit);
    }
    let last = format!("{end:.0}+");
    let at = width.saturating_sub(last.len());
    line.iter_mut().skip(at).zip(last.chars()).for_each(|(cell, digit)| *cell = digit);
    line.into_iter().collect()
}

fn draw_text(frame: &mut Frame<'_>, area: Rect, text: &mut Text) {
    let [title, rows] = Layout::vertical([Constraint::Length(1), Constraint::Fill(1)]).areas(area);
    let width = usize::from(area.width);
    let lines: Vec<String> = match &text.text {
        Some(text) => text.lines().flat_map(|line| broken(line, width)).collect(),
        None => vec!["reading …".to_owned()],
    };
    text.rows = rows.height.into();
    text.top = text.top.min(lines.len().saturating_sub(text.rows));
    let last = lines.len().min(text.top + text.rows);
    let place = format!(" {}: lines {} to {last} of {}", text.title, text.top + 1, lines.len());
    let place = format!("{:<width$}", cut(&place, width));
    frame.render_widget(Paragraph::new(Line::styled(place, Modifier::REVERSED)), title);
    let seen = lines[text.top..last].iter().map(|line| Line::raw(line.as_str()));
    frame.render_widget(Paragraph::new(seen.collect::<Vec<_>>()), rows);
}

/// A line in pieces of at most so many columns, broken between words where that can be. What goes on below stands where the line
/// begins, or the text behind its title.
fn broken(line: &str, width: usize) -> Vec<String> {
    let mut rest: Vec<char> = line.chars().collect();
    let blanks = |from: usize| rest[from..].iter().take_while(|c| **c == ' ').count();
    let title = rest.windows(2).take(TITLE).position(|pair| *pair == [' ', ' ']).unwrap_or(0);
    let indent = Some(title + blanks(title)).filter(|indent| *indent <= width / 2).unwrap_or(0);
    let mut pieces = Vec::new();
    while rest.len() > width.max(1) {
        let blank = rest[indent..=width.max(1)].iter().rposition(|c| *c == ' ').map(|at| indent + at);
        let end = blank.filter(|at| *at > indent).unwrap_or(width.max(1));
        let behind = rest.split_off(end);
        pieces.push(std::mem::take(&mut rest).into_iter().collect());
        rest = vec![' '; indent];
        rest.extend(behind.into_iter().skip_while(|c| *c == ' '));
    }
    pieces.push(rest.into_iter().collect());
    pieces
}

fn draw_message(frame: &mut Frame<'_>, area: Rect, state: &State, theme: &Theme) {
    let attention = theme.of(Tone::Attention);
    let width = usize::from(area.width);
    let line = match (&state.mode, &state.message, &state.blind) {
        (_, Some(Message::Failed(why)), _) => Line::styled(cut(why, width), attention),
        (Mode::Confirm(question, _), ..) => {
            Line::styled(cut(&format!("{question}  y: yes, any other key: no"), width), attention)
        }
        (_, Some(Message::Done(done)), _) => Line::styled(cut(done, width), theme.of(Tone::Good)),
        (_, _, Some(why)) => Line::styled(cut(&format!("what you see is old: {why}"), width), attention),
        _ => Line::default(),
    };
    frame.render_widget(Paragraph::new(line), area);
}

/// The last line: what can be done now.
fn keys_of(state: &State) -> String {
    match (&state.mode, state.focus) {
        (Mode::Text(_), _) => "↑↓ PgUp PgDn scroll  q back".to_owned(),
        (Mode::Ask(ask), _) => match &ask.what {
            Wanted::Filter => format!("filter: {}▏", ask.text),
            Wanted::Priority(id) => format!("priority of {}: {}▏", entries::without_campaign(id), ask.text),
        },
        (Mode::Confirm(..), _) => String::new(),
        (Mode::Panes, WALKS) => {
            "Tab pane  / filter  Enter decisions  p pause  r resume  i all  ? keys  q leave".into()
        }
        (Mode::Panes, QUEUE) => {
            "Tab pane  ↑↓  / filter  Enter story  = priority  d drop  t retry  s which  ? keys".into()
        }
        (Mode::Panes, _) => "Tab pane  ↑↓  / filter  Enter story  i all  ? keys  q leave".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lines_are_broken_between_words() {
        assert_eq!(broken("short", 10), ["short"]);
        assert_eq!(broken("  one two three", 9), ["  one two", "  three"]);
        assert_eq!(broken("cost  one two three", 13), ["cost  one two", "      three"]);
        assert_eq!(broken("abcdefghijkl", 5), ["abcde", "fghij", "kl"]);
        assert_eq!(broken("γγγ γγγ", 3), ["γγγ", "γγγ"]);
        assert_eq!(broken("", 0), [""]);
        assert_eq!(broken("ab", 0), ["a", "b"]);
    }

    #[test]
    fn ticks_stand_where_they_belong() {
        assert_eq!(axis(24, 2.0), "0     0.5   1     1.5 2+");
        assert_eq!(axis(5, 8.0), "0  8+");
    }
}
