//! A long synthetic campaign: what the mixture forgets under convex and under additive updates, and how many structures
//! each collects. Prints a table.
//!
//! Three elements have four Gaussian components each in 32 dimensions; 2,000 atoms of each are the training data. Structures
//! of 24 atoms of one element and phase, which differ by 0.3 of the spread of the training data, drift away along one of 60
//! directions of feature space, which the campaign visits one after the other. A structure is offered; if it is a candidate,
//! the mixture is updated. The campaign ends after 20,000 offered structures.

use std::sync::Arc;

use calm::component::Statistics;
use calm::forgetting::GradeDistribution;
use calm::{
    CollectionRule, Component, CovarianceUpdateKind, Grades, Mixture, UpdateSettings, regularised_inverse,
};

const DIMENSION: usize = 32;
const ELEMENTS: usize = 3;
const COMPONENTS: usize = 4;
const TRAINING_ATOMS: usize = 2000;
const ATOMS: usize = 24;
const DIRECTIONS: usize = 60;
const OFFERS: usize = 20_000;
/// Spread of the atoms of a structure, relative to that of the training data.
const SPREAD: f64 = 0.3;

/// Of the centroids or the atoms of one element.
type Vectors = Vec<Vec<f64>>;

/// xorshift64* and Box–Muller.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        let (a, b) = (1.0 - self.uniform(), self.uniform());
        (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    }

    fn vector(&mut self) -> Vec<f64> {
        (0..DIMENSION).map(|_| self.normal()).collect()
    }
}

/// The training data of one element: its centroids, and atoms around them. Their widths fall off from 1 to 0.03, as the
/// spectrum of real features does.
fn training(random: &mut Random, centroids: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let width = |k: usize| 0.9_f64.powi(k as i32);
    let atom = |atom: usize| {
        let centroid = &centroids[atom % COMPONENTS];
        centroid.iter().enumerate().map(|(k, c)| c + width(k) * random.normal()).collect()
    };
    (0..TRAINING_ATOMS).map(atom).collect()
}

fn component(centroid: &[f64], atoms: &[&Vec<f64>]) -> Arc<Component> {
    let mut scatter = vec![0.0; DIMENSION * DIMENSION];
    for atom in atoms {
        let delta: Vec<f64> = atom.iter().zip(centroid).map(|(z, c)| z - c).collect();
        for (k, value) in scatter.iter_mut().enumerate() {
            *value += delta[k / DIMENSION] * delta[k % DIMENSION];
        }
    }
    let count = atoms.len() as f64;
    let statistics = Statistics { scatter, count, effective_count: count };
    let inverse = regularised_inverse(&statistics.covariance(), DIMENSION).expect("a covariance");
    // 97 % of the training atoms are inside.
    let uncalibrated = Component::new(centroid.to_vec(), inverse.clone(), 1.0, None).expect("a component");
    let mixture = Mixture::new(0, vec![vec![Arc::new(uncalibrated)]]).expect("a mixture");
    let mut sigma =
        gamma(&mixture, 0, &atoms.iter().flat_map(|atom| atom.iter().copied()).collect::<Vec<_>>());
    sigma.sort_by(f64::total_cmp);
    let threshold = sigma[sigma.len() * 97 / 100];
    Arc::new(Component::new(centroid.to_vec(), inverse, threshold, Some(statistics)).expect("a component"))
}

fn gamma(mixture: &Mixture, element: usize, features: &[f64]) -> Vec<f64> {
    let mut grades = Grades::default();
    let elements = vec![element; features.len() / DIMENSION];
    grades.evaluate(mixture, &elements, features, None).expect("finite features");
    grades.gamma
}

fn main() {
    println!("update    accepts  offered  share of training atoms with γ > 1 (largest of an element)");
    for kind in [CovarianceUpdateKind::Convex, CovarianceUpdateKind::Additive] {
        let mut random = Random(7);
        let centroids: Vec<Vec<Vec<f64>>> = (0..ELEMENTS)
            .map(|_| (0..COMPONENTS).map(|_| random.vector().iter().map(|x| 4.0 * x).collect()).collect())
            .collect();
        let data: Vec<Vec<Vec<f64>>> =
            centroids.iter().map(|centroids| training(&mut random, centroids)).collect();
        let elements = centroids.iter().zip(&data).map(|(centroids, atoms)| {
            let own = |slot: usize| atoms.iter().skip(slot).step_by(COMPONENTS).collect::<Vec<_>>();
            centroids.iter().enumerate().map(|(slot, centroid)| component(centroid, &own(slot))).collect()
        });
        let mut mixture = Mixture::new(0, elements.collect()).expect("a mixture");
        let directions: Vec<Vec<f64>> = (0..DIRECTIONS).map(|_| random.vector()).collect();
        campaign(kind, &mut mixture, (&centroids, &data), &directions, &mut random);
    }
}

fn campaign(
    kind: CovarianceUpdateKind,
    mixture: &mut Mixture,
    (centroids, data): (&[Vectors], &[Vectors]),
    directions: &[Vec<f64>],
    random: &mut Random,
) {
    // The paper's rules of the foundation-model expansion.
    let collection: CollectionRule = toml::from_str("rule = 'atom_count'").expect("a rule");
    let settings = UpdateSettings {
        covariance_update: kind,
        alpha_values: None,
        stop: toml::from_str("rule = 'atom_count'").expect("a rule"),
    };
    let (mut accepts, mut offered) = (0, 0);
    while offered < OFFERS {
        // A walk: twenty structures along one direction, each farther than the one before.
        let element = offered / 20 % ELEMENTS;
        let direction = &directions[offered / 20 % DIRECTIONS];
        let distance = 0.25 * (1 + offered % 20) as f64;
        // All atoms belong to one phase, and differ less than the training data do.
        let centroid = &centroids[element][offered / 20 % COMPONENTS];
        let features: Vec<f64> = (0..ATOMS)
            .flat_map(|_| {
                let of = (random.uniform() * (TRAINING_ATOMS / COMPONENTS) as f64) as usize * COMPONENTS;
                let atom = &data[element][of + offered / 20 % COMPONENTS];
                let far = distance * (0.8 + 0.2 * random.uniform());
                let moved = atom.iter().zip(centroid).zip(direction);
                moved.map(|((z, c), d)| c + SPREAD * (z - c) + far * d).collect::<Vec<_>>()
            })
            .collect();
        offered += 1;
        if collection.is_met(&gamma(mixture, element, &features)) {
            let outcome = calm::update(mixture, &[element; ATOMS], &features, &settings).expect("an update");
            *mixture = mixture.with_changes(&outcome.changed).expect("components of this mixture");
            accepts += 1;
            if [1, 10, 30, 100, 300, 1000, 3000].contains(&accepts) {
                report(kind, mixture, data, accepts, offered);
            }
        }
    }
    report(kind, mixture, data, accepts, offered);
}

fn report(
    kind: CovarianceUpdateKind,
    mixture: &Mixture,
    data: &[Vec<Vec<f64>>],
    accepts: usize,
    offered: usize,
) {
    let shares: Vec<f64> = data
        .iter()
        .enumerate()
        .map(|(element, atoms)| {
            GradeDistribution::from_grades(&gamma(mixture, element, &atoms.concat())).share_above_one
        })
        .collect();
    let mean = shares.iter().sum::<f64>() / shares.len() as f64;
    let largest = shares.iter().copied().fold(0.0, f64::max);
    let name = format!("{kind:?}").to_lowercase();
    println!("{name:<9} {accepts:>7}  {offered:>7}  {:.1} % ({:.1} %)", 100.0 * mean, 100.0 * largest);
}
