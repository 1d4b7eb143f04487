//! The units that a bootstrap draws, and estimates with intervals.

use std::collections::BTreeSet;

use analysis::{BinnedErrors, Bins, Bootstrap};
use serde::Serialize;

use super::super::LARGE_FORCE_ERROR;
use super::super::frames::FramePlace;

/// Least number of units for intervals: fewer say too little about how they differ.
pub const MIN_UNITS: usize = 10;

/// An estimate with its confidence interval.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ConfidenceEstimate {
    /// The estimate; `None` where it is not defined.
    pub value: Option<f64>,
    /// The interval; `None` without units for one.
    pub interval: Option<(f64, f64)>,
}

/// What a bootstrap draws, each with all that belongs to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ResampledUnit {
    /// Seed structures, with all walks from them.
    SeedStructures,
    /// Biased walks, each with its control walk.
    Walks,
}

/// How many units a group of structures has, and which of them a bootstrap draws.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct ResamplingUnits {
    /// Seed structures if there are [`MIN_UNITS`] of them; otherwise walks if there are as many; otherwise there are no intervals.
    pub resampled: Option<ResampledUnit>,
    /// Number of seed structures.
    pub seed_structures: usize,
    /// Number of walks: a biased walk and its control walk are one.
    pub walks: usize,
}

/// The units of a group of structures, numbered.
pub(super) struct NumberedUnits {
    pub summary: ResamplingUnits,
    /// The seed structures or walks, ascending; empty without intervals.
    numbers: Vec<u32>,
}

impl NumberedUnits {
    pub fn new(places: impl Iterator<Item = FramePlace>) -> Self {
        let (mut seed_structures, mut walks) = (BTreeSet::new(), BTreeSet::new());
        for place in places {
            seed_structures.insert(place.seed_structure);
            walks.insert(place.walk);
        }
        let resampled = match (seed_structures.len() >= MIN_UNITS, walks.len() >= MIN_UNITS) {
            (true, _) => Some(ResampledUnit::SeedStructures),
            (false, true) => Some(ResampledUnit::Walks),
            (false, false) => None,
        };
        let numbers: Vec<u32> = match resampled {
            Some(ResampledUnit::SeedStructures) => seed_structures.iter().copied().collect(),
            Some(ResampledUnit::Walks) => walks.iter().copied().collect(),
            None => Vec::new(),
        };
        let (seed_structures, walks) = (seed_structures.len(), walks.len());
        Self { summary: ResamplingUnits { resampled, seed_structures, walks }, numbers }
    }

    /// The unit of a structure; 0 without intervals.
    pub fn unit(&self, place: FramePlace) -> u32 {
        let number = match self.summary.resampled {
            Some(ResampledUnit::SeedStructures) => place.seed_structure,
            _ => place.walk,
        };
        self.numbers.binary_search(&number).unwrap_or(0) as u32
    }

    /// Number of units with multiplicities, at least one.
    fn count(&self) -> usize {
        self.numbers.len().max(1)
    }

    /// Each statistic of all structures, and its interval from those of the draws. Both get multiplicities of units and return the
    /// same statistics.
    pub fn estimates(
        &self,
        bootstrap: Bootstrap,
        whole: impl Fn(&[u32]) -> Vec<Option<f64>>,
        drawn: impl Fn(&[u32]) -> Vec<Option<f64>> + Sync,
    ) -> Vec<ConfidenceEstimate> {
        let values = whole(&vec![1; self.count()]);
        let intervals = match self.summary.resampled {
            Some(_) => {
                let bootstrap = bootstrap.expanded(self.count());
                bootstrap.intervals(|draw| drawn(&bootstrap.multiplicities(draw, self.count())))
            }
            None => vec![None; values.len()],
        };
        let estimate =
            |(value, interval): (Option<f64>, _)| ConfidenceEstimate { value, interval: value.and(interval) };
        values.into_iter().zip(intervals).map(estimate).collect()
    }
}

/// Values of units, sorted once for the medians of all draws.
pub(super) fn sorted_values(values: impl IntoIterator<Item = (f64, u32)>) -> BinnedErrors {
    let items = values.into_iter().map(|(value, unit)| (0.0, value, unit));
    BinnedErrors::new(&Bins::new(&[]), LARGE_FORCE_ERROR, items)
}

/// Their median if every unit is there as often as its multiplicity.
pub(super) fn median(values: &BinnedErrors, multiplicities: &[u32]) -> Option<f64> {
    values.statistics(multiplicities).first().and_then(|all| all.median)
}

/// The range of the median of errors, of which these are known, ascending, and `unknown` ones are not: all of them could be zero, or
/// larger than all others. Without an upper end where so many are unknown that there is none; `None` without known errors.
pub(super) fn median_range(known: &[f64], unknown: u64) -> Option<(f64, Option<f64>)> {
    let number = known.len() as u64 + unknown;
    let last = number.checked_sub(1).filter(|_| !known.is_empty())?;
    let (below, above) = (last / 2, last.div_ceil(2));
    let lowest = |place: u64| place.checked_sub(unknown).map_or(0.0, |place| known[place as usize]);
    let highest = |place: u64| known.get(place as usize).copied();
    let low = 0.5 * (lowest(below) + lowest(above));
    Some((low, highest(below).zip(highest(above)).map(|(a, b)| 0.5 * (a + b))))
}
