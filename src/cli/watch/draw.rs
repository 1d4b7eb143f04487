//! Draws the state on a terminal of any size.

use std::borrow::Cow;
use std::env;

use monitor::versions::CampaignVersions;
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Paragraph, Sparkline};
use store::Candidates;

use super::entries;
use super::messages::WINDOW;
use super::pane::{Pane, Tone};
use super::state::{DECISIONS, InputMode, PromptKind, QUEUE, StatusMessage, TextView, WALKS, WatchState};
use crate::cli::status as cli_status;
use crate::cli::status::page::cut;
use crate::cli::status::walks;
use crate::output::{self, TextTable, count, decimals};
use crate::wording::versions;

/// Height of the header, without the line about versions of the potential.
const HEADER_HEIGHT: u16 = 5;
/// Height of a chart: title, two lines of bars, axis.
const CHART_HEIGHT: u16 = 4;
/// Minimum width for panes side by side.
const TWO_COLUMN_WIDTH: u16 = 150;
/// Minimum height for charts.
const MIN_HEIGHT_FOR_CHARTS: u16 = 20;
/// Minimum height for more than the focused pane.
const MIN_HEIGHT_FOR_PANES: u16 = 14;

/// Columns that give way where a pane is too narrow for all, first to last.
const LEAST_NEEDED: [&str; 4] = ["steps/s", "V/V₀", "T (K)", "taken"];
/// Width of a title with the following blank in the output of commands.
const TITLE: usize = 13;
/// Minimum width between two numbers below a histogram.
const TICK: usize = 6;

/// Colours of the screen.
#[derive(Clone, Copy, Debug)]
pub struct Theme {
    /// If false, uses text styles only.
    pub colours: bool,
}

impl Theme {
    /// From NO_COLOR, see <https://no-color.org>.
    pub fn from_environment() -> Self {
        Self { colours: env::var_os("NO_COLOR").is_none_or(|value| value.is_empty()) }
    }

    /// The style of a line. Cyan and yellow remain distinct with colour blindness.
    fn style(self, tone: Tone) -> Style {
        match (tone, self.colours) {
            (Tone::Active, true) => Style::new().fg(Color::Cyan),
            (Tone::Attention, true) => Style::new().fg(Color::Yellow),
            (Tone::Attention, false) => Style::new().add_modifier(Modifier::BOLD),
            (Tone::Ended, _) => Style::new().add_modifier(Modifier::DIM),
            _ => Style::new(),
        }
    }
}

/// Draws everything.
pub fn draw(frame: &mut Frame<'_>, state: &mut WatchState, theme: &Theme) {
    let area = frame.area();
    let [above, message, keys] =
        Layout::vertical([Constraint::Fill(1), Constraint::Length(1), Constraint::Length(1)]).areas(area);
    if let InputMode::Text(text) = &mut state.mode {
        draw_text(frame, above, text);
    } else {
        draw_panes(frame, above, state, theme);
    }
    draw_message(frame, message, state, theme);
    frame.render_widget(Paragraph::new(Line::styled(key_hints(state), Modifier::DIM)), keys);
}

fn draw_panes(frame: &mut Frame<'_>, area: Rect, state: &mut WatchState, theme: &Theme) {
    if area.height < MIN_HEIGHT_FOR_PANES {
        return draw_pane(frame, area, state, state.focus, theme);
    }
    let versions = describe_versions(&state.snapshot.versions);
    let height = HEADER_HEIGHT + u16::from(versions.is_some());
    let [head, body] = Layout::vertical([Constraint::Length(height), Constraint::Fill(1)]).areas(area);
    draw_head(frame, head, state, versions);
    let charts = if area.height < MIN_HEIGHT_FOR_CHARTS { 0 } else { CHART_HEIGHT };
    let share = |pane: usize| Constraint::Fill(if pane == state.focus { 3 } else { 2 });
    if area.width < TWO_COLUMN_WIDTH {
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

/// The version in force and the refit under way; `None` in a campaign that has never begun to train one.
fn describe_versions(found: &CampaignVersions) -> Option<String> {
    let in_force = found.in_force().map(|version| versions::in_force(found, version));
    let refit = found.refit.as_ref().map(versions::refit);
    let parts: Vec<_> = refit.into_iter().chain(in_force).collect();
    (!parts.is_empty()).then(|| parts.join("; "))
}

/// `versions`: a line about the versions of the potential.
fn draw_head(frame: &mut Frame<'_>, area: Rect, state: &WatchState, versions: Option<String>) {
    let (campaign, status) = (&state.snapshot.campaign, &state.snapshot.status);
    let under_way = status.walks.iter().filter(|walk| walk.is_active()).count();
    let paused = status.walks.iter().filter(|walk| walk.paused).count();
    let paused = if paused == 0 { String::new() } else { format!(" ({paused} paused)") };
    let ended = status.walks.len() - under_way;
    let state_of_walks = if status.run_active { "running" } else { "unfinished" };
    let speed = status.steps_per_second.filter(|_| under_way > 0);
    let speed = speed.map_or(String::new(), |speed| format!("; {speed:.1} steps/s"));
    let Candidates { seen, accepted, control, .. } = &status.candidates;
    let lines = [
        ("campaign", format!("{}, {} mode: {}", campaign.id, campaign.mode, cli_status::state(status))),
        ("walks", {
            let going = if under_way > 0 {
                format!("{under_way} {state_of_walks}{paused}{speed}; ")
            } else {
                String::new()
            };
            let over = if ended > 0 { format!("{ended} ended; ") } else { String::new() };
            let none = if status.walks.is_empty() { "none yet; " } else { "" };
            format!("{going}{over}{none}mixture version {}", status.mixture_version)
        }),
        (
            "candidates",
            [
                (*seen, format!("{seen} seen")),
                (*seen, format!("{accepted} accepted")),
                (seen - accepted, format!("{} declined", seen - accepted)),
                (*control, count(*control, "control frame")),
                (u64::from(seen + control == 0), "none yet".to_owned()),
            ]
            .into_iter()
            .filter_map(|(number, text)| (number > 0).then_some(text))
            .collect::<Vec<_>>()
            .join(", "),
        ),
        (
            "labels",
            match status.labels_last_hour {
                0 => cli_status::describe_queue(status, false),
                made => {
                    format!("{}; {made} made in the last hour", cli_status::describe_queue(status, false))
                }
            },
        ),
        ("end", cli_status::end(&state.snapshot).unwrap_or_else(|| "–".into())),
    ];
    let lines = lines.into_iter().chain(versions.map(|text| ("potential", text)));
    let bold = Modifier::BOLD;
    let lines = lines.map(|(title, text)| {
        let text = cut(&text, usize::from(area.width).saturating_sub(12));
        Line::from(vec![Span::styled(format!("{title:<12}"), bold), Span::raw(text)])
    });
    frame.render_widget(Paragraph::new(lines.collect::<Vec<_>>()), area);
}

fn draw_pane(frame: &mut Frame<'_>, area: Rect, state: &mut WatchState, index: usize, theme: &Theme) {
    let (name, titles): (_, &[&str]) = match index {
        WALKS => ("walks", &walks::TITLES),
        QUEUE => (state.view.name(), &entries::JOBS),
        _ => ("decisions", &entries::DECISIONS),
    };
    let has_focus = index == state.focus;
    let pane = &mut state.panes[index];
    // In small panes, rows are more useful than column titles.
    let titled = u16::from(has_focus || area.height > 4);
    let [title, head, rows] =
        Layout::vertical([Constraint::Length(1), Constraint::Length(titled), Constraint::Fill(1)])
            .areas(area);
    let width = usize::from(area.width);
    let text = cut(&pane_title(pane, index, name), width);
    let style = if has_focus { Modifier::REVERSED | Modifier::BOLD } else { Modifier::UNDERLINED };
    frame.render_widget(Paragraph::new(Line::styled(format!("{text:<width$}"), style)), title);
    let (visible, selected) = (pane.visible(rows.height.into()), pane.index());
    let mut table = TextTable::new(titles);
    pane.entries[visible.clone()].iter().for_each(|entry| table.push(entry.columns.clone()));
    table.drop_until_it_fits(&LEAST_NEEDED, width);
    let mut text = Vec::new();
    // Writing to memory cannot fail.
    let _ = table.write(&mut text);
    let text = String::from_utf8_lossy(&text);
    let mut lines = text.lines().map(|line| cut(line, width));
    let first = Line::styled(lines.next().unwrap_or_default(), Modifier::DIM);
    frame.render_widget(Paragraph::new(first), head);
    let line = |(k, line): (usize, String)| {
        let style = theme.style(pane.entries[k].tone);
        let is_selected = has_focus && k == selected;
        let style = if is_selected { style.add_modifier(Modifier::REVERSED) } else { style };
        Line::styled(if is_selected { format!("{line:<width$}") } else { line }, style)
    };
    frame.render_widget(Paragraph::new(visible.zip(lines).map(line).collect::<Vec<_>>()), rows);
}

/// The title of a pane, with the numbers of shown and existing entries.
fn pane_title(pane: &Pane, index: usize, name: &str) -> String {
    let shown = pane.entries.len();
    let number = if pane.all == shown { shown.to_string() } else { format!("{shown} of {}", pane.all) };
    let last = if index == DECISIONS && pane.all == WINDOW { "last " } else { "" };
    let filter = pane.filter.as_ref().map_or(String::new(), |filter| format!("  where {filter}"));
    format!(" {} {name}: {last}{number}{filter}", index + 1)
}

fn draw_charts(frame: &mut Frame<'_>, area: Rect, state: &WatchState, theme: &Theme) {
    let [left, right] = Layout::horizontal([Constraint::Fill(1); 2]).spacing(2).areas(area);
    let charts = &state.charts;
    let (counts, end) = charts.histogram(left.width.into());
    let spread = charts
        .gamma()
        .map_or(String::new(), |(median, largest)| format!(": median {median:.2}, max {largest:.1}"));
    let title = match charts.candidates() {
        0 => "γ₀_max: no candidates yet".to_owned(),
        candidates => format!("γ₀_max of {candidates}{spread}"),
    };
    draw_chart(frame, left, &title, &counts, None, &axis(left.width, end), theme);
    let (shares, group) = charts.acceptance_history(right.width.into());
    let title = match charts.acceptance() {
        Some((share, of)) => format!("accepted: {} % of the last {of}", decimals(Some(share), 0)),
        None => "accepted: no candidates yet".to_owned(),
    };
    let legend = format!("0 to 100 %, newest right, {group} per column");
    draw_chart(frame, right, &title, &shares, Some(100), &legend, theme);
}

fn draw_chart(
    frame: &mut Frame<'_>,
    area: Rect,
    title: &str,
    values: &[u64],
    max: Option<u64>,
    below: &str,
    theme: &Theme,
) {
    let rows = [Constraint::Length(1), Constraint::Fill(1), Constraint::Length(1)];
    let [head, bars, axis] = Layout::vertical(rows).areas(area);
    let width = usize::from(area.width);
    let title = cut(title, width);
    frame.render_widget(Paragraph::new(Line::styled(format!("{title:<width$}"), Modifier::UNDERLINED)), head);
    let chart = Sparkline::default().data(values.iter().copied()).style(theme.style(Tone::Active));
    frame.render_widget(max.into_iter().fold(chart, Sparkline::max), bars);
    frame.render_widget(Paragraph::new(Line::styled(cut(below, width), Modifier::DIM)), axis);
}

/// The axis labels of a histogram from 0 to `end`.
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

fn draw_text(frame: &mut Frame<'_>, area: Rect, text: &mut TextView) {
    let [title, rows] = Layout::vertical([Constraint::Length(1), Constraint::Fill(1)]).areas(area);
    let width = usize::from(area.width);
    let lines: Vec<Cow<'_, str>> = match &text.text {
        Some(text) => text.lines().flat_map(|line| wrap(line, width)).collect(),
        None => vec!["reading …".into()],
    };
    text.rows = rows.height.into();
    text.top = text.top.min(lines.len().saturating_sub(text.rows));
    let last = lines.len().min(text.top + text.rows);
    let position = format!(" {}: lines {} to {last} of {}", text.title, text.top + 1, lines.len());
    let position = format!("{:<width$}", cut(&position, width));
    frame.render_widget(Paragraph::new(Line::styled(position, Modifier::REVERSED)), title);
    let seen = lines[text.top..last].iter().map(|line| Line::raw(&**line));
    frame.render_widget(Paragraph::new(seen.collect::<Vec<_>>()), rows);
}

/// Wraps a line at `width` columns, between words if possible. Continuation lines are indented like the line, or like the text
/// after its title.
fn wrap(line: &str, width: usize) -> Vec<Cow<'_, str>> {
    let title = line.char_indices().take(TITLE).find(|(at, _)| line[*at..].starts_with("  "));
    let (title, text) = line.split_at(title.map_or(0, |(at, _)| at));
    let blanks = text.chars().take_while(|c| *c == ' ').count();
    let indent = title.chars().count() + blanks;
    let indent = " ".repeat(if indent <= width / 2 { indent } else { 0 });
    textwrap::wrap(line, output::wrapped(width.max(1)).subsequent_indent(&indent))
}

fn draw_message(frame: &mut Frame<'_>, area: Rect, state: &WatchState, theme: &Theme) {
    let attention = theme.style(Tone::Attention);
    let width = usize::from(area.width);
    let line = match (&state.mode, &state.message, &state.read_error) {
        (_, Some(StatusMessage::Error(error)), _) => Line::styled(cut(error, width), attention),
        (InputMode::Confirm(question, _), ..) => {
            Line::styled(cut(&format!("{question}  y: yes, any other key: no"), width), attention)
        }
        (_, Some(StatusMessage::Success(text)), _) => {
            Line::styled(cut(text, width), theme.style(Tone::Active))
        }
        (_, _, Some(error)) => {
            Line::styled(cut(&format!("outdated, cannot read the campaign: {error}"), width), attention)
        }
        _ => Line::default(),
    };
    frame.render_widget(Paragraph::new(line), area);
}

/// The last line: the available keys, or the prompt.
fn key_hints(state: &WatchState) -> String {
    match (&state.mode, state.focus) {
        (InputMode::Text(_), _) => "↑↓ PgUp PgDn scroll  q back".to_owned(),
        (InputMode::Prompt(prompt), _) => match &prompt.kind {
            PromptKind::Filter => format!("filter: {}▏", prompt.text),
            PromptKind::Priority(id) => {
                format!("priority of {}: {}▏", entries::without_campaign(id), prompt.text)
            }
        },
        (InputMode::Confirm(..), _) => String::new(),
        (InputMode::Panes, WALKS) => {
            "Tab pane  / filter  Enter decisions  p pause  r resume  h history  ? keys  q quit".into()
        }
        (InputMode::Panes, QUEUE) => {
            "Tab pane  ↑↓  / filter  Enter open  = priority  d drop  t retry  s view  ? keys".into()
        }
        (InputMode::Panes, _) => {
            "Tab pane  ↑↓  / filter  Enter open  h history  i all  ? keys  q quit".into()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lines_are_wrapped_between_words() {
        assert_eq!(wrap("short", 10), ["short"]);
        assert_eq!(wrap("  one two three", 9), ["  one two", "  three"]);
        assert_eq!(wrap("cost  one two three", 13), ["cost  one two", "      three"]);
        assert_eq!(wrap("abcdefghijkl", 5), ["abcde", "fghij", "kl"]);
        assert_eq!(wrap("γγγ γγγ", 3), ["γγγ", "γγγ"]);
        assert_eq!(wrap("", 0), [""]);
        assert_eq!(wrap("ab", 0), ["a", "b"]);
    }

    #[test]
    fn axis_labels_are_at_their_positions() {
        assert_eq!(axis(24, 2.0), "0     0.5   1     1.5 2+");
        assert_eq!(axis(5, 8.0), "0  8+");
    }
}
