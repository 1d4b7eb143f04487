//! Pairs found by minimisation: positions of the neighbours that give an atom the features of another environment (paper, SI1).

use std::collections::BTreeMap;
use std::sync::Arc;

use atoms::cell::norm;
use atoms::{Evaluation, Species, Structure, Vec3};
use potentials::ModelWithFeatures;
use potentials::grace::PullBack;
use serde::Serialize;

use super::environments::{EnvironmentDifference, random_neighbours};
use super::feature_match::{AllowedDistances, FeatureMatch, cluster};
use super::lbfgs::Lbfgs;
use super::null_space::NullSpaceWalk;
use crate::all_cores;
use crate::calm_validation::random::RandomSequence;
use crate::calm_validation::{Subject, ValidationGrader, ValidationProgress, ValidationSettings};
use crate::features::FeatureCalculator;

/// Neighbours of an environment (paper).
pub const NEIGHBOURS: usize = 50;
/// Elements for which pairs are searched; the paper takes one.
const MAX_ELEMENTS: usize = 6;
/// Minimisations of which the best is kept. The paper gives no number.
const STARTS: usize = 2;
/// Standard deviation of each coordinate of a displaced copy, Å.
const DISPLACEMENT: f64 = 0.3;
/// Relative distance of the features at which a search ends: that of the paper's pairs.
const TARGET: f64 = 1e-9;
/// A walk in the null space ends at this root mean square distance, Å (paper).
const WALKED: f64 = 1.0;
/// Such a walk lets distances fall to this share of the shortest one at its start: otherwise there is no room for it.
const WALK_ROOM: f64 = 0.8;
/// Largest change of a coordinate in a step, Å.
const REACH: f64 = 0.2;
/// Random neighbours are so far from the middle at most, in cutoffs …
const RADIUS: f64 = 0.9;
/// … and stay so near, because an atom beyond the cutoff would be a difference that no feature sees.
const FARTHEST: f64 = 0.95;
/// Shortest distance, in distances of equilibrium …
const CLOSEST: f64 = 0.7;
/// … but at most this share of the radius: then 50 random neighbours have room.
const ROOM: f64 = 0.36;
/// Environments are different if their geometries differ by more, Å.
const DIFFERENT: f64 = 0.01;
/// Number of the first sequence of random numbers; solid solutions have those before.
const SEQUENCES: u64 = 1 << 40;

/// A pair of environments of one element, the best of a few minimisations.
#[derive(Clone, Debug, Serialize)]
pub struct MatchedPair {
    /// The element.
    pub element: String,
    /// Which features were matched.
    pub features: MatchedFeatures,
    /// Where the second environment began.
    pub start: SearchStart,
    /// M, the number of neighbours of each environment.
    pub neighbours: usize,
    /// |z_A − z_B| / |z_A| at the start.
    pub start_distance: f64,
    /// The same at the end.
    pub distance: f64,
    /// Whether the environments differ, other than by a rotation, a reflection or the order of their atoms.
    pub is_different: bool,
    /// Root mean square difference of the sorted distances between all atoms, Å.
    pub distances: f64,
    /// The same of the sorted root mean square distances of each neighbour from the other atoms, Å.
    pub spreads: f64,
    /// Root mean square distance after superposition, Å; reflections are allowed, another order of the atoms is not.
    pub superposed: f64,
    /// Energy of the atom in both environments, eV.
    pub energies: [f64; 2],
    /// |F| of the atom in both environments, eV/Å.
    pub forces: [f64; 2],
    /// Scores of the atom in both environments.
    pub scores: [Vec<f64>; 2],
    /// Evaluations of the features.
    pub evaluations: usize,
    /// Both environments; the atom comes first.
    #[serde(skip)]
    pub structures: [Structure; 2],
}

/// Features that are matched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum MatchedFeatures {
    /// The last hidden layer of the readout.
    HiddenLayer,
    /// Those that γ grades.
    Graded,
}

/// Where a search begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SearchStart {
    /// At another random environment.
    Unrelated,
    /// At the first environment with displaced neighbours.
    DisplacedCopy,
    /// At the first environment; it moves along directions in which no feature changes.
    NullSpace,
}

impl MatchedFeatures {
    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::HiddenLayer => "hidden layer",
            Self::Graded => "as graded",
        }
    }
}

impl SearchStart {
    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unrelated => "unrelated",
            Self::DisplacedCopy => "displaced copy of A",
            Self::NullSpace => "A, walk in the null space",
        }
    }
}

/// What is searched for each element: features, start, and whether there are so few neighbours that the densities of the readout can tell
/// all environments apart.
const SEARCHES: [(MatchedFeatures, SearchStart, bool); 6] = [
    (MatchedFeatures::HiddenLayer, SearchStart::Unrelated, false),
    (MatchedFeatures::HiddenLayer, SearchStart::DisplacedCopy, false),
    (MatchedFeatures::HiddenLayer, SearchStart::Unrelated, true),
    (MatchedFeatures::Graded, SearchStart::Unrelated, false),
    (MatchedFeatures::Graded, SearchStart::DisplacedCopy, false),
    (MatchedFeatures::HiddenLayer, SearchStart::NullSpace, false),
];

/// The elements whose environments are searched; none without evaluations.
pub fn searched(settings: &ValidationSettings) -> impl Iterator<Item = Species> {
    let is_wanted = settings.collision_evaluations > 0;
    settings.elements.iter().take(MAX_ELEMENTS).filter(move |_| is_wanted).copied()
}

/// Elements and numbers of their searches.
fn tasks(settings: &ValidationSettings) -> Vec<(Species, usize)> {
    searched(settings).flat_map(|species| (0..SEARCHES.len()).map(move |search| (species, search))).collect()
}

/// Number of searches.
pub fn count(settings: &ValidationSettings) -> usize {
    tasks(settings).len()
}

/// Searches pairs of up to six elements, with their equilibrium distances, Å. Searches without a result are left out.
pub fn run(
    subject: &Subject,
    settings: &ValidationSettings,
    distances: &BTreeMap<String, f64>,
    progress: &ValidationProgress,
) -> Vec<MatchedPair> {
    let found = all_cores::map(
        tasks(settings).into_iter(),
        || PairSearch::new(subject),
        |search_of_model, (species, search)| {
            let calculators = search_of_model.as_mut()?;
            let allowed = allowed(&*subject.model.shared(), species, distances[species.symbol()]);
            let runs = (0..STARTS).filter_map(|start| {
                calculators.minimise(settings, progress, (species, allowed?), (search, start))
            });
            // A pair that differs counts before one that does not, whatever the distance.
            let best = runs
                .min_by(|a, b| b.is_different.cmp(&a.is_different).then(a.distance.total_cmp(&b.distance)));
            progress.advance();
            best
        },
    );
    found.into_iter().flatten().collect()
}

/// Where neighbours may be. `None` for an element that the model does not know.
pub fn allowed(
    model: &dyn ModelWithFeatures,
    species: Species,
    equilibrium: f64,
) -> Option<AllowedDistances> {
    let element = *model.element_indices(&[species]).ok()?.first()?;
    let cutoff = model.pair_cutoff(element, element);
    let closest = (CLOSEST * equilibrium).min(ROOM * RADIUS * cutoff);
    Some(AllowedDistances { closest, farthest: FARTHEST * cutoff })
}

/// The largest M with fewer degrees of freedom, 3M − 3, than densities; at least 2.
fn few_neighbours(densities: usize) -> usize {
    densities.div_ceil(3).max(2)
}

/// Calculators of both features, and the grader.
struct PairSearch {
    grader: ValidationGrader,
    hidden: FeatureCalculator,
    /// Densities of the readout, of which the hidden layer is a function.
    densities: usize,
}

impl PairSearch {
    /// `None` for a model without a readout that is known.
    fn new(subject: &Subject) -> Option<Self> {
        let model = subject.model.grace()?;
        let hidden = FeatureCalculator::of_hidden_layer(Arc::clone(model));
        Some(Self { grader: ValidationGrader::new(subject), hidden, densities: model.density_dimension() })
    }

    /// One minimisation. `None` if it was stopped, or if environments have no room or no grades.
    fn minimise(
        &mut self,
        settings: &ValidationSettings,
        progress: &ValidationProgress,
        (species, allowed): (Species, AllowedDistances),
        (search, start): (usize, usize),
    ) -> Option<MatchedPair> {
        if progress.is_stopped() {
            return None;
        }
        let (features, kind, is_control) = SEARCHES[search];
        let few = few_neighbours(self.densities);
        let number = if is_control { few } else { NEIGHBOURS };
        let mut random = sequence(settings.seed, species, 1 + search * STARTS + start);
        let first = first_environment(settings.seed, (species, allowed), number)?;
        let second = second_environment(kind, &first, allowed, &mut random)?;
        let calculator = match features {
            MatchedFeatures::HiddenLayer => &mut self.hidden,
            MatchedFeatures::Graded => &mut self.grader.features,
        };
        let mut matched = FeatureMatch::new(calculator, species, allowed, &first)?;
        let start_distance = matched.distance(&second)?;
        let max_evaluations = settings.collision_evaluations;
        let stop = || progress.is_stopped();
        let (point, evaluations) = if kind == SearchStart::NullSpace {
            let allowed = AllowedDistances { closest: WALK_ROOM * allowed.closest, ..allowed };
            let (max_rank, target) = (self.densities, TARGET);
            let walk = NullSpaceWalk { target, farthest: WALKED, max_evaluations, allowed, max_rank };
            walk.run(&mut matched, &first, &mut random, stop)?
        } else {
            let limits = Lbfgs { target: TARGET * TARGET, max_evaluations, reach: REACH };
            let f = |x: &[f64], gradient: &mut [f64]| matched.evaluate(x, gradient);
            let lowest = limits.minimise(second.concat(), f, stop)?;
            (lowest.point, lowest.evaluations)
        };
        let second: Vec<Vec3> = point.as_chunks().0.to_vec();
        let distance = matched.distance(&second)?;
        let difference = EnvironmentDifference::new(&first, &second);
        let structures = [cluster(species, &first), cluster(species, &second)];
        let [a, b] = [self.environment(&structures[0])?, self.environment(&structures[1])?];
        Some(MatchedPair {
            element: species.to_string(),
            features,
            start: kind,
            neighbours: number,
            start_distance,
            distance,
            is_different: difference.excludes_symmetry(DIFFERENT),
            distances: difference.distances,
            spreads: difference.spreads,
            superposed: difference.superposed,
            energies: [a.energy, b.energy],
            forces: [a.force, b.force],
            scores: [a.scores, b.scores],
            evaluations,
            structures,
        })
    }

    /// Energy, force and scores of the first atom.
    fn environment(&mut self, cluster: &Structure) -> Option<MatchedEnvironment> {
        let graded = self.grader.grade(cluster).ok()?;
        let potential = &mut self.grader.features.potential;
        let mut derivatives = Evaluation::default();
        potential.backward(None, &mut derivatives, &mut PullBack::default()).ok()?;
        Some(MatchedEnvironment {
            energy: *potential.atomic_energies().first()?,
            force: norm(*derivatives.forces.first()?),
            scores: graded.scores.iter().filter_map(|of| of.first().copied()).collect(),
        })
    }
}

/// The sequence of random numbers of an element with this number.
fn sequence(seed: u64, species: Species, role: usize) -> RandomSequence {
    let number = usize::from(species.atomic_number()) * (1 + SEARCHES.len() * STARTS) + role;
    RandomSequence::new(seed, SEQUENCES + number as u64)
}

/// The first environment of all searches of an element with this number of neighbours. `None` without room.
pub fn first_environment(
    seed: u64,
    (species, allowed): (Species, AllowedDistances),
    number: usize,
) -> Option<Vec<Vec3>> {
    place(number, allowed, &mut sequence(seed, species, 0))
}

/// Where the second environment begins. `None` without room.
fn second_environment(
    start: SearchStart,
    first: &[Vec3],
    allowed: AllowedDistances,
    random: &mut RandomSequence,
) -> Option<Vec<Vec3>> {
    match start {
        SearchStart::Unrelated => place(first.len(), allowed, random),
        SearchStart::DisplacedCopy => Some(first.iter().map(|r| displaced(*r, random)).collect()),
        SearchStart::NullSpace => Some(first.to_vec()),
    }
}

/// Random neighbours.
fn place(number: usize, allowed: AllowedDistances, random: &mut RandomSequence) -> Option<Vec<Vec3>> {
    random_neighbours(number, RADIUS / FARTHEST * allowed.farthest, allowed.closest, random)
}

/// What an atom has in an environment.
struct MatchedEnvironment {
    energy: f64,
    force: f64,
    scores: Vec<f64>,
}

/// A place with a random displacement.
fn displaced(place: Vec3, random: &mut RandomSequence) -> Vec3 {
    place.map(|x| x + DISPLACEMENT * random.normal())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_neighbours_have_less_freedom_than_there_are_densities() {
        // The paper's 17 densities and 6 neighbours.
        assert_eq!([17, 9, 1].map(few_neighbours), [6, 3, 2]);
        for densities in 4..40 {
            let few = few_neighbours(densities);
            assert!(3 * few - 3 < densities && 3 * (few + 1) - 3 >= densities, "{densities}");
        }
    }

    #[test]
    fn nothing_is_searched_without_evaluations_or_for_too_many_elements() {
        let elements: Vec<Species> =
            ["Al", "W", "Si", "H", "Ti", "Mo", "Nb"].map(|symbol| symbol.parse().unwrap()).to_vec();
        let settings = |collision_evaluations| ValidationSettings {
            elements: elements.clone(),
            pairs: Vec::new(),
            scan_steps: 2,
            relaxation: None,
            solution_structures: 1,
            collision_evaluations,
            seed: 0,
        };
        assert_eq!((count(&settings(0)), count(&settings(1))), (0, MAX_ELEMENTS * SEARCHES.len()));
    }

    #[test]
    fn random_neighbours_have_room() {
        let (radius, mut random) = (RADIUS * 6.0, RandomSequence::new(1, 1));
        for _ in 0..20 {
            assert!(random_neighbours(NEIGHBOURS, radius, ROOM * radius, &mut random).is_some());
        }
    }
}
