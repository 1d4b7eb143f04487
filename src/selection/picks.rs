//! Applies strategies, one after another, each to what is left.

use calm::Mixture;
use calm::rules::{Positive, UpdateSettings};
use calm::selection::{DOptimal, FarthestPoints, Greedy, Metric, floors, random_structures, update_settings};
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
    let settings = update_settings(rules.update_target);
    let mut picks: Vec<Pick> = Vec::new();
    let mut left = None;
    for (number, part) in rules.parts.iter().enumerate() {
        let before = picks.len();
        let wanted = part.number.unwrap_or(usize::MAX);
        let bar = Bar::new(Some(wanted.min(pool.structures.len()) as u64), BAR);
        let shown = |picked: usize| bar.set(picked as u64, || part.strategy.name().to_owned());
        let picked: Vec<usize> = picks.iter().map(|pick| pick.structure).collect();
        let is_complete = |picks: &[Pick]| picks.len() - before >= wanted || stop.is_cancelled();
        left = None;
        match part.strategy {
            Strategy::Greedy => {
                let mut greedy = Greedy::new(&pool.pool, mixture, settings.clone(), picked)
                    .map_err(CommandError::failed)?;
                while !is_complete(&picks)
                    && let Some(found) = greedy.pick().map_err(CommandError::failed)?
                {
                    picks.push(Pick {
                        structure: found.structure,
                        strategy: part.strategy.name(),
                        gamma_max: found.gamma_max,
                    });
                    shown(picks.len() - before);
                }
                left = Some(greedy.gamma_left().map_err(CommandError::failed)?.unwrap_or_default());
            }
            Strategy::FarthestPoints | Strategy::FarthestPointsAll => {
                let metric = match part.strategy {
                    Strategy::FarthestPoints => Metric::Whitened(mixture),
                    _ => Metric::Plain,
                };
                let mut points =
                    FarthestPoints::new(&pool.pool, metric, picked).map_err(CommandError::failed)?;
                while !is_complete(&picks)
                    && let Some(found) = points.pick().map_err(CommandError::failed)?
                {
                    picks.push(pool.pick(found.structure, part.strategy.name()));
                    shown(picks.len() - before);
                }
            }
            Strategy::DOptimal => {
                let mut design = DOptimal::new(&pool.pool, mixture, picked).map_err(CommandError::failed)?;
                while !is_complete(&picks)
                    && let Some(found) = design.pick().map_err(CommandError::failed)?
                {
                    picks.push(pool.pick(found.structure, part.strategy.name()));
                    shown(picks.len() - before);
                }
            }
            Strategy::Random | Strategy::RandomExtrapolating => {
                let extrapolating = part.strategy == Strategy::RandomExtrapolating;
                let mut free = vec![true; pool.structures.len()];
                picked.into_iter().for_each(|structure| free[structure] = false);
                let may = |s: &usize| {
                    free[*s] && (!extrapolating || pool.pool.window_atoms_of(*s).next().is_some())
                };
                let structures: Vec<usize> = (0..free.len()).filter(may).collect();
                let drawn = random_structures(&structures, wanted, rules.seed, number as u64);
                picks.extend(drawn.into_iter().map(|s| pool.pick(s, part.strategy.name())));
            }
        }
        if stop.is_cancelled() {
            return Ok(None);
        }
    }
    let short = match rules.floor {
        Some(floor) => meet_floors(pool, &mut picks, floor, &mut left),
        None => Vec::new(),
    };
    let gamma_left = match left {
        Some(left) => Some(left),
        None => gamma_left(pool, mixture, settings, &picks)?,
    };
    Ok(Some(Picks { picks, short, gamma_left }))
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
    settings: UpdateSettings,
    picks: &[Pick],
) -> Result<Option<f64>, CommandError> {
    if !mixture.can_be_updated() {
        return Ok(None);
    }
    let picked = picks.iter().map(|pick| pick.structure);
    let mut greedy = Greedy::new(&pool.pool, mixture, settings, picked).map_err(CommandError::failed)?;
    Ok(Some(greedy.gamma_left().map_err(CommandError::failed)?.unwrap_or_default()))
}
