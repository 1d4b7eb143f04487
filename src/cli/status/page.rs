//! How much of a campaign is shown, and how it is laid out.

use std::io::{self, IsTerminal, Write};

use crate::output::Table;

/// Columns of titles.
const TITLE: usize = 12;
/// Columns of a terminal, and of what other programs read.
const WIDTHS: [usize; 2] = [80, usize::MAX];
/// Lines of a screen.
const HEIGHT: usize = 40;
/// Lines of a table besides its rows.
const FRAME: usize = 3;
/// Classes of failures, and parts of the collected space without labels, that are shown on a screen.
const FEW: usize = 2;

/// What is shown.
#[derive(Clone, Copy, Debug)]
pub struct Page {
    /// Most walks.
    pub walks: usize,
    /// Most processes, or jobs.
    pub others: usize,
    /// Most of what stands above them in lines of its own.
    pub few: usize,
    /// Longer lines are broken, or cut if they are those of a table.
    pub width: usize,
}

impl Page {
    /// Everything; as wide as a terminal if the standard output is one.
    pub fn of_all() -> Self {
        let (is_screen, all) = (io::stdout().is_terminal(), usize::MAX);
        Self { walks: all, others: all, few: all, width: WIDTHS[usize::from(!is_screen)] }
    }

    /// Few things of a kind.
    pub fn screen(self) -> Self {
        Self { walks: 0, others: 0, few: FEW, ..self }
    }

    /// Whether nothing is left out.
    pub fn has_all(&self) -> bool {
        self.few == usize::MAX
    }

    /// With as many rows as have room below so many lines, in so many tables; `walks` if that many were asked for.
    pub fn fitted(self, lines: usize, tables: usize, walks: Option<usize>) -> Self {
        let rows = HEIGHT.saturating_sub(lines + tables * FRAME) / tables;
        let rows = if self.has_all() { usize::MAX } else { rows.max(FEW) };
        Self { walks: walks.unwrap_or(rows), others: rows, ..self }
    }

    /// Words behind a title, and below each other where one line does not hold them.
    pub fn titled(&self, out: &mut dyn Write, title: &str, text: &str) -> io::Result<()> {
        let mut line = format!("{title:<TITLE$}");
        let mut is_empty = true;
        for word in text.split(' ') {
            if !is_empty && line.chars().count() + 1 + word.chars().count() > self.width {
                writeln!(out, "{}", line.trim_end())?;
                (line, is_empty) = (" ".repeat(TITLE), true);
            }
            if !std::mem::take(&mut is_empty) {
                line.push(' ');
            }
            line.push_str(word);
        }
        writeln!(out, "{}", line.trim_end())
    }

    /// A table of `shown` of so many things, behind an empty line.
    pub fn table(
        &self,
        out: &mut dyn Write,
        table: &Table,
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
            writeln!(out, "… and {} more {what}: --all shows them", of - shown)?;
        }
        Ok(())
    }
}

/// At most so many characters.
pub fn cut(text: &str, width: usize) -> String {
    if text.chars().count() <= width {
        return text.to_owned();
    }
    text.chars().take(width.saturating_sub(1)).chain(['…']).collect()
}

/// A number of walks to show: `all`, or how many.
pub fn number(text: &str) -> Result<usize, String> {
    match text {
        "all" => Ok(usize::MAX),
        _ => text.parse().map_err(|_| "expected a number, or all".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lines_go_on_below() {
        let page = Page { width: 24, ..Page::of_all() };
        let mut text = Vec::new();
        page.titled(&mut text, "labels", "1 queued, 2 leased, extraordinarily long").unwrap();
        let expected =
            "labels      1 queued, 2\n            leased,\n            extraordinarily\n            long\n";
        assert_eq!(String::from_utf8(text).unwrap(), expected);
        assert_eq!((cut("γγγγ", 3), cut("γγγ", 3)), ("γγ…".into(), "γγγ".into()));
        assert_eq!((number("all"), number("12")), (Ok(usize::MAX), Ok(12)));
        assert!(number("few").is_err());
    }
}
