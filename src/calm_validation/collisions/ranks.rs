//! How many directions the features of an environment tell apart: the rank of their Jacobian by the positions (paper, SI1).

use std::collections::BTreeMap;

use analysis::singular_values;
use atoms::Species;
use serde::Serialize;

use super::feature_match::cluster;
use super::random_rows::{SURPLUS, random_weights, rank};
use super::search::{MatchedFeatures, NEIGHBOURS, allowed, first_environment, searched};
use crate::all_cores;
use crate::calm_validation::random::RandomSequence;
use crate::calm_validation::{Subject, ValidationProgress, ValidationSettings};
use crate::features::FeatureCalculator;

/// Number of the first sequence of random numbers; the searches have those before.
const SEQUENCES: u64 = 1 << 41;

/// What is examined for each element: which features, and whether those of all atoms or of the one in the middle.
const EXAMINED: [(MatchedFeatures, bool); 4] = [
    (MatchedFeatures::HiddenLayer, false),
    (MatchedFeatures::HiddenLayer, true),
    (MatchedFeatures::Graded, false),
    (MatchedFeatures::Graded, true),
];

/// The rank of the Jacobian of the features at the first environment of an element's searches.
#[derive(Clone, Debug, Serialize)]
pub struct FeatureRank {
    /// The element.
    pub element: String,
    /// Which features.
    pub features: MatchedFeatures,
    /// Atoms whose features count: the one in the middle, or all.
    pub atoms: usize,
    /// Features of them.
    pub dimension: usize,
    /// Directions of all N atoms without translations and rotations: 3N − 6.
    pub directions: usize,
    /// Directions that change a feature.
    pub rank: usize,
    /// The smallest singular value that counts, relative to the largest.
    pub smallest: f64,
    /// The largest one that does not; `None` if all count.
    pub next: Option<f64>,
}

impl FeatureRank {
    /// Directions of the null space: no feature changes along them.
    pub fn free(&self) -> usize {
        self.directions.saturating_sub(self.rank)
    }
}

/// Number of Jacobians.
pub fn count(settings: &ValidationSettings) -> usize {
    searched(settings).count() * EXAMINED.len()
}

/// Ranks for the elements whose pairs are searched, with their equilibrium distances, Å.
pub fn run(
    subject: &Subject,
    settings: &ValidationSettings,
    distances: &BTreeMap<String, f64>,
    progress: &ValidationProgress,
) -> Vec<FeatureRank> {
    let tasks = searched(settings).flat_map(|species| EXAMINED.map(|examined| (species, examined)));
    let found = all_cores::map(
        tasks.collect::<Vec<_>>().into_iter(),
        || {
            let hidden = subject.model.grace().cloned().map(FeatureCalculator::of_hidden_layer);
            (hidden, FeatureCalculator::new(subject.model.shared()))
        },
        |(hidden, graded), (species, (features, of_all))| {
            let calculator = match features {
                MatchedFeatures::HiddenLayer => hidden.as_mut()?,
                MatchedFeatures::Graded => graded,
            };
            let equilibrium = distances[species.symbol()];
            let found = (!progress.is_stopped())
                .then(|| examine(calculator, settings.seed, (species, equilibrium), (features, of_all)));
            progress.advance();
            found.flatten()
        },
    );
    found.into_iter().flatten().collect()
}

/// `None` without features, or if the environment has no room.
fn examine(
    calculator: &mut FeatureCalculator,
    seed: u64,
    (species, equilibrium): (Species, f64),
    (features, of_all): (MatchedFeatures, bool),
) -> Option<FeatureRank> {
    let allowed = allowed(calculator.potential.model(), species, equilibrium)?;
    let neighbours = first_environment(seed, (species, allowed), NEIGHBOURS)?;
    calculator.compute(&cluster(species, &neighbours)).ok()?;
    let number = 1 + neighbours.len();
    let atoms = if of_all { number } else { 1 };
    let dimension = atoms * calculator.dimension();
    let sequence = SEQUENCES + u64::from(species.atomic_number());
    let mut random = RandomSequence::new(seed, sequence);
    let weights = random_weights(dimension.min(3 * number) + SURPLUS, dimension, &mut random);
    let values = singular_values(&calculator.combined_gradients(&weights).ok()?, 3 * number)?;
    let largest = values[0];
    let rank = rank(&values);
    Some(FeatureRank {
        element: species.to_string(),
        features,
        atoms,
        dimension,
        directions: 3 * number - 6,
        rank,
        smallest: values[rank.checked_sub(1)?] / largest,
        next: values.get(rank).map(|next| next / largest),
    })
}
