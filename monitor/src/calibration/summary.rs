//! A calibration as plain values: for views, for JSON, and for structures of other programs.

use analysis::{ConformalMap, ConformalWindow, RollingCoverage};
use serde::{Deserialize, Serialize};

use super::CalibrationState;

/// The bounds of a version.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct CalibrationSummary {
    /// Number of the version.
    pub version: u32,
    /// From labels of structures in the order in which they were found.
    pub found: CalibrationMap,
    /// From labels of structures that the queue chose by value; `None` without such labels.
    pub by_value: Option<CalibrationMap>,
}

/// Bounds of the force error by γ_nbr.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct CalibrationMap {
    /// Share of errors that are to be below the bound.
    pub level: f64,
    /// Fewest structures of a bin with a bound.
    pub least_structures: usize,
    /// Largest number of structures of a bin: the newest.
    pub window_structures: usize,
    /// Labelled structures.
    pub structures: u64,
    /// Over the newest structures with a bound; `None` without any.
    pub coverage: Option<CalibrationCoverage>,
    /// Bins with data: first those of all atoms, then those of each element.
    pub bins: Vec<CalibrationBin>,
}

/// How often bounds from before a structure's label came held.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
pub struct CalibrationCoverage {
    /// Mean share of a structure's atoms with a bound.
    pub share: f64,
    /// Number of structures.
    pub structures: usize,
    /// Mean share of a structure's atoms without a bound, over all structures since the oldest of these; of a bin 0.
    pub unbounded: f64,
}

/// One bin of γ_nbr.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
pub struct CalibrationBin {
    /// The element; `None` for all atoms.
    pub element: Option<String>,
    /// Lower edge; `None` for the first bin.
    pub above: Option<f64>,
    /// Upper edge, inclusive; `None` for the last bin.
    pub up_to: Option<f64>,
    /// Structures that the bound follows from.
    pub structures: usize,
    /// The bound of |ΔF|, eV/Å. `None` with too few structures, or while the level in force is above what they support.
    pub bound: Option<f64>,
    /// Expected |ΔF|, eV/Å. `None` with too few structures.
    pub mean: Option<f64>,
    /// The level that has made bounds hold as often as they should.
    pub level_in_force: f64,
    /// How often the bounds of this bin held.
    pub coverage: Option<CalibrationCoverage>,
    /// Whether the bin has enough structures, and its bounds count for structures without a label, not those of the other map.
    pub in_use: bool,
}

impl CalibrationState {
    /// Its values.
    pub fn summary(&self) -> CalibrationSummary {
        let found = CalibrationMap::new(&self.found, |bin| !self.is_by_value(bin));
        let by_value = (self.by_value.structures() > 0)
            .then(|| CalibrationMap::new(&self.by_value, |bin| self.is_by_value(bin)));
        CalibrationSummary { version: self.version, found, by_value }
    }
}

impl CalibrationSummary {
    /// The bound of |ΔF|, eV/Å, of an atom of this element with this γ_nbr, from labels as found or by value, whichever count in its
    /// bin. `None` without enough of them.
    pub fn bound(&self, gamma_nbr: f64, element: &str) -> Option<f64> {
        self.maps().find_map(|map| map.bound(gamma_nbr, element))
    }

    /// The bins of all atoms that are in use, by ascending γ_nbr, and whether each is of labels by value.
    pub fn pooled(&self) -> Vec<(&CalibrationBin, bool)> {
        let found = self.found.pooled().map(|bin| (bin, false));
        let by_value = self.by_value.iter().flat_map(CalibrationMap::pooled).map(|bin| (bin, true));
        let mut bins: Vec<_> = found.chain(by_value).filter(|(bin, _)| bin.in_use).collect();
        let edge = |bin: &CalibrationBin| bin.above.unwrap_or(f64::NEG_INFINITY);
        bins.sort_by(|(a, _), (b, _)| edge(a).total_cmp(&edge(b)));
        bins
    }

    /// The map of labels by value, if there are any and it is asked for; otherwise that of labels as found.
    pub fn map(&self, by_value: bool) -> &CalibrationMap {
        self.by_value.as_ref().filter(|_| by_value).unwrap_or(&self.found)
    }

    /// Number of structures with a label.
    pub fn structures(&self) -> u64 {
        self.maps().map(|map| map.structures).sum()
    }

    fn maps(&self) -> impl Iterator<Item = &CalibrationMap> {
        [&self.found].into_iter().chain(&self.by_value)
    }
}

impl CalibrationMap {
    fn new(map: &ConformalMap<&'static str>, is_in_use: impl Fn(usize) -> bool) -> Self {
        let settings = map.settings();
        let bin = |(element, index, window): (Option<&&str>, usize, &ConformalWindow)| {
            let (above, up_to) = map.bins().edges(index);
            CalibrationBin {
                element: element.map(|element| (*element).to_owned()),
                above,
                up_to,
                structures: window.structures(),
                bound: window.bound(),
                mean: window.mean(),
                level_in_force: window.level(),
                coverage: window.coverage().map(|(share, structures)| CalibrationCoverage {
                    share,
                    structures,
                    unbounded: 0.0,
                }),
                in_use: is_in_use(index) && window.is_sufficient(),
            }
        };
        let coverage = |RollingCoverage { share, structures, unbounded }| CalibrationCoverage {
            share,
            structures,
            unbounded,
        };
        Self {
            level: settings.level,
            least_structures: settings.least(),
            window_structures: settings.window,
            structures: map.structures(),
            coverage: map.coverage().map(coverage),
            bins: map.windows().map(bin).collect(),
        }
    }

    /// The bound of a bin in use. `None` without enough labels in it.
    fn bound(&self, gamma_nbr: f64, element: &str) -> Option<f64> {
        let holds = |bin: &&CalibrationBin| {
            gamma_nbr.is_finite()
                && bin.in_use
                && bin.structures >= self.least_structures
                && bin.above.is_none_or(|edge| gamma_nbr > edge)
                && bin.up_to.is_none_or(|edge| gamma_nbr <= edge)
        };
        let of = |element: Option<&str>| {
            self.bins.iter().filter(holds).find(|bin| bin.element.as_deref() == element)
        };
        of(Some(element)).or_else(|| of(None))?.bound
    }

    /// The bins of all atoms.
    pub fn pooled(&self) -> impl Iterator<Item = &CalibrationBin> {
        self.bins.iter().filter(|bin| bin.element.is_none())
    }

    /// The elements with bins of their own, in alphabetical order. With a single one they say what the bins of all atoms do.
    pub fn elements(&self) -> Vec<&str> {
        let mut elements: Vec<_> = self.bins.iter().filter_map(|bin| bin.element.as_deref()).collect();
        elements.dedup();
        elements
    }

    /// The bins that say something of their own: those of all atoms, and of the elements if there are several.
    pub fn distinct_bins(&self) -> impl Iterator<Item = &CalibrationBin> {
        let several = self.elements().len() > 1;
        self.bins.iter().filter(move |bin| several || bin.element.is_none())
    }
}
