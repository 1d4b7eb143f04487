//! Atoms sorted once, for the statistics of all draws.

use std::collections::BTreeMap;

use analysis::{BinnedErrors, RankedErrors};

use super::super::frames::ComparedAtom;
use super::units::{median, sorted_values};

/// Atoms sorted by error and by both grades.
pub(super) struct RankedAtoms {
    ranked: RankedErrors,
    errors: BinnedErrors,
    /// Smallest and largest error of each unit with any of these atoms.
    ranges: Vec<(f64, f64)>,
}

impl RankedAtoms {
    /// Atoms, each with its unit.
    pub fn new(atoms: &[(&ComparedAtom, u32)]) -> Self {
        let errors: Vec<_> = atoms.iter().map(|(atom, _)| atom.error).collect();
        let units: Vec<_> = atoms.iter().map(|(_, unit)| *unit).collect();
        let grades: [fn(&ComparedAtom) -> f64; 2] = [|atom| atom.gamma, |atom| atom.gamma_nbr];
        let scores = grades.map(|grade| atoms.iter().map(|(atom, _)| grade(atom)).collect::<Vec<_>>());
        let mut ranges: BTreeMap<u32, (f64, f64)> = BTreeMap::new();
        for (error, unit) in errors.iter().zip(&units) {
            let (low, high) = ranges.entry(*unit).or_insert((*error, *error));
            (*low, *high) = (low.min(*error), high.max(*error));
        }
        Self {
            ranked: RankedErrors::new(&errors, &units, &scores),
            errors: sorted_values(errors.iter().copied().zip(units.iter().copied())),
            ranges: ranges.into_values().collect(),
        }
    }

    pub fn len(&self) -> usize {
        self.ranked.len()
    }

    /// Number of units with any of these atoms.
    pub fn units(&self) -> usize {
        self.ranges.len()
    }

    /// Number of units with an error above the threshold, or with one that is not, whichever is smaller.
    pub fn units_on_both_sides(&self, threshold: f64) -> usize {
        let above = self.ranges.iter().filter(|(_, high)| *high > threshold).count();
        above.min(self.ranges.iter().filter(|(low, _)| *low <= threshold).count())
    }

    /// The median error; then of γ and of γ_nbr, each: Spearman's ρ, and the ROC-AUC for each threshold.
    pub fn values(&self, multiplicities: &[u32], thresholds: &[f64]) -> Vec<Option<f64>> {
        let mut values = vec![median(&self.errors, multiplicities)];
        for statistics in self.ranked.statistics(multiplicities, thresholds) {
            values.push(statistics.spearman);
            values.extend(statistics.auc);
        }
        values
    }
}
