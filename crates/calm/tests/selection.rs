//! Farthest points and D-optimal picks against complete evaluations after each pick.

use std::sync::Arc;

use calm::build::shuffled;
use calm::grade::maximum;
use calm::rules::Positive;
use calm::selection::{DOptimal, FarthestPoints, Greedy, Metric, Pool, PoolAtom, SelectionError, Window};
use calm::{Component, Grades, Mixture, Statistics, UpdateError, regularised_inverse};
use proptest::prelude::*;

use crate::common::{Random, niobium};

const D: usize = 5;
const WINDOW: Window = Window { above: 1.0, up_to: 60.0 };

/// Two elements with two and one components, whose covariances are those of random atoms.
fn mixture(random: &mut Random) -> Mixture {
    let mut component = |centre: f64| {
        let mut scatter = vec![0.0; D * D];
        for row in random.take(40 * D).chunks(D) {
            let row: Vec<f64> = row.iter().zip(1..).map(|(x, k)| x * f64::from(k)).collect();
            (0..D * D).for_each(|k| scatter[k] += row[k / D] * row[k % D]);
        }
        let covariance: Vec<f64> = scatter.iter().map(|value| value / 40.0).collect();
        let inverse = regularised_inverse(&covariance, D).unwrap();
        let statistics = Statistics { scatter, count: 40.0, effective_count: 40.0 };
        Arc::new(Component::new(vec![centre; D], inverse, 1.5, Some(statistics)).unwrap())
    };
    Mixture::new(0, vec![vec![component(0.0), component(20.0)], vec![component(-3.0)]]).unwrap()
}

struct Structures {
    mixture: Mixture,
    structures: Vec<(Vec<usize>, Vec<f64>)>,
    pool: Pool,
}

/// A pool of small structures, some of which are far away. `memory` in bytes.
fn structures(seed: u64, count: usize, all_atoms: bool, memory: usize) -> Structures {
    let mut random = Random(seed);
    let mixture = mixture(&mut random);
    let mut pool = Pool::new(D, WINDOW, all_atoms, memory, std::env::temp_dir());
    let (mut structures, mut grades) = (Vec::new(), Grades::default());
    for _ in 0..count {
        let scale = 4.0 * random.next().abs().powi(2);
        let elements: Vec<usize> = (0..4).map(|_| usize::from(random.next() > 0.3)).collect();
        let mut features = Vec::new();
        for &element in &elements {
            let centre = [if random.next() > 0.5 { 20.0 } else { 0.0 }, -3.0][element];
            features.extend(random.take(D).iter().map(|x| centre + scale * x));
        }
        grades.evaluate(&mixture, &elements, &features, None).unwrap();
        pool.push(&elements, &grades.component, &grades.gamma, &features).unwrap();
        structures.push((elements, features));
    }
    Structures { mixture, structures, pool }
}

impl Structures {
    /// Elements and features of the atoms of a structure within the window of its first grades.
    fn within(&self, structure: usize) -> (Vec<usize>, Vec<f64>) {
        let (elements, features) = &self.structures[structure];
        let mut grades = Grades::default();
        grades.evaluate(&self.mixture, elements, features, None).unwrap();
        let kept = (0..elements.len()).filter(|&atom| WINDOW.has(grades.gamma[atom]));
        let kept: Vec<_> = kept.map(|atom| (elements[atom], &features[atom * D..][..D])).collect();
        (kept.iter().map(|(e, _)| *e).collect(), kept.iter().flat_map(|(_, z)| z.to_vec()).collect())
    }

    /// Atoms within the window as (structure, group, whitened features).
    fn whitened(&self) -> Vec<(usize, usize, Vec<f64>)> {
        let mut points = Vec::new();
        for structure in 0..self.structures.len() {
            let (elements, features) = self.within(structure);
            let mut grades = Grades::default();
            grades.evaluate(&self.mixture, &elements, &features, None).unwrap();
            for (atom, &element) in elements.iter().enumerate() {
                let component = self.mixture.component(element, grades.component[atom]).unwrap();
                let delta: Vec<f64> =
                    (0..D).map(|k| features[atom * D + k] - component.centroid()[k]).collect();
                let lower = lower_factor(component.inverse());
                let column = |c: usize| (0..D).map(|r| lower[r * D + c] * delta[r]).sum();
                points.push((structure, element, (0..D).map(column).collect()));
            }
        }
        points
    }

    /// Λ_e of each element without picks: the mean of **zz**ᵀ over the training atoms, and 10⁻⁶.
    fn information(&self) -> [Vec<f64>; 2] {
        [0, 1].map(|element| {
            let components = self.mixture.components(element).unwrap();
            let statistics = || components.iter().map(|component| component.statistics().unwrap());
            let count: f64 = statistics().map(|statistics| statistics.effective_count).sum();
            let entry = |k: usize| {
                let sums = components.iter().zip(statistics()).map(|(component, statistics)| {
                    let product = component.centroid()[k / D] * component.centroid()[k % D];
                    statistics.scatter[k] + statistics.effective_count * product
                });
                sums.sum::<f64>() / count + if k / D == k % D { 1e-6 } else { 0.0 }
            };
            (0..D * D).map(entry).collect()
        })
    }

    /// All gains after each pick, by determinants.
    fn complete_d_optimal(&self, before: &[usize]) -> Vec<(usize, f64)> {
        let within: Vec<_> = (0..self.structures.len()).map(|structure| self.within(structure)).collect();
        let with = |information: &[Vec<f64>; 2], structure: usize| {
            let mut information = information.clone();
            let (elements, features) = &within[structure];
            for (element, z) in elements.iter().zip(features.chunks(D)) {
                (0..D * D).for_each(|k| information[*element][k] += z[k / D] * z[k % D]);
            }
            information
        };
        let size = |information: &[Vec<f64>; 2]| information.iter().map(|m| log_determinant(m)).sum::<f64>();
        let mut information = self.information();
        before.iter().for_each(|structure| information = with(&information, *structure));
        let free = |structure: &usize| !before.contains(structure) && !within[*structure].0.is_empty();
        let mut left: Vec<usize> = (0..self.structures.len()).filter(free).collect();
        let mut picks = Vec::new();
        while !left.is_empty() {
            let gains =
                left.iter().map(|structure| size(&with(&information, *structure)) - size(&information));
            let gains: Vec<f64> = gains.collect();
            let largest = maximum(&gains);
            let structure = left.remove(gains.iter().position(|gain| *gain == largest).unwrap());
            information = with(&information, structure);
            picks.push((structure, largest));
        }
        picks
    }
}

fn log_determinant(matrix: &[f64]) -> f64 {
    let lower = lower_factor(matrix);
    (0..D).map(|k| 2.0 * lower[k * D + k].ln()).sum()
}

/// L of S = LLᵀ, by the textbook's formula.
fn lower_factor(matrix: &[f64]) -> Vec<f64> {
    let mut lower = vec![0.0; D * D];
    for i in 0..D {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|k| lower[i * D + k] * lower[j * D + k]).sum();
            let rest = matrix[i * D + j] - sum;
            lower[i * D + j] = if i == j { rest.sqrt() } else { rest / lower[j * D + j] };
        }
    }
    lower
}

/// Picks by all distances, starting from the atoms of the structures picked `before`.
fn complete_farthest(
    points: &[(usize, usize, Vec<f64>)],
    before: &[usize],
    count: usize,
) -> Vec<(usize, f64)> {
    let mut nearest = vec![f64::INFINITY; points.len()];
    let pick = |nearest: &mut Vec<f64>, centre: usize| {
        for (distance, (_, group, point)) in nearest.iter_mut().zip(points) {
            if *group == points[centre].1 {
                let squared = point.iter().zip(&points[centre].2).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
                *distance = distance.min(squared.sqrt());
            }
        }
    };
    (0..points.len()).filter(|k| before.contains(&points[*k].0)).for_each(|k| pick(&mut nearest, k));
    let mut picks: Vec<(usize, f64)> = Vec::new();
    while picks.len() < count {
        let farthest = nearest.iter().copied().fold(0.0, f64::max);
        if farthest < 1e-9 {
            break;
        }
        let place = nearest.iter().position(|distance| *distance == farthest).unwrap();
        let structure = points[place].0;
        if !before.contains(&structure) && !picks.iter().any(|(s, _)| *s == structure) {
            picks.push((structure, farthest));
        }
        pick(&mut nearest, place);
    }
    picks
}

fn picked(found: &[(usize, f64)]) -> Vec<usize> {
    found.iter().map(|(structure, _)| *structure).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn farthest_points_are_those_of_all_distances(seed in 0_u64..1000, before in 1_usize..4, memory in 0_usize..9000) {
        let case = structures(seed, 30, true, memory);
        let before: Vec<usize> = shuffled(seed, 1, 30).into_iter().take(before).collect();
        // Elements without a picked atom: any of their atoms is infinitely far, and the largest γ decides.
        let points = case.whitened();
        prop_assume!((0..2).all(|e| points.iter().any(|(s, group, _)| before.contains(s) && *group == e)));
        let plain = (0..30).flat_map(|structure| {
            let rows = case.structures[structure].1.chunks(D);
            rows.map(move |row| (structure, 0, row.to_vec())).collect::<Vec<_>>()
        });
        for (metric, points) in [(Metric::Whitened(&case.mixture), points), (Metric::Plain, plain.collect())] {
            let expected = complete_farthest(&points, &before, 12);
            let mut points = FarthestPoints::new(&case.pool, metric, before.iter().copied()).unwrap();
            for (structure, distance) in expected {
                let found = points.pick().unwrap().unwrap();
                prop_assert_eq!(found.structure, structure);
                prop_assert!((found.distance - distance).abs() <= 1e-9 * distance);
            }
        }
    }

    #[test]
    fn d_optimal_picks_have_the_largest_of_all_gains(seed in 0_u64..1000, before in 0_usize..4, memory in 0_usize..9000) {
        let before: Vec<usize> = shuffled(seed, 2, 30).into_iter().take(before).collect();
        // Atoms outside the window change nothing, whether the pool has them or not.
        let case = structures(seed, 30, seed.is_multiple_of(2), memory);
        let expected = case.complete_d_optimal(&before);
        let mut design = DOptimal::new(&case.pool, &case.mixture, before.iter().copied()).unwrap();
        let mut found = Vec::new();
        while let Some(pick) = design.pick().unwrap() {
            found.push((pick.structure, pick.gain));
        }
        prop_assert_eq!(picked(&found), picked(&expected));
        for ((_, gain), (_, expected)) in found.iter().zip(&expected) {
            prop_assert!((gain - expected).abs() <= 1e-9 * expected.max(1.0), "{} {}", gain, expected);
        }
    }
}

#[test]
fn d_optimal_picks_fill_the_directions_that_are_missing() {
    let mixture = Mixture::new(0, vec![vec![Arc::new(Component::unknown_element(2))]]).unwrap();
    let mut pool = Pool::new(2, WINDOW, true, usize::MAX, std::env::temp_dir());
    let mut push = |gamma: f64, features: &[f64]| {
        let atoms = features.len() / 2;
        pool.push(&vec![0; atoms], &vec![0; atoms], &vec![gamma; atoms], features).unwrap();
    };
    push(2.0, &[1.0, 0.0]);
    push(2.0, &[1.0, 0.0]);
    push(2.0, &[0.0, 0.9]);
    // More atoms than features: both directions.
    push(2.0, &[0.3, 0.0, 0.4, 0.0, 0.0, 0.5]);
    push(2.0, &[0.0, 0.0]);
    // Below and above the window.
    push(0.5, &[5.0, 5.0]);
    push(70.0, &[5.0, 5.0]);
    let picks = |before: &[usize]| {
        let mut design = DOptimal::new(&pool, &mixture, before.iter().copied()).unwrap();
        std::iter::from_fn(|| design.pick().unwrap())
            .map(|pick| (pick.structure, pick.gain))
            .collect::<Vec<_>>()
    };
    // Λ = εI, then (ε + 1/4)I; the first of two copies, the direction without it, the second copy.
    let epsilon = 1e-6_f64;
    let expected = [
        (3, 2.0 * (1.0 + 0.25 / epsilon).ln()),
        (0, (1.0 + 1.0 / (0.25 + epsilon)).ln()),
        (2, (1.0 + 0.81 / (0.25 + epsilon)).ln()),
        (1, (1.0 + 1.0 / (1.25 + epsilon)).ln()),
    ];
    let found = picks(&[]);
    assert_eq!(picked(&found), picked(&expected));
    for ((_, gain), (_, expected)) in found.iter().zip(&expected) {
        assert!((gain - expected).abs() < 1e-9, "{gain} {expected}");
    }
    // With one direction picked before, the other comes first.
    assert_eq!(picked(&picks(&[0])), [2, 1, 3]);
}

#[test]
fn without_anything_picked_the_largest_grade_of_each_element_comes_first() {
    fn largest(case: &Structures, element: u16) -> &PoolAtom {
        let atoms = case.pool.atoms().iter().filter(|atom| atom.element == element);
        atoms.max_by(|a, b| a.gamma.total_cmp(&b.gamma)).unwrap()
    }
    let mut cases = (0..).map(|seed| structures(seed, 30, false, usize::MAX));
    let case = cases.find(|case| largest(case, 0).structure != largest(case, 1).structure).unwrap();
    let (first, second) = (largest(&case, 0), largest(&case, 1));
    let mut expected = [first, second];
    expected.sort_by(|a, b| b.gamma.total_cmp(&a.gamma));
    let mut points = FarthestPoints::new(&case.pool, Metric::Whitened(&case.mixture), []).unwrap();
    for atom in expected {
        let found = points.pick().unwrap().unwrap();
        assert_eq!((found.structure, found.distance), (atom.structure as usize, f64::INFINITY));
    }
}

#[test]
fn farthest_points_end_when_only_copies_are_left() {
    let mixture = niobium().mixture;
    let dimension = mixture.dimension();
    let mut pool = Pool::new(dimension, WINDOW, true, usize::MAX, std::env::temp_dir());
    for place in [0.0, 1.0, 0.0, 1.0] {
        pool.push(&[1], &[0], &[2.0], &vec![place; dimension]).unwrap();
    }
    let mut points = FarthestPoints::new(&pool, Metric::Plain, []).unwrap();
    let mut next = || points.pick().unwrap().map(|found| found.structure);
    assert_eq!([next(), next(), next()], [Some(0), Some(1), None]);
}

#[test]
fn a_mixture_without_statistics_cannot_be_updated() {
    let case = structures(1, 5, false, usize::MAX);
    let stripped = case.mixture.iter().fold(vec![Vec::new(); 2], |mut elements, (element, _, component)| {
        let (centroid, inverse) = (component.centroid().to_vec(), component.inverse().to_vec());
        let component = Component::new(centroid, inverse, component.threshold(), None).unwrap();
        elements[element].push(Arc::new(component));
        elements
    });
    let mixture = Mixture::new(0, stripped).unwrap();
    let target: Positive = 1.25.try_into().unwrap();
    let greedy = Greedy::new(&case.pool, &mixture, target, []).map(drop);
    for found in [greedy, DOptimal::new(&case.pool, &mixture, []).map(drop)] {
        let error = found.unwrap_err();
        assert!(matches!(error, SelectionError::Update(UpdateError::NoStatistics { .. })), "{error}");
    }
}
