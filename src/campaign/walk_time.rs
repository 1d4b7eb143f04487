//! How long walks take on this host, from steps that are measured for a few seed structures.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use calm::Mixture;
use potentials::grace::Threads;
use wire::messages::Assignment;
use wire::{CampaignId, CellConditions, Origin, WalkConditions, WalkId};
use workers::walk::{WalkContext, advance};

use super::{LoadedCampaign, SourcedStructure};
use crate::exit_status::CommandError;

/// Steps that are measured of each size, after the first.
const MEASURED_STEPS: usize = 10;

/// No further step is measured after this time.
const LONGEST_MEASUREMENT: Duration = Duration::from_millis(500);

/// A threshold that no grade reaches, as a factor: a measured walk offers nothing.
const NO_CANDIDATE: f64 = 1e100;

/// Times of walks, s.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WalkTime {
    /// The biased walk.
    pub biased: f64,
    /// Its control walk, which has as many steps if the last collected structure comes at the end; 0 without controls.
    pub control: f64,
}

/// Measured steps of seed structures of different sizes, on the threads of one walker.
#[derive(Debug)]
pub struct StepTimes {
    /// Time of a step divided by [`work`], s, biased and unbiased, by size class.
    classes: BTreeMap<u32, [f64; 2]>,
    /// Steps of a walk: of equilibration, and biased.
    steps: [f64; 2],
    /// Steps of the reference run of a walk at constant pressure.
    reference: f64,
    /// Whether walks have control walks.
    control: bool,
}

impl StepTimes {
    /// Measures steps of one seed structure of each size class, the one with the median number of neighbours. Sizes of
    /// a class differ by less than a factor of two.
    ///
    /// # Errors
    /// The system cannot create the threads of a walker.
    pub fn measure(campaign: &LoadedCampaign) -> Result<Self, CommandError> {
        let threads =
            Threads::new(campaign.config.run.threads_per_walker.get()).map_err(CommandError::failed)?;
        let mut settings = campaign.walk_settings();
        // Only the bias of the walk differs from that of its control walk, and the volume is that of the seed structure.
        (settings.equilibration_steps, settings.biased_steps) = (0, u64::MAX);
        settings.trajectory_interval = 0;
        // Steps that measure the norms of the bias no oftener than those of a walk do.
        settings.bias_averaging_steps = 1;
        let mixture = Arc::new(campaign.artifact.mixture.clone());
        let (model, settings, original) = (campaign.model.shared(), Arc::new(settings), Arc::clone(&mixture));
        let context = WalkContext { model, threads, settings, original };
        let mut sizes: BTreeMap<u32, Vec<&SourcedStructure>> = BTreeMap::new();
        for seed in &campaign.seed_structures {
            sizes.entry(class(seed)).or_default().push(seed);
        }
        let mut classes = BTreeMap::new();
        for (class, mut seeds) in sizes {
            seeds.sort_by_key(|seed| seed.geometry.bonds);
            let seed = seeds[seeds.len() / 2];
            let step = |origin| step_time(&context, seed, origin, &mixture);
            if let (Some(biased), Some(unbiased)) = (step(Origin::Biased), step(Origin::Control)) {
                classes.insert(class, [biased, unbiased].map(|time| time / work(seed)));
            }
        }
        let walk = &campaign.config.walk;
        let steps = [walk.equilibration_steps, walk.biased_steps.get()].map(|steps| steps as f64);
        let reference = walk.reference_steps as f64;
        Ok(Self { classes, steps, reference, control: campaign.config.campaign.control })
    }

    /// The sum over seed structures. `None` if no step could be measured.
    pub fn total<'a>(&self, seeds: impl IntoIterator<Item = &'a SourcedStructure>) -> Option<WalkTime> {
        seeds
            .into_iter()
            .map(|seed| self.for_seed_structure(seed))
            .try_fold(WalkTime::default(), |sum, of| Some(sum.plus(of?)))
    }

    /// The time of all walks from a seed structure. `None` if no step could be measured.
    pub fn for_seed_structure(&self, seed: &SourcedStructure) -> Option<WalkTime> {
        let class = class(seed);
        let (_, rate) = self.classes.iter().min_by_key(|(measured, _)| measured.abs_diff(class))?;
        let time = |[biased, unbiased]: [f64; 2]| work(seed) * (biased * rate[0] + unbiased * rate[1]);
        let walks = seed.plan.walks.iter().map(|conditions| {
            let [biased, control] = self.steps(conditions).map(time);
            WalkTime { biased, control }
        });
        Some(walks.fold(WalkTime::default(), WalkTime::plus))
    }

    /// Numbers of steps that take the time of one biased and one unbiased step at the volume of the seed structure: of
    /// the biased walk and of its control walk. An atom has fewer neighbours in a larger volume.
    fn steps(&self, conditions: &WalkConditions) -> [[f64; 2]; 2] {
        let [equilibration, biased] = self.steps;
        let (from, to) = conditions.volume_ramp().unwrap_or((1.0, 1.0));
        let (equilibration, biased) = (equilibration / from, biased * mean_density(from, to));
        let reference = if conditions.constant_pressure().is_some() { self.reference } else { 0.0 };
        let equilibration = reference + equilibration;
        let control = if self.control { equilibration + biased } else { 0.0 };
        [[biased, equilibration], [0.0, control]]
    }
}

impl WalkTime {
    fn plus(self, other: Self) -> Self {
        Self { biased: self.biased + other.biased, control: self.control + other.control }
    }
}

/// Structures of a class differ in their number of atoms by less than a factor of two.
fn class(seed: &SourcedStructure) -> u32 {
    seed.plan.structure.len().max(1).ilog2()
}

/// What the time of a step scales with: atoms and their neighbours.
fn work(seed: &SourcedStructure) -> f64 {
    (seed.plan.structure.len() + seed.geometry.bonds) as f64
}

/// The mean of V₀/V while V/V₀ changes linearly.
fn mean_density(from: f64, to: f64) -> f64 {
    if (to - from).abs() < 1e-6 * from { 1.0 / from } else { (to / from).ln() / (to - from) }
}

/// The median time of a step of a walk, s. `None` if the walk ends too early.
fn step_time(
    context: &WalkContext,
    seed: &SourcedStructure,
    origin: Origin,
    mixture: &Arc<Mixture>,
) -> Option<f64> {
    // At the volume of the seed structure.
    let conditions = WalkConditions { cell: CellConditions::Fixed, ..seed.plan.walks.first()?.clone() };
    let assignment = Assignment {
        campaign: CampaignId([0; 16]),
        walk: WalkId(0),
        number: 0,
        origin,
        random_walk: WalkId(0),
        seed_structure: seed.plan.structure.clone(),
        conditions,
        checkpoint: None,
        verdict: None,
        last_step: u64::MAX,
        frame_steps: Vec::new(),
        threshold_factor: NO_CANDIDATE,
    };
    let (begun, ends) = (Instant::now(), RefCell::new(Vec::new()));
    let is_enough = || {
        let steps = ends.borrow().len();
        steps > MEASURED_STEPS || steps > 1 && begun.elapsed() > LONGEST_MEASUREMENT
    };
    let on_step = |_| ends.borrow_mut().push(Instant::now());
    // A model that does not answer has no steps.
    let _ = advance(context, &assignment, Arc::clone(mixture), is_enough, on_step);
    // Other processes may interrupt some steps, and the first one also fills caches.
    let ends = ends.into_inner();
    let mut times: Vec<_> = ends.windows(2).map(|pair| (pair[1] - pair[0]).as_secs_f64()).collect();
    times.sort_by(f64::total_cmp);
    times.get(times.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_density_is_that_of_the_ramp() {
        for (from, to) in [(1.0, 1.4), (0.8, 1.3), (1.2, 0.9), (1.1, 1.1)] {
            let points = 10_000_u32;
            let volume = |k: u32| from + (to - from) * (f64::from(k) + 0.5) / f64::from(points);
            let mean = (0..points).map(|k| 1.0 / volume(k)).sum::<f64>() / f64::from(points);
            assert!((mean_density(from, to) - mean).abs() < 1e-8, "{from} {to}");
        }
    }
}
