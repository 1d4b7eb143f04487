//! A list of which a part is seen, and one entry is chosen.

use std::ops::Range;

use crate::filter::Filter;

/// How a line is shown where there are colours. Its words say the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Tone {
    /// Nothing special.
    #[default]
    Plain,
    /// Accepted, at work.
    Good,
    /// Failed, paused.
    Attention,
    /// Over.
    Past,
}

/// A line of a list.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Entry {
    /// Tells it from all others of its list, also at later looks.
    pub key: String,
    /// Its columns.
    pub columns: Vec<String>,
    /// How it is shown.
    pub tone: Tone,
    /// Name of the candidate that it is about.
    pub candidate: Option<String>,
}

/// The list.
#[derive(Debug, Default)]
pub struct Pane {
    /// Those that meet the condition.
    pub entries: Vec<Entry>,
    /// How many there are with those that do not.
    pub all: usize,
    /// Only those that meet it are shown.
    pub filter: Option<Filter>,
    /// The chosen entry and where it was seen last; none: the first, whichever that is.
    chosen: Option<(String, usize)>,
    /// First line that is seen.
    top: usize,
    /// Lines that are seen.
    rows: usize,
}

impl Pane {
    /// Shows these, out of `all`.
    pub fn show(&mut self, entries: Vec<Entry>, all: usize) {
        (self.entries, self.all) = (entries, all);
        if let Some((key, at)) = &mut self.chosen
            && let Some(found) = self.entries.iter().position(|entry| entry.key == *key)
        {
            *at = found;
        }
    }

    /// Place of the chosen entry.
    pub fn at(&self) -> usize {
        let at = self.chosen.as_ref().map_or(0, |(_, at)| *at);
        at.min(self.entries.len().saturating_sub(1))
    }

    /// The chosen entry.
    pub fn chosen(&self) -> Option<&Entry> {
        self.entries.get(self.at())
    }

    /// Chooses the entry so many lines below; where there is none, the last or the first. Whoever chooses the first sees what
    /// comes before it.
    pub fn go(&mut self, lines: isize) {
        let at = self.at().saturating_add_signed(lines).min(self.entries.len().saturating_sub(1));
        self.chosen = self.entries.get(at).filter(|_| at > 0).map(|entry| (entry.key.clone(), at));
    }

    /// So many lines are seen at once.
    pub fn page(&self) -> isize {
        self.rows.max(1) as isize
    }

    /// The lines that are seen where there is room for so many: the chosen one is among them.
    pub fn seen(&mut self, rows: usize) -> Range<usize> {
        self.rows = rows;
        let at = self.at();
        self.top = self.top.min(at).max((at + 1).saturating_sub(rows));
        self.top = self.top.min(self.entries.len().saturating_sub(rows));
        self.top..self.entries.len().min(self.top + rows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries(keys: impl IntoIterator<Item = u32>) -> Vec<Entry> {
        keys.into_iter().map(|key| Entry { key: key.to_string(), ..Entry::default() }).collect()
    }

    /// What is chosen, and what is seen.
    fn looked(pane: &mut Pane, rows: usize) -> (Option<u32>, Range<usize>) {
        let chosen = pane.chosen().and_then(|entry| entry.key.parse().ok());
        (chosen, pane.seen(rows))
    }

    #[test]
    fn a_chosen_entry_stays_chosen_when_others_come_before_it() {
        let mut pane = Pane::default();
        assert_eq!(looked(&mut pane, 3), (None, 0..0));
        pane.go(5);
        pane.show(entries((0..10).rev()), 10);
        assert_eq!(looked(&mut pane, 4), (Some(9), 0..4));
        // Whoever looks at the newest sees the newest.
        pane.show(entries((0..12).rev()), 12);
        assert_eq!(looked(&mut pane, 4).0, Some(11));
        pane.go(2);
        assert_eq!(looked(&mut pane, 4), (Some(9), 0..4));
        pane.show(entries((0..20).rev()), 20);
        assert_eq!((looked(&mut pane, 4), pane.at()), ((Some(9), 7..11), 10));
        pane.go(isize::MIN);
        assert_eq!(looked(&mut pane, 4), (Some(19), 0..4));
        pane.go(isize::MAX);
        assert_eq!(looked(&mut pane, 4), (Some(0), 16..20));
        // One that is gone leaves its place to the next.
        pane.go(-10);
        pane.show(entries((0..20).rev().filter(|key| *key != 10)), 19);
        assert_eq!(looked(&mut pane, 4).0, Some(9));
        // A larger terminal is filled.
        pane.go(isize::MAX);
        assert_eq!(pane.seen(4), 15..19);
        assert_eq!(pane.seen(40), 0..19);
        assert_eq!(pane.page(), 40);
    }
}
