//! Statistics of scores and force errors over the sampled atoms.

use analysis::{
    ERROR_THRESHOLDS, Exceedance, Histogram, RankedErrors, binned_quantiles, decade_edges, quantile,
};
use atoms::Species;

use super::super::collect::{SampledAtom, ScoreColumn};
use super::super::report::{Band, ErrorHistograms, ErrorPopulation};
use super::StatisticValues;

/// The sample, sorted once for all resamplings.
pub struct AtomStatistics {
    ranked: RankedErrors,
    elements: Vec<RankedElement>,
    /// Of each atom: its structure, and the number of thresholds below its error.
    atoms: Vec<(u32, usize)>,
    /// Whether an atom is within the limit of each column.
    kept: Vec<Vec<bool>>,
    /// Number of structures with sampled atoms.
    pub structures: usize,
}

/// The atoms of an element.
struct RankedElement {
    species: Species,
    ranked: RankedErrors,
    /// The 90 % quantile of their errors.
    threshold: f64,
}

impl AtomStatistics {
    pub fn new(sampled: &[&SampledAtom], columns: &[ScoreColumn]) -> Self {
        let units = units(sampled);
        let all: Vec<_> = sampled.iter().copied().zip(units.iter().copied()).collect();
        let mut elements: Vec<_> = sampled.iter().map(|atom| atom.species).collect();
        elements.sort_unstable_by_key(|species| species.atomic_number());
        elements.dedup();
        let element = |species: Species| {
            let atoms: Vec<_> = all.iter().copied().filter(|(atom, _)| atom.species == species).collect();
            let mut errors: Vec<_> = atoms.iter().map(|(atom, _)| atom.error).collect();
            errors.sort_by(f64::total_cmp);
            let threshold = quantile(&errors, 0.9).unwrap_or(f64::NAN);
            RankedElement { species, ranked: ranked(&atoms, columns.len()), threshold }
        };
        let counts = Exceedance::new(&ERROR_THRESHOLDS);
        let is_kept = |(k, column): (usize, &ScoreColumn)| -> Vec<bool> {
            sampled.iter().map(|atom| column.limit.is_none_or(|limit| atom.scores[k] <= limit)).collect()
        };
        Self {
            ranked: ranked(&all, columns.len()),
            elements: elements.into_iter().map(element).collect(),
            atoms: all.iter().map(|(atom, unit)| (*unit, counts.bin_index(atom.error))).collect(),
            kept: columns.iter().enumerate().map(is_kept).collect(),
            structures: units.last().map_or(0, |last| *last as usize + 1),
        }
    }

    /// Symbol, number of atoms, and the force error that a tenth of them exceeds.
    pub fn elements(&self) -> impl Iterator<Item = (&'static str, usize, f64)> {
        self.elements
            .iter()
            .map(|element| (element.species.symbol(), element.ranked.len(), element.threshold))
    }

    /// Number of [`Self::values`] of a column.
    pub fn values_of_column(&self) -> usize {
        3 + 2 * ERROR_THRESHOLDS.len() + self.elements.len()
    }

    /// For each column: ρ, mean area for the worst decile, retention, areas and contamination for each threshold, area for
    /// the worst decile of each element.
    pub fn values(&self, multiplicities: &[u32]) -> StatisticValues {
        let whole = self.ranked.statistics(multiplicities, &ERROR_THRESHOLDS);
        let of_element =
            |element: &RankedElement| element.ranked.statistics(multiplicities, &[element.threshold]);
        let by_element: Vec<_> = self.elements.iter().map(of_element).collect();
        let mut values = Vec::with_capacity(self.kept.len() * self.values_of_column());
        for (k, (statistics, kept)) in whole.iter().zip(&self.kept).enumerate() {
            let areas: Vec<_> = by_element.iter().map(|statistics| statistics[k].auc[0]).collect();
            let mut counts = Exceedance::new(&ERROR_THRESHOLDS);
            for ((unit, bin), is_kept) in self.atoms.iter().zip(kept) {
                counts.add_to_bin(*bin, *is_kept, multiplicities[*unit as usize]);
            }
            values.extend([statistics.spearman, mean(&areas), counts.retention()]);
            values.extend_from_slice(&statistics.auc);
            values.extend(counts.contamination());
            values.extend(areas);
        }
        values
    }
}

/// Numbers of the structures with sampled atoms, from 0.
pub fn units(sampled: &[&SampledAtom]) -> Vec<u32> {
    let runs = sampled.chunk_by(|a, b| a.structure == b.structure);
    runs.enumerate().flat_map(|(unit, run)| vec![unit as u32; run.len()]).collect()
}

fn ranked(atoms: &[(&SampledAtom, u32)], columns: usize) -> RankedErrors {
    let errors: Vec<_> = atoms.iter().map(|(atom, _)| atom.error).collect();
    let units: Vec<_> = atoms.iter().map(|(_, unit)| *unit).collect();
    let scores = |k| atoms.iter().map(|(atom, _)| atom.scores[k]).collect();
    RankedErrors::new(&errors, &units, &(0..columns).map(scores).collect::<Vec<_>>())
}

fn mean(values: &[Option<f64>]) -> Option<f64> {
    let known: Vec<_> = values.iter().flatten().collect();
    (!known.is_empty()).then(|| known.iter().copied().sum::<f64>() / known.len() as f64)
}

/// Quantiles of the force error in bins of a score, ten a decade, down to a tenth of its limit at least.
pub fn bands(sampled: &[&SampledAtom], column: usize, limit: Option<f64>) -> Vec<Band> {
    let scores = sampled.iter().map(|atom| atom.scores[column]);
    let edges = decade_edges(scores, limit.map(|limit| 0.1 * limit));
    let pairs = sampled.iter().map(|atom| (atom.scores[column], atom.error));
    binned_quantiles(&edges, pairs).into_iter().map(Into::into).collect()
}

impl ErrorHistograms {
    /// `None` without an error above zero.
    pub fn of_atoms(sampled: &[&SampledAtom], column: usize, limit: f64) -> Option<Self> {
        Self::new(sampled.iter().map(|atom| (atom.scores[column] <= limit, atom.error)))
    }

    /// `None` without an error above zero.
    pub fn of_components(sampled: &[&SampledAtom], column: usize, limit: f64) -> Option<Self> {
        Self::new(sampled.iter().flat_map(|atom| {
            let is_within = atom.scores[column] <= limit;
            atom.difference.map(|component| (is_within, component.abs()))
        }))
    }

    /// Of errors, each with whether it is of an atom within the limit.
    fn new(errors: impl Iterator<Item = (bool, f64)>) -> Option<Self> {
        let mut sides = [Vec::new(), Vec::new()];
        errors.for_each(|(is_within, error)| sides[usize::from(!is_within)].push(error));
        let edges = decade_edges(sides.iter().flatten().copied(), None);
        if edges.len() < 2 {
            return None;
        }
        let population = |mut errors: Vec<f64>| {
            errors.sort_by(f64::total_cmp);
            let sum = errors.iter().sum::<f64>();
            ErrorPopulation {
                counts: Histogram::from_values(edges.clone(), errors.iter().copied()).counts().to_vec(),
                mean: (!errors.is_empty()).then(|| sum / errors.len() as f64),
                median: quantile(&errors, 0.5),
            }
        };
        Some(Self { populations: sides.map(population), edges })
    }
}
