//! The structure with the largest γ first, with an update of a copy of the mixture after each pick.

use std::collections::HashMap;
use std::sync::Arc;

use super::SelectionError;
use super::lazy_heap::{Bound, LazyHeap};
use super::pool::{Pool, PoolAtom};
use crate::component::Statistics;
use crate::grade::{GradeError, Grades, maximum};
use crate::mixture::{ChangedComponent, Mixture};
use crate::rules::{CovarianceUpdateKind, MaximumGradeUpdate, Positive, UpdateRule, UpdateSettings};
use crate::search::update;
use crate::update::UpdateError;

/// Atoms that are graded together.
const BATCH: usize = 16;
/// Atoms of a batch of the first grading.
const FIRST_BATCH: usize = 1024;

/// Picks structures by the largest γ of their atoms within the window. After each pick, the additive update C ← C + αC_b of a copy
/// of the mixture learns the structure, where C_b is that of its atoms within the window and α the smallest that brings their γ
/// below the target, if need be with an inflation.
///
/// Centroids, thresholds and the assignment of atoms do not change. C + αC_b ≥ C in the Loewner order (C_b is positive
/// semidefinite), as is an inflation, so (C′ + εI)⁻¹ ≤ (C + εI)⁻¹ and no γ rises. The γ of an atom from before an update is
/// therefore an upper bound, and only atoms whose bound is the largest are graded again: the picks are those of a complete grading
/// after each pick.
#[derive(Debug)]
pub struct Greedy<'a> {
    pool: &'a Pool,
    mixture: Mixture,
    settings: UpdateSettings,
    /// Number of updates of each component that has had one.
    versions: Versions,
    /// Of the γ of atoms.
    bounds: LazyHeap,
    taken: Vec<bool>,
    grades: Grades,
}

/// A structure that was picked.
#[derive(Debug, Clone, PartialEq)]
pub struct GreedyPick {
    /// Its index in the pool.
    pub structure: usize,
    /// Largest γ of its atoms within the window, before its own update.
    pub gamma_max: f64,
    /// The same after it.
    pub gamma_after: f64,
    /// α of the update.
    pub alpha: f64,
}

/// Number of updates of components, by element and slot.
type Versions = HashMap<(usize, usize), usize>;

/// The additive update until γ_max is below `target` (default of the walkers' update: 1.25).
pub fn update_settings(target: Positive) -> UpdateSettings {
    UpdateSettings {
        covariance_update: CovarianceUpdateKind::Additive,
        alpha_values: None,
        stop: UpdateRule::MaximumGrade(MaximumGradeUpdate { target }),
    }
}

impl<'a> Greedy<'a> {
    /// Prepares the picks. The copy of `mixture` is updated with the structures that were `picked` before, in their order, and
    /// these are not picked again.
    ///
    /// The inverses of the copy follow from its covariances, as after an update: those of an artifact in single precision would
    /// make some γ rise at the first update.
    ///
    /// # Errors
    /// A mixture without statistics, a pool that belongs to another mixture, a file that cannot be read.
    pub fn new(
        pool: &'a Pool,
        mixture: &Mixture,
        settings: UpdateSettings,
        picked: impl IntoIterator<Item = usize>,
    ) -> Result<Self, SelectionError> {
        let mut greedy = Self {
            pool,
            mixture: consistent(mixture, pool)?,
            settings,
            versions: Versions::new(),
            bounds: LazyHeap::default(),
            taken: vec![false; pool.len()],
            grades: Grades::default(),
        };
        for structure in picked {
            greedy.learn(structure)?;
        }
        let atoms: Vec<usize> =
            (0..pool.len()).filter(|&s| !greedy.taken[s]).flat_map(|s| pool.window_atoms_of(s)).collect();
        for atoms in atoms.chunks(FIRST_BATCH) {
            greedy.grade(atoms)?;
        }
        Ok(greedy)
    }

    /// Picks the next structure. `None` when no structure has an atom above the lower limit of the window.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn pick(&mut self) -> Result<Option<GreedyPick>, SelectionError> {
        let Some(Bound { value: gamma, index: atom, .. }) = self.largest()? else { return Ok(None) };
        let structure = self.pool.atoms()[atom].structure as usize;
        let (alpha, gamma_after) = self.learn(structure)?.unwrap_or_default();
        Ok(Some(GreedyPick { structure, gamma_max: gamma, gamma_after, alpha }))
    }

    /// Largest γ of an atom within the window in a structure that was not picked, under the updated mixture; `None` if none is
    /// above the lower limit.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn gamma_left(&mut self) -> Result<Option<f64>, SelectionError> {
        Ok(self.largest()?.map(|bound| bound.value))
    }

    /// The atom with the largest γ, which stays in the queue.
    fn largest(&mut self) -> Result<Option<Bound>, SelectionError> {
        loop {
            let outdated = self.bounds.take_outdated(BATCH, |atom| {
                let atom = &self.pool.atoms()[atom];
                (!self.taken[atom.structure as usize]).then(|| version(&self.versions, atom))
            });
            if outdated.is_empty() {
                return Ok(self.bounds.largest());
            }
            self.grade(&outdated)?;
        }
    }

    /// Grades atoms and puts those above the lower limit into the queue. The others never rise above it again.
    fn grade(&mut self, atoms: &[usize]) -> Result<(), SelectionError> {
        let (elements, features) = self.pool.read(atoms.iter().copied())?;
        self.grades.evaluate(&self.mixture, &elements, &features, None)?;
        for (&value, &index) in self.grades.gamma.iter().zip(atoms) {
            if value > self.pool.window().above {
                let version = version(&self.versions, &self.pool.atoms()[index]);
                self.bounds.push(Bound { value, preference: 0.0, index, version });
            }
        }
        Ok(())
    }

    /// Updates the mixture with the atoms of a structure within the window. Returns α and γ_max after it; `None` without atoms.
    fn learn(&mut self, structure: usize) -> Result<Option<(f64, f64)>, SelectionError> {
        self.taken[structure] = true;
        let (elements, features) = self.pool.read(self.pool.window_atoms_of(structure))?;
        if elements.is_empty() {
            return Ok(None);
        }
        let outcome = update(&self.mixture, &elements, &features, &self.settings)?;
        self.mixture = self.mixture.with_changes(&outcome.changed)?;
        for ChangedComponent { element, slot, .. } in outcome.changed {
            *self.versions.entry((element, slot)).or_default() += 1;
        }
        Ok(Some((outcome.alpha, maximum(&outcome.gamma_after))))
    }
}

/// Number of updates of the component of an atom.
fn version(versions: &Versions, atom: &PoolAtom) -> usize {
    versions.get(&(atom.element.into(), atom.slot.into())).copied().unwrap_or_default()
}

/// The mixture with inverses that follow from its covariances, for the components that atoms of the pool belong to.
fn consistent(mixture: &Mixture, pool: &Pool) -> Result<Mixture, SelectionError> {
    let mut places: Vec<(usize, usize)> =
        pool.atoms().iter().map(|atom| (atom.element.into(), atom.slot.into())).collect();
    places.sort_unstable();
    places.dedup();
    let mut changed = Vec::new();
    for (element, slot) in places {
        let unknown = GradeError::Element { atom: 0, element, elements: mixture.element_count() };
        let component = mixture.component(element, slot).ok_or(unknown)?;
        let statistics = component.statistics().ok_or(UpdateError::NoStatistics { element, slot })?;
        let &Statistics { count, effective_count, .. } = statistics;
        let component = component
            .with_covariance(&statistics.covariance(), count, effective_count)
            .map_err(|source| SelectionError::Linear { element, slot, source })?;
        changed.push(ChangedComponent { element, slot, component: Arc::new(component) });
    }
    Ok(mixture.with_changes(&changed)?)
}
