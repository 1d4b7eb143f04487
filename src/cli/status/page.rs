//! Layout of `calmwalk status`: how much is shown, and how wide.

use std::collections::HashSet;
use std::io::{self, IsTerminal, Write};

use ratatui::crossterm::terminal;

use crate::output::{self, TextTable};

/// Width of titles, columns.
const TITLE: usize = 12;
/// Least width of the output on a terminal.
const WIDTH: usize = 80;
/// Most characters of a name, unless everything is shown.
const LONGEST_NAME: usize = 30;
/// Height of a screen, lines.
const HEIGHT: usize = 40;
/// Lines of a table without its rows.
const FRAME: usize = 3;
/// Failure classes, and groups of structures without labels, shown on a screen.
const FEW: usize = 2;

/// Limits of the output.
#[derive(Clone, Copy, Debug)]
pub struct StatusLayout {
    /// Maximum number of walks.
    pub walks: usize,
    /// Maximum number of processes, and of jobs.
    pub others: usize,
    /// Maximum number of lines of each list above the tables.
    pub few: usize,
    /// Longer lines are wrapped; rows of a table are cut.
    pub width: usize,
}

impl StatusLayout {
    /// No limits, except for the width of a terminal.
    pub fn unlimited() -> Self {
        let all = usize::MAX;
        let width = match io::stdout().is_terminal() {
            true => terminal::size().map_or(WIDTH, |(columns, _)| WIDTH.max(columns.into())),
            false => all,
        };
        Self { walks: all, others: all, few: all, width }
    }

    /// Limits for the lists above the tables; [`StatusLayout::fitted`] sets those of the tables.
    pub fn screen(self) -> Self {
        Self { walks: 0, others: 0, few: FEW, ..self }
    }

    /// Whether everything is shown.
    pub fn is_unlimited(&self) -> bool {
        self.few == usize::MAX
    }

    /// Limits that let `tables` tables fit on the screen below `lines` lines. `walks` overrides the number of walks.
    pub fn fitted(self, lines: usize, tables: usize, walks: Option<usize>) -> Self {
        let rows = HEIGHT.saturating_sub(lines + tables * FRAME) / tables;
        let rows = if self.is_unlimited() { usize::MAX } else { rows.max(FEW) };
        Self { walks: walks.unwrap_or(rows), others: rows, ..self }
    }

    /// Writes a title and a text, wrapped to the width.
    pub fn titled(&self, out: &mut dyn Write, title: &str, text: &str) -> io::Result<()> {
        let (title, indent) = (format!("{title:<TITLE$}"), " ".repeat(TITLE));
        let options = output::wrapped(self.width).initial_indent(&title).subsequent_indent(&indent);
        for line in textwrap::wrap(text, options.break_words(false)) {
            writeln!(out, "{}", line.trim_end())?;
        }
        Ok(())
    }

    /// Writes a table with `shown` of `of` rows, after an empty line.
    pub fn table(
        &self,
        out: &mut dyn Write,
        table: &TextTable,
        shown: usize,
        of: usize,
        what: &str,
    ) -> io::Result<()> {
        let mut text = Vec::new();
        table.write(&mut text)?;
        writeln!(out)?;
        for line in String::from_utf8_lossy(&text).lines() {
            writeln!(out, "{}", cut(line, self.width))?;
        }
        if shown < of {
            writeln!(out, "… and {} more {what} (use --all)", of - shown)?;
        }
        Ok(())
    }
}

/// Cuts a text to at most `width` characters.
pub fn cut(text: &str, width: usize) -> String {
    if text.chars().count() <= width {
        return text.to_owned();
    }
    text.chars().take(width.saturating_sub(1)).chain(['…']).collect()
}

/// Leaves out the middle of a text of more than `width` characters: names often differ at their ends.
pub fn cut_middle(text: &str, width: usize) -> String {
    let length = text.chars().count();
    if length <= width {
        return text.to_owned();
    }
    let last = width.saturating_sub(1) / 2;
    let first = width.saturating_sub(1 + last);
    text.chars().take(first).chain(['…']).chain(text.chars().skip(length - last)).collect()
}

/// The least width from `least` on at which [`cut_middle`] leaves different names different.
pub fn name_width<'a>(names: impl Iterator<Item = &'a str>, least: usize) -> usize {
    let names: HashSet<&str> = names.collect();
    let differ = |width: &usize| {
        names.iter().map(|name| cut_middle(name, *width)).collect::<HashSet<_>>().len() == names.len()
    };
    (least..LONGEST_NAME).find(differ).unwrap_or(LONGEST_NAME)
}

/// Parses the number of walks to show: a number, or `all`.
pub fn parse_walks(text: &str) -> Result<usize, String> {
    match text {
        "all" => Ok(usize::MAX),
        _ => text.parse().map_err(|_| "expected a number, or all".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lines_are_wrapped() {
        let page = StatusLayout { width: 24, ..StatusLayout::unlimited() };
        let mut text = Vec::new();
        page.titled(&mut text, "labels", "1 queued, 2 leased, extraordinarily long").unwrap();
        let expected =
            "labels      1 queued, 2\n            leased,\n            extraordinarily\n            long\n";
        assert_eq!(String::from_utf8(text).unwrap(), expected);
        assert_eq!((cut("γγγγ", 3), cut("γγγ", 3)), ("γγ…".into(), "γγγ".into()));
        assert_eq!((cut_middle("abcdefgh", 5), cut_middle("abc", 3)), ("ab…gh".into(), "abc".into()));
        let names = ["slab-100-vacancy", "slab-110-vacancy"];
        assert_eq!(name_width(names.into_iter(), 6), 14);
        assert_ne!(cut_middle(names[0], 14), cut_middle(names[1], 14));
        assert_eq!((parse_walks("all"), parse_walks("12")), (Ok(usize::MAX), Ok(12)));
        assert!(parse_walks("few").is_err());
    }
}
