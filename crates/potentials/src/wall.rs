//! A wall around a cluster.

use atoms::{Evaluation, Structure, Vec3, cell};
use serde::{Deserialize, Serialize};

/// A wall around each cluster.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct WallSettings {
    /// Distance of the wall from the farthest atom, Å.
    pub margin: f64,
    /// k, eV/Å².
    pub stiffness: f64,
}

impl Default for WallSettings {
    /// That of `grace_uq hal`.
    fn default() -> Self {
        Self { margin: 2.0, stiffness: 1.0 }
    }
}

/// A sphere about the centre of mass c that holds atoms together: E = ½ k Σ max(0, |r − c| − R)². Energy in eV, lengths in Å. It has
/// no virial, because a cluster has no volume. It moves with the cluster, so its forces have no sum: the momentum is conserved, and
/// 3n − 3 degrees of freedom are left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wall {
    radius: f64,
    stiffness: f64,
}

impl Wall {
    /// Beyond the farthest atom of a cluster.
    pub fn around(cluster: &Structure, settings: &WallSettings) -> Self {
        let (centre, _) = centre_of_mass(cluster);
        let distances = cluster.positions.iter().map(|r| cell::norm(cell::sub(*r, centre)));
        let farthest = distances.fold(0.0, f64::max);
        Self { radius: farthest + settings.margin, stiffness: settings.stiffness }
    }

    /// Adds energy and forces.
    pub fn add(&self, structure: &Structure, out: &mut Evaluation) {
        let (centre, mass) = centre_of_mass(structure);
        let mut sum = [0.0; 3];
        let results = out.atomic_energies.iter_mut().zip(&mut out.forces);
        for (r, (energy, force)) in structure.positions.iter().zip(results) {
            let from_centre = cell::sub(*r, centre);
            let distance = cell::norm(from_centre);
            let beyond = distance - self.radius;
            if beyond > 0.0 {
                *energy += 0.5 * self.stiffness * beyond * beyond;
                let inwards = cell::scale(from_centre, -self.stiffness * beyond / distance);
                *force = cell::add(*force, inwards);
                sum = cell::add(sum, inwards);
            }
        }
        // The centre follows each atom by its share of the mass.
        for (species, force) in structure.species.iter().zip(&mut out.forces) {
            *force = cell::sub(*force, cell::scale(sum, species.mass() / mass));
        }
    }
}

/// The centre of mass, Å, and the mass, u.
fn centre_of_mass(structure: &Structure) -> (Vec3, f64) {
    let (mut centre, mut mass) = ([0.0; 3], 0.0);
    for (r, species) in structure.positions.iter().zip(&structure.species) {
        centre = cell::add(centre, cell::scale(*r, species.mass()));
        mass += species.mass();
    }
    (cell::scale(centre, 1.0 / mass), mass)
}

#[cfg(test)]
mod tests {
    use super::*;
    use atoms::Cell;

    fn cluster(positions: &[Vec3]) -> Structure {
        Structure {
            species: ["Al", "H", "Al"].map(|symbol| symbol.parse().unwrap()).to_vec(),
            positions: positions.to_vec(),
            cell: Cell([[0.0; 3]; 3]),
            periodic: [false; 3],
        }
    }

    #[test]
    fn the_wall_pulls_back_what_has_left() {
        let start = cluster(&[[1.0, 0.0, 0.0], [3.0, 4.0, 0.0], [5.0, 0.0, 0.0]]);
        let wall = Wall::around(&start, &WallSettings { margin: 1.5, stiffness: 2.0 });
        let [aluminium, _, _] = [0, 1, 2].map(|k: usize| start.species[k].mass());
        let hydrogen = start.species[1].mass();
        let y = 4.0 * hydrogen / (2.0 * aluminium + hydrogen);
        assert!((wall.radius - (4.0 - y + 1.5)).abs() < 1e-12, "{wall:?}");
        let evaluate = |structure: &Structure| {
            let mut out = Evaluation::default();
            out.reset(3);
            wall.add(structure, &mut out);
            out
        };
        assert_eq!(evaluate(&start).energy(), 0.0);
        let left = cluster(&[[1.0, 0.0, 0.0], [3.0 + 4.0, 4.0 + y, 3.0], [-3.0, 1.0, 0.5]]);
        let found = evaluate(&left);
        let mass = 2.0 * aluminium + hydrogen;
        let centre = [
            -2.0 * aluminium + 7.0 * hydrogen,
            aluminium + (4.0 + y) * hydrogen,
            0.5 * aluminium + 3.0 * hydrogen,
        ];
        let from_centre = cell::sub(left.positions[1], cell::scale(centre, 1.0 / mass));
        let beyond = cell::norm(from_centre) - wall.radius;
        assert!(beyond > 1.0 && (found.atomic_energies[1] - beyond * beyond).abs() < 1e-12, "{found:?}");
        assert_eq!(found.atomic_energies[0], 0.0);
        // It moves with the cluster.
        let sum = found.forces.iter().fold([0.0; 3], |sum, force| cell::add(sum, *force));
        assert!(cell::norm(sum) < 1e-12 && cell::norm(found.forces[1]) > 1.0, "{found:?}");
        let mut elsewhere = left.clone();
        elsewhere.positions.iter_mut().for_each(|r| *r = cell::add(*r, [100.0, -30.0, 7.0]));
        assert!((evaluate(&elsewhere).energy() - found.energy()).abs() < 1e-10);
        // Forces are the derivative of the energy.
        for atom in 0..3 {
            for axis in 0..3 {
                let energy = |shift: f64| {
                    let mut moved = left.clone();
                    moved.positions[atom][axis] += shift;
                    evaluate(&moved).energy()
                };
                let slope = (energy(1e-5) - energy(-1e-5)) / 2e-5;
                assert!((found.forces[atom][axis] + slope).abs() < 1e-8, "{atom} {axis}");
            }
        }
    }
}
