//! The structure with the largest γ first, with an update of a copy of the mixture after each pick.

use super::SelectionError;
use super::lazy_heap::{Bound, LazyHeap};
use super::learned_mixture::{Learned, LearnedMixture};
use super::pool::Pool;
use crate::mixture::Mixture;
use crate::rules::Positive;

/// Atoms whose features are in the cache together.
const GRADED_TOGETHER: usize = 64;

/// Version of a bound that is no γ of this copy of the mixture.
const NOT_GRADED: usize = usize::MAX;

/// Picks structures by the largest γ of their atoms within the window. After each pick, the additive update C ← C + αC_b of a copy
/// of the mixture learns the structure, where C_b is that of its atoms within the window and α the smallest that brings their γ
/// below the target, if need be with an inflation.
///
/// Centroids, thresholds and the assignment of atoms do not change. C + αC_b ≥ C in the Loewner order (C_b is positive
/// semidefinite), as is an inflation, so (C′ + εI)⁻¹ ≤ (C + εI)⁻¹ and no γ rises. The largest γ of a structure from before an update
/// is therefore an upper bound, and only structures whose bound is the largest are graded again: the picks are those of a complete
/// grading after each pick. All atoms of a structure are graded at once, because their features are side by side in memory; those that
/// are not above the lower limit of the window never are again.
///
/// The inverses of the copy follow from its covariances. Those of the given mixture may come from an artifact in single precision, so
/// the first bounds are its γ with a factor that covers the difference.
#[derive(Debug)]
pub struct Greedy<'a> {
    pool: &'a Pool,
    mixture: LearnedMixture,
    /// Of the largest γ of structures. Their version is the number of updates of the component of that atom.
    bounds: LazyHeap,
    /// The atom with the largest γ when a structure was graded, `[structures]`.
    largest: Vec<usize>,
    taken: Vec<bool>,
    /// Atoms that are no longer above the lower limit of the window, `[atoms]`.
    covered: Vec<bool>,
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

impl<'a> Greedy<'a> {
    /// Prepares the picks. `mixture` is the one that graded the pool. A copy of it is updated with the structures that were `picked`
    /// before, in their order, and these are not picked again. An update brings γ below `target` (default of the walkers' update:
    /// 1.25).
    ///
    /// # Errors
    /// A mixture without statistics, a pool that belongs to another mixture, a file that cannot be read.
    pub fn new(
        pool: &'a Pool,
        mixture: &Mixture,
        target: Positive,
        picked: impl IntoIterator<Item = usize>,
    ) -> Result<Self, SelectionError> {
        let mut greedy = Self {
            pool,
            mixture: LearnedMixture::new(mixture, pool, target.into())?,
            bounds: LazyHeap::default(),
            largest: vec![0; pool.len()],
            taken: vec![false; pool.len()],
            covered: vec![false; pool.atoms().len()],
        };
        for structure in picked {
            greedy.learn(structure)?;
        }
        for structure in 0..pool.len() {
            if !greedy.taken[structure] {
                greedy.add(structure);
            }
        }
        Ok(greedy)
    }

    /// Picks the next structure. `None` when no structure has an atom above the lower limit of the window.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn pick(&mut self) -> Result<Option<GreedyPick>, SelectionError> {
        let Some(Bound { value: gamma, index: structure, .. }) = self.largest()? else { return Ok(None) };
        let Learned { alpha, gamma_max } = self.learn(structure)?;
        Ok(Some(GreedyPick { structure, gamma_max: gamma, gamma_after: gamma_max, alpha }))
    }

    /// Largest γ of an atom within the window in a structure that was not picked, under the updated mixture; `None` if none is
    /// above the lower limit.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn gamma_left(&mut self) -> Result<Option<f64>, SelectionError> {
        Ok(self.largest()?.map(|bound| bound.value))
    }

    /// Puts a structure with its first bound into the queue, if it has an atom within the window.
    fn add(&mut self, structure: usize) {
        let bounds = self.pool.window_atoms_of(structure).map(|atom| {
            let atom = &self.pool.atoms()[atom];
            self.mixture.component(self.mixture.place(atom)).bound_factor * atom.gamma
        });
        if let Some(value) = bounds.reduce(f64::max) {
            self.bounds.push(Bound { value, preference: 0.0, index: structure, version: NOT_GRADED });
        }
    }

    /// The structure with the largest γ, which stays in the queue.
    fn largest(&mut self) -> Result<Option<Bound>, SelectionError> {
        // Small structures several at a time.
        let structures = GRADED_TOGETHER * self.pool.len() / self.pool.atoms().len().max(1);
        loop {
            let outdated = self.bounds.take_outdated(structures.max(1), |structure| {
                let place = self.mixture.place(&self.pool.atoms()[self.largest[structure]]);
                (!self.taken[structure]).then(|| self.mixture.component(place).updates)
            });
            if outdated.is_empty() {
                return Ok(self.bounds.largest());
            }
            self.grade(&outdated)?;
        }
    }

    /// Grades structures and puts those with an atom above the lower limit of the window into the queue.
    fn grade(&mut self, structures: &[usize]) -> Result<(), SelectionError> {
        let (pool, mixture) = (self.pool, &self.mixture);
        let place = |atom: usize| mixture.place(&pool.atoms()[atom]);
        let atoms = structures.iter().flat_map(|structure| pool.window_atoms_of(*structure));
        let mut atoms: Vec<usize> = atoms.filter(|atom| !self.covered[*atom]).collect();
        atoms.sort_unstable_by_key(|&atom| (place(atom), atom));
        let mut above = Vec::new();
        let groups = atoms.chunk_by(|&a, &b| place(a) == place(b));
        for atoms in groups.flat_map(|group| group.chunks(GRADED_TOGETHER)) {
            let gamma = mixture.component(place(atoms[0])).gamma(pool, atoms)?;
            for (&atom, gamma) in atoms.iter().zip(gamma) {
                self.covered[atom] = gamma <= pool.window().above;
                if !self.covered[atom] {
                    above.push((pool.atoms()[atom].structure, gamma, atom));
                }
            }
        }
        above.sort_unstable_by(|a, b| a.0.cmp(&b.0).then_with(|| b.1.total_cmp(&a.1)));
        // The first of each structure is the largest.
        above.dedup_by_key(|(structure, ..)| *structure);
        for (structure, value, atom) in above {
            let (index, version) = (structure as usize, mixture.component(place(atom)).updates);
            self.largest[index] = atom;
            self.bounds.push(Bound { value, preference: 0.0, index, version });
        }
        Ok(())
    }

    /// Updates the mixture with the atoms of a structure within the window.
    fn learn(&mut self, structure: usize) -> Result<Learned, SelectionError> {
        self.taken[structure] = true;
        self.mixture.learn(self.pool, self.pool.window_atoms_of(structure).collect())
    }
}
