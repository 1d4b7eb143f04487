//! A scrollable list with a selected entry.

use std::ops::Range;

use crate::filter::StructureFilter;

/// The colour of a line. Its text carries the same information.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Tone {
    /// Default.
    #[default]
    Plain,
    /// Accepted or running.
    Active,
    /// Failed or paused.
    Attention,
    /// Ended.
    Ended,
}

/// A line of a list.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PaneEntry {
    /// Identifies the entry in its list, also after later polls.
    pub key: String,
    /// Columns.
    pub columns: Vec<String>,
    /// Colour.
    pub tone: Tone,
    /// Id of the candidate, if the entry is about one.
    pub candidate: Option<String>,
}

/// The list.
#[derive(Debug, Default)]
pub struct Pane {
    /// Entries that match the filter.
    pub entries: Vec<PaneEntry>,
    /// Number of entries without the filter.
    pub all: usize,
    /// Filter.
    pub filter: Option<StructureFilter>,
    /// Key and last index of the selected entry. `None` selects the first, whichever that is.
    selected: Option<(String, usize)>,
    /// First visible line.
    top: usize,
    /// Number of visible lines.
    rows: usize,
}

impl Pane {
    /// Replaces the entries; `all` is their number without the filter.
    pub fn set_entries(&mut self, entries: Vec<PaneEntry>, all: usize) {
        (self.entries, self.all) = (entries, all);
        if let Some((key, at)) = &mut self.selected
            && let Some(found) = self.entries.iter().position(|entry| entry.key == *key)
        {
            *at = found;
        }
    }

    /// Index of the selected entry.
    pub fn index(&self) -> usize {
        let at = self.selected.as_ref().map_or(0, |(_, at)| *at);
        at.min(self.entries.len().saturating_sub(1))
    }

    /// The selected entry.
    pub fn selected(&self) -> Option<&PaneEntry> {
        self.entries.get(self.index())
    }

    /// Moves the selection down by `lines`, within the list. On the first entry, the selection follows new first entries.
    pub fn move_by(&mut self, lines: isize) {
        let at = self.index().saturating_add_signed(lines).min(self.entries.len().saturating_sub(1));
        self.selected = self.entries.get(at).filter(|_| at > 0).map(|entry| (entry.key.clone(), at));
    }

    /// Height of a page, lines.
    pub fn page(&self) -> isize {
        self.rows.max(1) as isize
    }

    /// The range of visible entries for this number of rows; it contains the selected one.
    pub fn visible(&mut self, rows: usize) -> Range<usize> {
        self.rows = rows;
        let at = self.index();
        self.top = self.top.min(at).max((at + 1).saturating_sub(rows));
        self.top = self.top.min(self.entries.len().saturating_sub(rows));
        self.top..self.entries.len().min(self.top + rows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries(keys: impl IntoIterator<Item = u32>) -> Vec<PaneEntry> {
        keys.into_iter().map(|key| PaneEntry { key: key.to_string(), ..PaneEntry::default() }).collect()
    }

    /// The selected entry and the visible range.
    fn view(pane: &mut Pane, rows: usize) -> (Option<u32>, Range<usize>) {
        let selected = pane.selected().and_then(|entry| entry.key.parse().ok());
        (selected, pane.visible(rows))
    }

    #[test]
    fn a_selected_entry_stays_selected_when_others_come_before_it() {
        let mut pane = Pane::default();
        assert_eq!(view(&mut pane, 3), (None, 0..0));
        pane.move_by(5);
        pane.set_entries(entries((0..10).rev()), 10);
        assert_eq!(view(&mut pane, 4), (Some(9), 0..4));
        // On the first entry, the selection follows the newest.
        pane.set_entries(entries((0..12).rev()), 12);
        assert_eq!(view(&mut pane, 4).0, Some(11));
        pane.move_by(2);
        assert_eq!(view(&mut pane, 4), (Some(9), 0..4));
        pane.set_entries(entries((0..20).rev()), 20);
        assert_eq!((view(&mut pane, 4), pane.index()), ((Some(9), 7..11), 10));
        pane.move_by(isize::MIN);
        assert_eq!(view(&mut pane, 4), (Some(19), 0..4));
        pane.move_by(isize::MAX);
        assert_eq!(view(&mut pane, 4), (Some(0), 16..20));
        // If the selected entry disappears, the next one is selected.
        pane.move_by(-10);
        pane.set_entries(entries((0..20).rev().filter(|key| *key != 10)), 19);
        assert_eq!(view(&mut pane, 4).0, Some(9));
        // A larger terminal shows more entries.
        pane.move_by(isize::MAX);
        assert_eq!(pane.visible(4), 15..19);
        assert_eq!(pane.visible(40), 0..19);
        assert_eq!(pane.page(), 40);
    }
}
