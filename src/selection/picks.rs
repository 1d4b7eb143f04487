//! Applies strategies, one after another, each to what is left.

use calm::Mixture;
use calm::rules::Positive;
use calm::selection::{DOptimal, FarthestPoints, Greedy, Metric, SelectionError, floors, random_structures};
use tokio_util::sync::CancellationToken;

use super::GradedPool;
use super::strategy::{Strategy, StrategyQuota};
use crate::exit_status::CommandError;
use crate::output::Bar;

const BAR: &str = "{bar:32} {pos}/{len}  {msg}";

/// What a selection obeys.
pub struct Rules {
    pub parts: Vec<StrategyQuota>,
    /// γ below which an update brings a picked structure.
    pub update_target: Positive,
    /// Atoms of each element in what is picked; `None`: any number.
    pub floor: Option<u64>,
    pub seed: u64,
}

/// A picked structure.
pub struct Pick {
    /// Its index in the pool.
    pub structure: usize,
    /// Name of its strategy, or `floor`.
    pub strategy: &'static str,
    /// Largest γ: with greedy that of its atoms within the window when it was picked, otherwise that of all its atoms under the
    /// given mixture.
    pub gamma_max: f64,
}

/// What was picked.
pub struct Picks {
    /// In order.
    pub picks: Vec<Pick>,
    /// Elements (by index) with fewer atoms than the floor, although the pool has more.
    pub short: Vec<usize>,
    /// Largest γ of an atom within the window in a structure that was not picked, under the mixture updated with all that was;
    /// 0: none is above the lower limit. `None`: the mixture cannot be updated.
    pub gamma_left: Option<f64>,
}

/// Picks structures; `None` after a cancellation of `stop`.
pub fn pick(
    pool: &GradedPool,
    mixture: &Mixture,
    rules: &Rules,
    stop: &CancellationToken,
) -> Result<Option<Picks>, CommandError> {
    let mut picks: Vec<Pick> = Vec::new();
    let mut left = None;
    for (part, quota) in (0..).zip(&rules.parts) {
        let strategy = quota.strategy;
        let run = StrategyRun {
            pool,
            mixture,
            strategy: strategy.name(),
            wanted: quota.number.unwrap_or(usize::MAX),
            picked: picks.iter().map(|pick| pick.structure).collect(),
            stop,
        };
        let (found, largest_left) = match strategy {
            Strategy::Greedy => run.greedy(rules.update_target)?,
            Strategy::FarthestPoints => (run.farthest_points(Metric::Whitened(mixture))?, None),
            Strategy::FarthestPointsAll => (run.farthest_points(Metric::Plain)?, None),
            Strategy::DOptimal => (run.d_optimal()?, None),
            Strategy::Random => (run.random(false, rules.seed, part), None),
            Strategy::RandomExtrapolating => (run.random(true, rules.seed, part), None),
        };
        if stop.is_cancelled() {
            return Ok(None);
        }
        picks.extend(found);
        left = largest_left;
    }
    let short = match rules.floor {
        Some(floor) => meet_floors(pool, &mut picks, floor, &mut left),
        None => Vec::new(),
    };
    let gamma_left = match left {
        Some(left) => Some(left),
        None => gamma_left(pool, mixture, rules.update_target, &picks)?,
    };
    Ok(Some(Picks { picks, short, gamma_left }))
}

/// A strategy at work.
struct StrategyRun<'a> {
    pool: &'a GradedPool,
    mixture: &'a Mixture,
    /// Its name.
    strategy: &'static str,
    /// How many structures it picks, if there are as many.
    wanted: usize,
    /// Structures that earlier strategies picked.
    picked: Vec<usize>,
    stop: &'a CancellationToken,
}

impl StrategyRun<'_> {
    /// The picks, and the largest γ that is left (0: none is above the lower limit).
    fn greedy(&self, target: Positive) -> Result<(Vec<Pick>, Option<f64>), CommandError> {
        let mut greedy = Greedy::new(&self.pool.pool, self.mixture, target, self.picked.iter().copied())
            .map_err(CommandError::failed)?;
        let picks = self.collect(|| {
            let found = greedy.pick()?;
            Ok(found.map(|found| Pick {
                structure: found.structure,
                strategy: self.strategy,
                gamma_max: found.gamma_max,
            }))
        })?;
        let left = greedy.gamma_left().map_err(CommandError::failed)?;
        Ok((picks, Some(left.unwrap_or_default())))
    }

    fn farthest_points(&self, metric: Metric<'_>) -> Result<Vec<Pick>, CommandError> {
        let picked = self.picked.iter().copied();
        let mut points =
            FarthestPoints::new(&self.pool.pool, metric, picked).map_err(CommandError::failed)?;
        self.collect(|| Ok(points.pick()?.map(|found| self.pool.pick(found.structure, self.strategy))))
    }

    fn d_optimal(&self) -> Result<Vec<Pick>, CommandError> {
        let picked = self.picked.iter().copied();
        let mut design =
            DOptimal::new(&self.pool.pool, self.mixture, picked).map_err(CommandError::failed)?;
        self.collect(|| Ok(design.pick()?.map(|found| self.pool.pick(found.structure, self.strategy))))
    }

    /// Structures at random, or those among them with an atom within the window; `part` is the number of the strategy.
    fn random(&self, extrapolating: bool, seed: u64, part: u64) -> Vec<Pick> {
        let mut free = vec![true; self.pool.structures.len()];
        self.picked.iter().for_each(|structure| free[*structure] = false);
        let may =
            |s: &usize| free[*s] && (!extrapolating || self.pool.pool.window_atoms_of(*s).next().is_some());
        let structures: Vec<usize> = (0..free.len()).filter(may).collect();
        let drawn = random_structures(&structures, self.wanted, seed, part);
        drawn.into_iter().map(|structure| self.pool.pick(structure, self.strategy)).collect()
    }

    /// Picks until there are enough, no more is found or the selection is stopped.
    fn collect(
        &self,
        mut next: impl FnMut() -> Result<Option<Pick>, SelectionError>,
    ) -> Result<Vec<Pick>, CommandError> {
        let bar = Bar::new(Some(self.wanted.min(self.pool.structures.len()) as u64), BAR);
        let mut picks = Vec::new();
        while picks.len() < self.wanted
            && !self.stop.is_cancelled()
            && let Some(found) = next().map_err(CommandError::failed)?
        {
            picks.push(found);
            bar.set(picks.len() as u64, || self.strategy.to_owned());
        }
        Ok(picks)
    }
}

impl GradedPool {
    fn pick(&self, structure: usize, strategy: &'static str) -> Pick {
        Pick { structure, strategy, gamma_max: self.structures[structure].gamma_max }
    }
}

/// Exchanges structures for those with more atoms of rare elements. What `greedy` picked stays.
fn meet_floors(pool: &GradedPool, picks: &mut Vec<Pick>, floor: u64, left: &mut Option<f64>) -> Vec<usize> {
    let may_go = |pick: &Pick| pick.strategy != Strategy::Greedy.name();
    let picked: Vec<_> = picks.iter().map(|pick| (pick.structure, may_go(pick))).collect();
    let atoms = |structure: usize, element: usize| pool.atoms(structure, element);
    let exchanges = floors::meet(pool.structures.len(), pool.elements, atoms, &picked, floor);
    if !exchanges.added.is_empty() {
        *left = None;
        picks.retain(|pick| !exchanges.removed.contains(&pick.structure));
        picks.extend(exchanges.added.iter().map(|structure| pool.pick(*structure, "floor")));
    }
    exchanges.short
}

/// The largest γ that is left when a copy of the mixture has learned all that was picked.
fn gamma_left(
    pool: &GradedPool,
    mixture: &Mixture,
    target: Positive,
    picks: &[Pick],
) -> Result<Option<f64>, CommandError> {
    if !mixture.can_be_updated() {
        return Ok(None);
    }
    let picked = picks.iter().map(|pick| pick.structure);
    let mut greedy = Greedy::new(&pool.pool, mixture, target, picked).map_err(CommandError::failed)?;
    Ok(Some(greedy.gamma_left().map_err(CommandError::failed)?.unwrap_or_default()))
}
