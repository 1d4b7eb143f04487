//! Greedy selection against a complete grading after each pick.

use std::sync::Arc;

use calm::build::shuffled;
use calm::grade::maximum;
use calm::rules::{CovarianceUpdateKind, MaximumGradeUpdate, Positive, UpdateRule, UpdateSettings};
use calm::selection::{Greedy, GreedyPick, Pool, Window};
use calm::{Component, Grades, Mixture, Statistics, regularised_inverse, update};
use proptest::prelude::*;

use crate::common::{Random, assert_close};

const WINDOW: Window = Window { above: 1.0, up_to: 300.0 };
const STRUCTURES: usize = 40;

/// What the given inverses are of those that follow from the covariances.
#[derive(Debug, Clone, Copy)]
enum Inverses {
    /// In single precision.
    Rounded,
    /// All the same multiple.
    Multiple(f64),
}

#[derive(Debug, Clone, Copy)]
struct Setting {
    seed: u64,
    dimension: usize,
    /// Training atoms of a component. If they are fewer than D, its covariance is singular.
    training: usize,
    inverses: Inverses,
    /// Of the pool, bytes.
    memory: usize,
}

struct Case {
    /// With the given inverses.
    mixture: Mixture,
    /// With those that follow from the covariances.
    consistent: Mixture,
    structures: Vec<(Vec<usize>, Vec<f64>)>,
    pool: Pool,
}

fn setting() -> impl Strategy<Value = Setting> {
    let inverses = prop_oneof![
        Just(Inverses::Rounded),
        prop::sample::select(vec![1.0, 0.9, 0.3, 1.5]).prop_map(Inverses::Multiple)
    ];
    (0_u64..1000, 1_usize..24, 0_usize..60, inverses, 0_usize..40_000).prop_map(
        |(seed, dimension, training, inverses, memory)| {
            // Rounded inverses of singular covariances are not positive.
            let least = if matches!(inverses, Inverses::Rounded) { 3 * dimension } else { 0 };
            Setting { seed, dimension, training: training.max(least), inverses, memory }
        },
    )
}

/// Centres of two components of the first element, one of the second, one of the third, which has no training atoms.
const CENTRES: [(usize, f64); 4] = [(0, 0.0), (0, 9.0), (1, -3.0), (2, 2.0)];

impl Setting {
    fn component(&self, random: &mut Random, centre: f64, training: usize, given: bool) -> Arc<Component> {
        let d = self.dimension;
        let mut scatter = vec![0.0; d * d];
        for row in random.take(training * d).chunks(d) {
            let row: Vec<f64> = row.iter().zip(1..).map(|(x, k)| x / f64::from(k)).collect();
            (0..d * d).for_each(|k| scatter[k] += row[k / d] * row[k % d]);
        }
        let statistics = Statistics { scatter, count: training as f64, effective_count: training as f64 };
        let mut inverse = regularised_inverse(&statistics.covariance(), d).unwrap();
        match self.inverses {
            Inverses::Rounded if given => inverse.iter_mut().for_each(|x| *x = f64::from(*x as f32)),
            Inverses::Multiple(factor) if given => inverse.iter_mut().for_each(|x| *x *= factor),
            _ => {}
        }
        let threshold = 0.8 * (d as f64).sqrt();
        Arc::new(Component::new(vec![centre; d], inverse, threshold, Some(statistics)).unwrap())
    }

    fn mixture(&self, given: bool) -> Mixture {
        let (mut random, mut elements) = (Random(self.seed), vec![Vec::new(); 3]);
        for (element, centre) in CENTRES {
            let training = if element == 2 { 0 } else { self.training };
            elements[element].push(self.component(&mut random, centre, training, given));
        }
        Mixture::new(0, elements).unwrap()
    }

    /// Structures of up to 20 atoms, some of which are far away; every fifth is a copy of an earlier one.
    fn case(&self) -> Case {
        let (mixture, consistent) = (self.mixture(true), self.mixture(false));
        let mut random = Random(self.seed + 1);
        let mut pool = Pool::new(self.dimension, WINDOW, false, self.memory, std::env::temp_dir());
        let mut structures: Vec<(Vec<usize>, Vec<f64>)> = Vec::new();
        let mut grades = Grades::default();
        for number in 0..STRUCTURES {
            let scale = 4.0 * random.next().powi(2);
            let mut below = |count: f64| (count * random.next().abs()) as usize;
            let places: Vec<_> = (0..1 + below(20.0)).map(|_| CENTRES[below(4.0)]).collect();
            let elements: Vec<usize> = places.iter().map(|(element, _)| *element).collect();
            let feature = |centre: f64, k: usize, x: f64| centre + scale * x / (1 + k) as f64;
            let rows = places.iter().flat_map(|(_, centre)| {
                let row = random.take(self.dimension).into_iter().enumerate();
                row.map(|(k, x)| feature(*centre, k, x)).collect::<Vec<_>>()
            });
            let features = rows.collect();
            let structure =
                if number % 5 == 4 { structures[number / 2].clone() } else { (elements, features) };
            grades.evaluate(&mixture, &structure.0, &structure.1, None).unwrap();
            pool.push(&structure.0, &grades.component, &grades.gamma, &structure.1).unwrap();
            structures.push(structure);
        }
        Case { mixture, consistent, structures, pool }
    }
}

impl Case {
    /// Elements and features of the atoms of a structure within the window.
    fn within(&self, structure: usize) -> (Vec<usize>, Vec<f64>) {
        let (elements, features) = &self.structures[structure];
        let mut grades = Grades::default();
        grades.evaluate(&self.mixture, elements, features, None).unwrap();
        let kept = (0..elements.len()).filter(|&atom| WINDOW.has(grades.gamma[atom]));
        let rows: Vec<_> = features.chunks(self.mixture.dimension()).collect();
        let kept: Vec<_> = kept.map(|atom| (elements[atom], rows[atom])).collect();
        (kept.iter().map(|(e, _)| *e).collect(), kept.iter().flat_map(|(_, z)| z.to_vec()).collect())
    }

    /// Grades everything after each pick.
    fn complete(&self, before: &[usize]) -> Vec<GreedyPick> {
        let settings = UpdateSettings {
            covariance_update: CovarianceUpdateKind::Additive,
            alpha_values: None,
            stop: UpdateRule::MaximumGrade(MaximumGradeUpdate { target: target() }),
        };
        let learn = |mixture: &mut Mixture, structure: usize| {
            let (elements, features) = self.within(structure);
            if elements.is_empty() {
                return (0.0, 0.0);
            }
            let outcome = update(mixture, &elements, &features, &settings).unwrap();
            *mixture = mixture.with_changes(&outcome.changed).unwrap();
            (outcome.alpha, maximum(&outcome.gamma_after))
        };
        let mut mixture = self.consistent.clone();
        for &structure in before {
            learn(&mut mixture, structure);
        }
        let mut left: Vec<usize> = (0..STRUCTURES).filter(|s| !before.contains(s)).collect();
        let mut picks = Vec::new();
        loop {
            let mut grades = Grades::default();
            let mut gamma = |&structure: &usize| {
                let (elements, features) = self.within(structure);
                grades.evaluate(&mixture, &elements, &features, None).unwrap();
                maximum(&grades.gamma)
            };
            let gamma: Vec<f64> = left.iter().map(&mut gamma).collect();
            let gamma_max = maximum(&gamma);
            if gamma_max <= WINDOW.above {
                return picks;
            }
            let structure = left.remove(gamma.iter().position(|g| *g == gamma_max).unwrap());
            let (alpha, gamma_after) = learn(&mut mixture, structure);
            picks.push(GreedyPick { structure, gamma_max, gamma_after, alpha });
        }
    }
}

fn target() -> Positive {
    1.25.try_into().unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn greedy_picks_as_after_a_complete_grading(setting in setting(), before in 0_usize..4) {
        let case = setting.case();
        let before: Vec<usize> = shuffled(setting.seed, 0, STRUCTURES).into_iter().take(before).collect();
        let expected = case.complete(&before);
        let mut greedy = Greedy::new(&case.pool, &case.mixture, target(), before).unwrap();
        let mut found = Vec::new();
        loop {
            let left = greedy.gamma_left().unwrap();
            let Some(pick) = greedy.pick().unwrap() else {
                prop_assert_eq!(left, None);
                break;
            };
            prop_assert_eq!(left, Some(pick.gamma_max));
            found.push(pick);
        }
        let picked = |picks: &[GreedyPick]| picks.iter().map(|pick| (pick.structure, pick.alpha)).collect::<Vec<_>>();
        prop_assert_eq!(picked(&found), picked(&expected));
        // Condition numbers are up to 10⁷.
        for of in [|pick: &GreedyPick| pick.gamma_max, |pick: &GreedyPick| pick.gamma_after] {
            let values = |picks: &[GreedyPick]| picks.iter().map(of).collect::<Vec<f64>>();
            assert_close("γ", &values(&found), &values(&expected), 1e-7);
        }
    }
}
