//! The structure with the largest γ first, with an update of a copy of the mixture after each pick.

use super::SelectionError;
use super::lazy_heap::{Bound, LazyHeap};
use super::learned_mixture::{Learned, LearnedMixture};
use super::pool::{Pool, PoolAtom};
use crate::mixture::Mixture;
use crate::rules::Positive;

/// Atoms that are graded at first after a pick; then twice as many each time, up to a limit. Most atoms that are graded a little too
/// early have the largest bounds after the next pick.
const FIRST_BATCH: usize = 32;
const LARGEST_BATCH: usize = 4096;
/// Atoms whose features are in the cache together.
const GRADED_TOGETHER: usize = 64;

/// Version of a bound that is no γ of this copy of the mixture.
const NOT_GRADED: usize = usize::MAX;

/// Picks structures by the largest γ of their atoms within the window. After each pick, the additive update C ← C + αC_b of a copy
/// of the mixture learns the structure, where C_b is that of its atoms within the window and α the smallest that brings their γ
/// below the target, if need be with an inflation.
///
/// Centroids, thresholds and the assignment of atoms do not change. C + αC_b ≥ C in the Loewner order (C_b is positive
/// semidefinite), as is an inflation, so (C′ + εI)⁻¹ ≤ (C + εI)⁻¹ and no γ rises. The γ of an atom from before an update is
/// therefore an upper bound, and only atoms whose bound is the largest are graded again: the picks are those of a complete grading
/// after each pick.
///
/// The inverses of the copy follow from its covariances. Those of the given mixture may come from an artifact in single precision, so
/// the first bounds are its γ with a factor that covers the difference.
#[derive(Debug)]
pub struct Greedy<'a> {
    pool: &'a Pool,
    mixture: LearnedMixture,
    /// Of the γ of atoms. Their version is the number of updates of the component.
    bounds: LazyHeap,
    taken: Vec<bool>,
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
            taken: vec![false; pool.len()],
        };
        for structure in picked {
            greedy.learn(structure)?;
        }
        greedy.bounds = LazyHeap::new(greedy.first_bounds());
        Ok(greedy)
    }

    /// Picks the next structure. `None` when no structure has an atom above the lower limit of the window.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn pick(&mut self) -> Result<Option<GreedyPick>, SelectionError> {
        let Some(Bound { value: gamma, index: atom, .. }) = self.largest()? else { return Ok(None) };
        let structure = self.pool.atoms()[atom].structure as usize;
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

    /// Bounds of the atoms within the window in structures that were not picked.
    fn first_bounds(&self) -> Vec<Bound> {
        let atoms =
            self.pool.atoms().iter().enumerate().filter(|(_, atom)| {
                self.pool.window().has(atom.gamma) && !self.taken[atom.structure as usize]
            });
        let bound = |(index, atom): (usize, &PoolAtom)| {
            let factor = self.mixture.component(self.mixture.place(atom)).bound_factor;
            Bound { value: factor * atom.gamma, preference: 0.0, index, version: NOT_GRADED }
        };
        atoms.map(bound).collect()
    }

    /// The atom with the largest γ, which stays in the queue.
    fn largest(&mut self) -> Result<Option<Bound>, SelectionError> {
        let mut batch = FIRST_BATCH;
        loop {
            let outdated = self.bounds.take_outdated(batch, |atom| {
                let atom = &self.pool.atoms()[atom];
                let place = self.mixture.place(atom);
                (!self.taken[atom.structure as usize]).then(|| self.mixture.component(place).updates)
            });
            if outdated.is_empty() {
                return Ok(self.bounds.largest());
            }
            self.grade(outdated)?;
            batch = LARGEST_BATCH.min(2 * batch);
        }
    }

    /// Grades atoms and puts those above the lower limit into the queue. The others never rise above it again.
    fn grade(&mut self, mut atoms: Vec<usize>) -> Result<(), SelectionError> {
        let (pool, mixture, bounds) = (self.pool, &self.mixture, &mut self.bounds);
        let place = |atom: usize| mixture.place(&pool.atoms()[atom]);
        atoms.sort_unstable_by_key(|&atom| (place(atom), atom));
        let groups = atoms.chunk_by(|&a, &b| place(a) == place(b));
        for atoms in groups.flat_map(|group| group.chunks(GRADED_TOGETHER)) {
            let component = mixture.component(place(atoms[0]));
            for (value, &index) in component.gamma(pool, atoms)?.into_iter().zip(atoms) {
                if value > pool.window().above {
                    bounds.push(Bound { value, preference: 0.0, index, version: component.updates });
                }
            }
        }
        Ok(())
    }

    /// Updates the mixture with the atoms of a structure within the window.
    fn learn(&mut self, structure: usize) -> Result<Learned, SelectionError> {
        self.taken[structure] = true;
        self.mixture.learn(self.pool, self.pool.window_atoms_of(structure).collect())
    }
}
