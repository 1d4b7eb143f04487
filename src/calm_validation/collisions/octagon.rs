//! An explicit pair which features of too low a body order cannot distinguish.

use std::collections::BTreeMap;

use atoms::{Cell, Species, Structure};
use potentials::grace::GraceProjection;
use serde::Serialize;

use crate::all_cores;
use crate::calm_validation::{Subject, ValidationGrader, ValidationProgress, ValidationSettings};

/// Two sets of places on an octagon with the same distances between their members, which neither rotation nor reflection turns into each
/// other: A. L. Patterson, Phys. Rev. 65, 195 (1944). An atom in the middle has the same distances and angles to both, so features of
/// pairs and triples of atoms collide.
const OCTAGON: [[u8; 4]; 2] = [[0, 1, 3, 4], [0, 1, 2, 5]];
/// Radius of the octagon, in distances of equilibrium: neighbours on it are 0.995 of that apart.
const RADIUS: f64 = 1.3;
/// A turn, to see what rounding alone makes of the features.
const TURN: f64 = 0.3;

/// A pair of environments of one element.
#[derive(Clone, Debug, Serialize)]
pub struct Collision {
    /// The element.
    pub element: String,
    /// Distance of the neighbours from the atom, Å.
    pub radius: f64,
    /// The variants of the features.
    pub features: Vec<FeatureDistance>,
    /// Energy of the atom in both environments, eV.
    pub energies: [f64; 2],
    /// Scores of the atom in both environments.
    pub scores: [Vec<f64>; 2],
}

/// How well features distinguish the pair.
#[derive(Clone, Debug, Serialize)]
pub struct FeatureDistance {
    /// Which features.
    pub variant: &'static str,
    /// |z_A − z_B| / |z_A|.
    pub distance: f64,
    /// The same between the first environment and itself after a rotation and a reflection, which is rounding.
    pub rounding: f64,
}

/// Features, energy and scores of an atom.
struct Environment {
    features: Vec<f64>,
    energy: f64,
    scores: Vec<f64>,
}

/// Number of pairs.
pub fn count(settings: &ValidationSettings) -> usize {
    settings.elements.len()
}

/// The pairs of all elements, with their equilibrium distances, Å; elements whose clusters cannot be graded are left out.
pub fn run(
    subject: &Subject,
    settings: &ValidationSettings,
    distances: &BTreeMap<String, f64>,
    progress: &ValidationProgress,
) -> Vec<Collision> {
    let found = all_cores::map(
        settings.elements.iter(),
        || ValidationGrader::new(subject),
        |grader, species| {
            let found = Collision::new(grader, subject, *species, RADIUS * distances[species.symbol()]);
            progress.advance();
            found
        },
    );
    found.into_iter().flatten().collect()
}

impl Collision {
    fn new(grader: &mut ValidationGrader, subject: &Subject, species: Species, radius: f64) -> Option<Self> {
        let mut of = |places: [u8; 4], turn: f64, mirror: f64| {
            Environment::new(grader, &cluster(species, radius, places, turn, mirror))
        };
        let (first, second) = (of(OCTAGON[0], 0.0, 1.0)?, of(OCTAGON[1], 0.0, 1.0)?);
        let turned = of(OCTAGON[0], TURN, -1.0)?;
        let own = FeatureDistance::new("as graded", &first, &second, &turned, |z| z.to_vec());
        let projection = subject.model.grace().and_then(|model| model.projection());
        let linear = projection.filter(|map| map.normalize && map.density_channels && !map.asinh);
        let linear = linear
            .map(|map| FeatureDistance::new("linear", &first, &second, &turned, |z| linear_features(map, z)));
        Some(Self {
            element: species.to_string(),
            radius,
            features: [own].into_iter().chain(linear).collect(),
            energies: [first.energy, second.energy],
            scores: [first.scores, second.scores],
        })
    }
}

impl FeatureDistance {
    fn new(
        variant: &'static str,
        first: &Environment,
        second: &Environment,
        turned: &Environment,
        features: impl Fn(&[f64]) -> Vec<f64>,
    ) -> Self {
        let [first, second, turned] = [first, second, turned].map(|of| features(&of.features));
        let relative = |other: &[f64]| {
            let square = first.iter().zip(other).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
            (square / first.iter().map(|a| a * a).sum::<f64>()).sqrt()
        };
        Self { variant, distance: relative(&second), rounding: relative(&turned) }
    }
}

impl Environment {
    /// The first atom of a cluster. `None` if it cannot be graded.
    fn new(grader: &mut ValidationGrader, cluster: &Structure) -> Option<Self> {
        let graded = grader.grade(cluster).ok()?;
        let potential = &grader.features.potential;
        let features = potential.features()[..potential.model().feature_dimension()].to_vec();
        let scores = graded.scores.iter().map(|of| of[0]).collect();
        Some(Self { features, energy: potential.atomic_energies()[0], scores })
    }
}

/// |B| · (projection of B / |B|): the linear features, from the normalised ones and the logarithm of the norm behind them.
fn linear_features(map: &GraceProjection, z: &[f64]) -> Vec<f64> {
    let norm = (z[map.dimension] / f64::from(map.density_scale)).exp();
    z[..map.dimension].iter().map(|x| norm * x).collect()
}

/// An atom in the middle of an octagon with atoms at some places, turned, and reflected if `mirror` is −1.
fn cluster(species: Species, radius: f64, places: [u8; 4], turn: f64, mirror: f64) -> Structure {
    let place = |k: u8| {
        let angle = std::f64::consts::FRAC_PI_4 * f64::from(k) + turn;
        [mirror * radius * angle.cos(), radius * angle.sin(), 0.0]
    };
    Structure {
        species: vec![species; 5],
        positions: [[0.0; 3]].into_iter().chain(places.map(place)).collect(),
        cell: Cell([[0.0; 3]; 3]),
        periodic: [false; 3],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sorted distances between the atoms of a cluster without its middle.
    fn distances(places: [u8; 4]) -> Vec<f64> {
        let positions = cluster("Al".parse().unwrap(), 2.0, places, 0.4, 1.0).positions[1..].to_vec();
        let pairs = (0..4).flat_map(|i| (0..i).map(move |j| (i, j)));
        let mut found: Vec<_> =
            pairs.map(|(i, j)| atoms::cell::norm(atoms::cell::sub(positions[i], positions[j]))).collect();
        found.sort_by(f64::total_cmp);
        found
    }

    #[test]
    fn the_pair_has_the_same_distances_and_is_not_the_same() {
        let [a, b] = OCTAGON.map(distances);
        assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-12), "{a:?} {b:?}");
        let images = |set: [u8; 4], turn: u8, sign: i8| {
            let mut found = set.map(|k| (turn as i8 + sign * k as i8).rem_euclid(8));
            found.sort_unstable();
            found
        };
        let second = images(OCTAGON[1], 0, 1);
        assert!(
            (0..8)
                .all(|turn| images(OCTAGON[0], turn, 1) != second && images(OCTAGON[0], turn, -1) != second)
        );
    }
}
