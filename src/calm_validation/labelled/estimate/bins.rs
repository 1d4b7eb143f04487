//! Force errors by bins of a score, with intervals.

use analysis::{BinStatistics, BinnedErrors, Bins, Bootstrap, ForceErrors};

use super::super::collect::{LARGE_ERROR, SampledAtom};
use super::super::report::Bin;
use super::StatisticValues;
use super::atoms::units;

/// The bins of a column. The intervals are from the sampled atoms.
pub fn with_intervals(
    errors: &ForceErrors,
    sampled: &[&SampledAtom],
    column: usize,
    bootstrap: Bootstrap,
) -> Vec<Bin> {
    let units = units(sampled);
    let structures = units.last().map_or(0, |last| *last as usize + 1);
    let items = sampled.iter().zip(units).map(|(atom, unit)| (atom.scores[column], atom.error, unit));
    let binned = BinnedErrors::new(&Bins::for_grades(), LARGE_ERROR, items);
    let values = |BinStatistics { median, p90, large }| [median, p90, large];
    let draw = |draw| -> StatisticValues {
        let found = binned.statistics(&bootstrap.multiplicities(draw, structures));
        found.into_iter().flat_map(values).collect()
    };
    let intervals = bootstrap.intervals(draw);
    let of_bins = intervals.chunks(3).map(|of| [of[0], of[1], of[2]]);
    errors.bins().iter().zip(of_bins).map(|(bin, intervals)| Bin::new(bin, intervals)).collect()
}
