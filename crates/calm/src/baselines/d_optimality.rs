//! D-optimality: γ_Dopt = max_j |(**x** A⁺)_j| for an active set A of training atoms (paper, Methods, "Validation").

use super::error::BaselineError;
use super::groups::{AtomGroups, for_each_group, subtract};
use super::kind::BaselineKind;
use super::max_vol::{ActiveSet, Tolerances};
use super::settings::BaselineSettings;
use crate::mixture::Mixture;

/// Rows that are taken into account at once.
const BLOCK_ROWS: usize = 128;

/// An active set for each element or component.
#[derive(Debug, Clone, PartialEq)]
pub struct DOptimality {
    pub(super) kind: BaselineKind,
    pub(super) groups: AtomGroups,
    pub(super) sets: Vec<ActiveSet>,
    pub(super) converged: bool,
}

impl DOptimality {
    /// Which of the three constructions.
    pub fn kind(&self) -> BaselineKind {
        self.kind
    }

    /// D
    pub fn dimension(&self) -> usize {
        self.groups.dimension()
    }

    /// The number of active rows of each group, those of the first element first: D, or fewer if its training atoms
    /// span fewer dimensions. Displacements out of their span do not change the score.
    pub fn ranks(&self) -> Vec<usize> {
        self.sets.iter().map(ActiveSet::rank).collect()
    }

    /// The active rows of a group, `[r × D]`, centred where the construction is; `None` beyond the last group. Tests and benchmarks
    /// check with them that no training atom has a coefficient above 1.
    #[doc(hidden)]
    pub fn active_rows(&self, group: usize) -> Option<&[f64]> {
        self.sets.get(group).map(ActiveSet::rows)
    }

    /// Whether no coefficient of a training atom exceeds 1 by more than the tolerance; otherwise the sweeps ran out.
    pub fn is_converged(&self) -> bool {
        self.converged
    }

    /// As [`super::Baseline::score`].
    pub(super) fn score(&self, elements: &[usize], features: &[f64]) -> Result<Vec<f64>, BaselineError> {
        let mut scores = vec![0.0; elements.len()];
        self.for_each_set(elements, features, |group, atoms, rows| {
            for (atom, score) in atoms.iter().zip(self.sets[group].score(rows)) {
                scores[*atom] = score;
            }
        })?;
        Ok(scores)
    }

    /// Calls `visit` with group, atoms and rows **x** of each group.
    fn for_each_set(
        &self,
        elements: &[usize],
        features: &[f64],
        mut visit: impl FnMut(usize, &[usize], &[f64]),
    ) -> Result<(), BaselineError> {
        let groups = self.groups.assign(elements, features)?;
        let centred = self.kind == BaselineKind::DOptimalityCentred;
        for_each_group(&groups, self.dimension(), features, |group, atoms, rows| {
            if let Some(centroid) = self.groups.centroid(group).filter(|_| centred) {
                subtract(rows, centroid);
            }
            visit(group, atoms, rows);
        });
        Ok(())
    }
}

/// Sweeps over the training data.
#[derive(Debug, Clone)]
pub(super) struct DOptimalityBuilder {
    result: DOptimality,
    tolerances: Tolerances,
    /// Rows that wait, `[≤ BLOCK_ROWS × D]` for each group.
    blocks: Vec<Vec<f64>>,
    sweeps: usize,
    max_sweeps: usize,
}

impl DOptimalityBuilder {
    /// `mixture` is needed for the constructions by component.
    pub fn new(
        kind: BaselineKind,
        settings: &BaselineSettings,
        dimension: usize,
        elements: usize,
        mixture: Option<&Mixture>,
    ) -> Self {
        let groups = mixture.filter(|_| kind.needs_mixture());
        let groups =
            groups.map_or_else(|| AtomGroups::of_elements(dimension, elements), AtomGroups::of_components);
        let sets = vec![ActiveSet::new(dimension); groups.count()];
        Self {
            blocks: vec![Vec::new(); groups.count()],
            result: DOptimality { kind, groups, sets, converged: false },
            tolerances: Tolerances { coefficient: settings.tolerance, rank: settings.rank_tolerance },
            sweeps: 0,
            max_sweeps: settings.max_sweeps,
        }
    }

    pub fn add(&mut self, elements: &[usize], features: &[f64]) -> Result<(), BaselineError> {
        let Self { result, tolerances, blocks, .. } = self;
        let (dimension, mut sets) = (result.dimension(), std::mem::take(&mut result.sets));
        let added = result.for_each_set(elements, features, |group, _, rows| {
            for row in rows.chunks_exact(dimension) {
                let block = &mut blocks[group];
                block.extend_from_slice(row);
                if block.len() == BLOCK_ROWS * dimension {
                    sets[group].visit(block, *tolerances);
                    block.clear();
                }
            }
        });
        result.sets = sets;
        added
    }

    /// Returns whether another sweep is needed.
    pub fn end_sweep(&mut self) -> bool {
        let mut changed = false;
        for (set, block) in self.result.sets.iter_mut().zip(&mut self.blocks) {
            set.visit(block, self.tolerances);
            block.clear();
            changed |= set.end_sweep();
        }
        self.sweeps += 1;
        self.result.converged = !changed;
        changed && self.sweeps < self.max_sweeps
    }

    pub fn finish(self) -> Result<DOptimality, BaselineError> {
        if self.result.sets.iter().all(|set| set.rank() == 0) {
            return Err(BaselineError::NoData);
        }
        Ok(self.result)
    }
}
