//! Atoms sorted once, for the statistics of all draws.

use std::collections::BTreeSet;

use analysis::{BinnedErrors, RankedErrors};

use super::super::frames::ComparedAtom;
use super::units::{median, sorted_values};

/// Atoms sorted by error and by both grades.
pub(super) struct RankedAtoms {
    ranked: RankedErrors,
    errors: BinnedErrors,
    /// Number of units with any of these atoms.
    pub units: usize,
}

impl RankedAtoms {
    /// Atoms, each with its unit.
    pub fn new(atoms: &[(&ComparedAtom, u32)]) -> Self {
        let errors: Vec<_> = atoms.iter().map(|(atom, _)| atom.error).collect();
        let units: Vec<_> = atoms.iter().map(|(_, unit)| *unit).collect();
        let grades: [fn(&ComparedAtom) -> f64; 2] = [|atom| atom.gamma, |atom| atom.gamma_nbr];
        let scores = grades.map(|grade| atoms.iter().map(|(atom, _)| grade(atom)).collect::<Vec<_>>());
        Self {
            ranked: RankedErrors::new(&errors, &units, &scores),
            errors: sorted_values(errors.iter().copied().zip(units.iter().copied())),
            units: units.iter().collect::<BTreeSet<_>>().len(),
        }
    }

    pub fn len(&self) -> usize {
        self.ranked.len()
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
