//! The errors of one bin: those of the newest structures, and the bound that follows from them.

use std::collections::VecDeque;

use super::ConformalSettings;

/// Cumulative weights that differ by less, relative to the number of structures, are equal.
const SAME_WEIGHT: f64 = 1e-9;

/// The errors of the newest structures in one bin of the grade.
#[derive(Clone, Debug)]
pub struct ConformalWindow {
    settings: ConformalSettings,
    /// By ascending error.
    ascending: Vec<WindowError>,
    /// Numbers of the structures in the window, ascending.
    numbers: VecDeque<u64>,
    /// 1 − the level in force.
    miscoverage: f64,
    /// Shares of the atoms of the newest structures that were not above the bound.
    outcomes: VecDeque<f64>,
    /// See [`Self::threshold`].
    threshold: Option<f64>,
}

/// An error in the window.
#[derive(Clone, Copy, Debug)]
struct WindowError {
    error: f64,
    /// 1 / number of atoms of its structure in this bin.
    weight: f64,
    /// Number of its structure.
    number: u64,
}

impl ConformalWindow {
    /// An empty window.
    pub fn new(settings: ConformalSettings) -> Self {
        Self {
            settings,
            ascending: Vec::new(),
            numbers: VecDeque::new(),
            miscoverage: 1.0 - settings.level,
            outcomes: VecDeque::new(),
            threshold: None,
        }
    }

    /// Number of structures in the window.
    pub fn structures(&self) -> usize {
        self.numbers.len()
    }

    /// Whether more than half of its structures are older than those of `other`, which has as many as it can have.
    pub fn is_outdated_by(&self, other: &Self) -> bool {
        let is_full = other.structures() == other.capacity();
        let middle = self.numbers.get(self.structures() / 2);
        is_full && middle.zip(other.numbers.front()).is_some_and(|(middle, oldest)| middle < oldest)
    }

    /// Largest number of structures.
    fn capacity(&self) -> usize {
        self.settings.window.max(self.settings.least())
    }

    /// Whether the window has enough structures for a bound.
    pub fn is_sufficient(&self) -> bool {
        self.structures() >= self.settings.least()
    }

    /// The level in force: that of the settings, corrected by how often bounds held.
    pub fn level(&self) -> f64 {
        1.0 - self.miscoverage
    }

    /// The bound of the errors of the next structure. `None` with too few structures, or while the level in force is above what
    /// they support.
    pub fn bound(&self) -> Option<f64> {
        self.threshold().filter(|bound| bound.is_finite())
    }

    /// Mean error, in which each structure has weight one. `None` with too few structures.
    pub fn mean(&self) -> Option<f64> {
        let sum: f64 = self.ascending.iter().map(|entry| entry.weight * entry.error).sum();
        self.is_sufficient().then(|| sum / self.structures() as f64)
    }

    /// Mean share of the atoms of a structure whose error was not above the bound from before it came, over the newest structures
    /// with a bound; and their number.
    pub fn coverage(&self) -> Option<(f64, usize)> {
        let counted = self.outcomes.len();
        (counted > 0).then(|| (self.outcomes.iter().sum::<f64>() / counted as f64, counted))
    }

    /// Adds the errors of the next structure's atoms in this bin, which must be finite, after comparing them with the bound from
    /// before. Without errors the structure is not in this bin. `number`: its place in the order of all structures; it rises.
    pub fn learn(&mut self, number: u64, errors: &[f64]) {
        if errors.is_empty() {
            return;
        }
        let settings = self.settings;
        if let Some(bound) = self.threshold() {
            let missed = errors.iter().filter(|error| **error > bound).count() as f64 / errors.len() as f64;
            let corrected = self.miscoverage + settings.step * (1.0 - settings.level - missed);
            // Never below the median: where errors only fall, a bound that is too high is on the safe side.
            self.miscoverage = corrected.min((1.0 - settings.level).max(0.5));
            if bound.is_finite() {
                self.outcomes.push_back(1.0 - missed);
                let more = self.outcomes.len().saturating_sub(settings.counted);
                self.outcomes.drain(..more);
            }
        }
        let weight = 1.0 / errors.len() as f64;
        self.numbers.push_back(number);
        self.ascending.extend(errors.iter().map(|error| WindowError { error: *error, weight, number }));
        if self.structures() > self.capacity()
            && let Some(oldest) = self.numbers.pop_front()
        {
            self.ascending.retain(|entry| entry.number != oldest);
        }
        self.ascending.sort_by(|a, b| a.error.total_cmp(&b.error));
        self.threshold = self.is_sufficient().then(|| self.quantile());
    }

    /// The bound, infinite if the level in force is above what the structures support. `None` with too few structures.
    pub(super) fn threshold(&self) -> Option<f64> {
        self.threshold
    }

    fn quantile(&self) -> f64 {
        let structures = self.structures() as f64;
        let needed = self.level() * (structures + 1.0) - SAME_WEIGHT * structures;
        let mut below = 0.0;
        let reaches = |entry: &&WindowError| {
            below += entry.weight;
            below >= needed
        };
        self.ascending.iter().find(reaches).map_or(f64::INFINITY, |entry| entry.error)
    }
}
