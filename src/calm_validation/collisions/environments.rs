//! Environments of an atom: random ones, and how different two are.

use atoms::Vec3;
use atoms::cell::{add, dot, norm, scale, sub};

use crate::calm_validation::random::RandomSequence;

/// Places that are tried for each neighbour.
const TRIES: usize = 1000;

/// Neighbours at random places around an atom at the origin, all within `radius` of it and at least `closest` from it and from each other,
/// Å. `None` if there seems to be no room.
pub fn random_neighbours(
    number: usize,
    radius: f64,
    closest: f64,
    random: &mut RandomSequence,
) -> Option<Vec<Vec3>> {
    let mut neighbours: Vec<Vec3> = Vec::with_capacity(number);
    for _ in 0..TRIES * number {
        if neighbours.len() == number {
            break;
        }
        let place = [(); 3].map(|()| radius * (2.0 * random.uniform() - 1.0));
        let is_free = |other: &Vec3| norm(sub(place, *other)) >= closest;
        if (closest..=radius).contains(&norm(place)) && neighbours.iter().all(is_free) {
            neighbours.push(place);
        }
    }
    (neighbours.len() == number).then_some(neighbours)
}

/// How different two environments with the same number of neighbours are, Å. Rotations, reflections and other numbers of the atoms make no
/// environment different for the first two.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EnvironmentDifference {
    /// Root mean square difference of the sorted distances between all atoms.
    pub distances: f64,
    /// The same of the neighbours' root mean square distances from the other atoms, sorted: these also differ for different sets of
    /// points with the same distances.
    pub spreads: f64,
    /// Root mean square distance of the atoms after the best superposition, without another order of the atoms.
    pub superposed: f64,
}

impl EnvironmentDifference {
    /// Between environments of an atom at the origin.
    pub fn new(a: &[Vec3], b: &[Vec3]) -> Self {
        let [a, b] = [a, b].map(|neighbours| [&[[0.0; 3]][..], neighbours].concat());
        Self {
            distances: root_mean_square(&distances(&a), &distances(&b)),
            spreads: root_mean_square(&spreads(&a), &spreads(&b)),
            superposed: superposed(&a, &b),
        }
    }

    /// Whether no rotation, reflection and order of the neighbours makes them equal up to `tolerance`, Å. False does not mean that one
    /// does.
    pub fn excludes_symmetry(&self, tolerance: f64) -> bool {
        self.distances.max(self.spreads) > tolerance
    }
}

/// All distances between atoms, sorted.
fn distances(atoms: &[Vec3]) -> Vec<f64> {
    let pairs = (0..atoms.len()).flat_map(|i| (0..i).map(move |j| (i, j)));
    sorted(pairs.map(|(i, j)| norm(sub(atoms[i], atoms[j]))).collect())
}

/// Root mean square distance of each neighbour from the other atoms, sorted. The first atom is no neighbour.
fn spreads(atoms: &[Vec3]) -> Vec<f64> {
    let square = |a: &Vec3, b: &Vec3| dot(sub(*a, *b), sub(*a, *b));
    let others = atoms.len().saturating_sub(1).max(1) as f64;
    let spread = |atom: &Vec3| (atoms.iter().map(|other| square(atom, other)).sum::<f64>() / others).sqrt();
    sorted(atoms.iter().skip(1).map(spread).collect())
}

fn sorted(mut numbers: Vec<f64>) -> Vec<f64> {
    numbers.sort_by(f64::total_cmp);
    numbers
}

fn root_mean_square(a: &[f64], b: &[f64]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
    (sum / a.len().max(1) as f64).sqrt()
}

/// Root mean square distance after the best translation, rotation and reflection: W. Kabsch, Acta Cryst. A32, 922 (1976). The largest trace of
/// H Q over all orthogonal Q is the sum of the singular values of H = Σ a bᵀ.
fn superposed(a: &[Vec3], b: &[Vec3]) -> f64 {
    let number = a.len().max(1) as f64;
    let centred = |atoms: &[Vec3]| -> Vec<Vec3> {
        let mean = scale(atoms.iter().fold([0.0; 3], |sum, r| add(sum, *r)), 1.0 / number);
        atoms.iter().map(|r| sub(*r, mean)).collect()
    };
    let (a, b) = (centred(a), centred(b));
    let mut product = [[0.0; 3]; 3];
    let mut squares = 0.0;
    for (a, b) in a.iter().zip(&b) {
        for (row, x) in product.iter_mut().zip(a) {
            *row = add(*row, scale(*b, *x));
        }
        squares += dot(*a, *a) + dot(*b, *b);
    }
    let gram = product.map(|row| product.map(|other| dot(row, other)));
    let singular: f64 = eigenvalues(gram).iter().map(|value| value.max(0.0).sqrt()).sum();
    ((squares - 2.0 * singular).max(0.0) / number).sqrt()
}

/// Eigenvalues of a symmetric matrix: O. K. Smith, Commun. ACM 4, 168 (1961).
fn eigenvalues(a: [Vec3; 3]) -> [f64; 3] {
    let mean = (a[0][0] + a[1][1] + a[2][2]) / 3.0;
    let deviation: [Vec3; 3] =
        [0, 1, 2].map(|i| [0, 1, 2].map(|k| if i == k { a[i][k] - mean } else { a[i][k] }));
    let size = (deviation.as_flattened().iter().map(|x| x * x).sum::<f64>() / 6.0).sqrt();
    if size == 0.0 {
        return [mean; 3];
    }
    let [x, y, z] = deviation.map(|row| scale(row, 1.0 / size));
    let half = 0.5 * dot(x, atoms::cell::cross(y, z));
    let angle = half.clamp(-1.0, 1.0).acos() / 3.0;
    let value = |turn: f64| mean + 2.0 * size * (angle + turn).cos();
    [0.0, 1.0, 2.0].map(|third| value(third * std::f64::consts::TAU / 3.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn random(number: usize) -> Vec<Vec3> {
        random_neighbours(number, 5.0, 1.5, &mut RandomSequence::new(3, number as u64)).unwrap()
    }

    #[test]
    fn random_environments_keep_their_distances() {
        let neighbours = random(40);
        let atoms = [&[[0.0; 3]][..], &neighbours[..]].concat();
        assert!(distances(&atoms)[0] >= 1.5 && neighbours.iter().all(|r| norm(*r) <= 5.0));
        assert!(random_neighbours(200, 2.0, 1.5, &mut RandomSequence::new(3, 0)).is_none());
    }

    #[test]
    fn images_are_not_different() {
        let own = random(12);
        // Turned about an axis, reflected, and in another order.
        let (sine, cosine) = 0.7_f64.sin_cos();
        let turned = |r: &Vec3| [cosine * r[0] - sine * r[1], sine * r[0] + cosine * r[1], -r[2]];
        let image: Vec<_> = own.iter().map(turned).collect();
        let found = EnvironmentDifference::new(&own, &image);
        assert!(found.superposed < 1e-5 && !found.excludes_symmetry(1e-9), "{found:?}");
        let reversed: Vec<_> = image.iter().rev().copied().collect();
        let found = EnvironmentDifference::new(&own, &reversed);
        assert!(found.superposed > 0.5 && !found.excludes_symmetry(1e-9), "{found:?}");
    }

    #[test]
    fn a_moved_atom_is_a_difference() {
        let (own, mut moved) = (random(12), random(12));
        moved[3] = scale(moved[3], 1.1);
        let found = EnvironmentDifference::new(&own, &moved);
        assert!(found.excludes_symmetry(1e-2), "{found:?}");
        // The best superposition is at least as good as none.
        let length = norm(sub(own[3], moved[3]));
        assert!(found.superposed > 0.0 && found.superposed <= length / 13.0_f64.sqrt(), "{found:?}");
    }

    #[test]
    fn eigenvalues_are_those_of_a_rotated_diagonal() {
        let (sine, cosine) = 0.4_f64.sin_cos();
        // diag(1, 4, 9), turned about the third axis.
        let [a, b, c] = [cosine * cosine + 4.0 * sine * sine, -3.0 * sine * cosine, 5.0];
        let mut found = eigenvalues([[a, b, 0.0], [b, c - a, 0.0], [0.0, 0.0, 9.0]]);
        found.sort_by(f64::total_cmp);
        assert!(found.iter().zip([1.0, 4.0, 9.0]).all(|(x, y)| (x - y).abs() < 1e-9), "{found:?}");
        assert_eq!(eigenvalues([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]), [2.0; 3]);
    }
}
