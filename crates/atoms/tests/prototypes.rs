//! Crystals and their defects have the coordination that they are known for.

use atoms::cell::{norm, sub};
use atoms::prototypes::{Facet, Prototype, grain_boundary, slab, vacancy};
use atoms::{Bond, NeighbourList, Species, Structure, shortest_distance};

const CUBIC: [(Prototype, usize); 4] =
    [(Prototype::Fcc, 12), (Prototype::Bcc, 8), (Prototype::Diamond, 4), (Prototype::SimpleCubic, 6)];
/// The hexagonal close packing of spheres.
const IDEAL_HCP: Prototype = Prototype::Hcp { c_over_a: 1.632_993_161_855_452 };

fn aluminium() -> Species {
    "Al".parse().unwrap()
}

/// Number of neighbours of each atom within 1.1 `distance`.
fn coordination(structure: &Structure, distance: f64) -> Vec<usize> {
    let mut neighbours = NeighbourList::new(1.1 * distance, 0.0);
    neighbours.update(structure).unwrap();
    let mut bonds: Vec<Bond> = Vec::new();
    let mut number = |i| {
        neighbours.bonds_within(structure, i, 1.1 * distance, &mut bonds);
        bonds.len()
    };
    (0..structure.len()).map(&mut number).collect()
}

fn shortest(structure: &Structure) -> f64 {
    let mut neighbours = NeighbourList::new(6.0, 0.0);
    neighbours.update(structure).unwrap();
    shortest_distance(structure, &neighbours).unwrap().2
}

#[test]
fn crystals_have_their_coordination() {
    for (prototype, expected) in CUBIC.into_iter().chain([(IDEAL_HCP, 12)]) {
        let crystal = prototype.structure(aluminium(), 2.86);
        assert!(coordination(&crystal, 2.86).iter().all(|found| *found == expected), "{prototype}");
        assert!((shortest(&crystal) - 2.86).abs() < 1e-12, "{prototype}");
    }
}

#[test]
fn every_element_has_a_crystal() {
    for species in (1..=118).map(|number| Species::from_atomic_number(number).unwrap()) {
        let found = species.ground_state();
        let crystal = found.prototype.structure(species, found.distance);
        assert!((shortest(&crystal) - found.distance).abs() < 1e-9, "{species}");
        // Bonds are between a single bond and contact of closed shells.
        let bond = 2.0 * species.covalent_radius();
        assert!((0.74 * bond..2.0 * bond).contains(&found.distance) || bond < 2.2, "{species}: {found:?}");
    }
    let prototype = |symbol: &str| symbol.parse::<Species>().unwrap().ground_state().prototype;
    for (symbol, expected) in
        [("Al", "fcc"), ("Cu", "fcc"), ("Fe", "bcc"), ("Si", "diamond"), ("Ti", "hcp"), ("W", "bcc")]
    {
        assert_eq!(prototype(symbol).to_string(), expected, "{symbol}");
    }
}

#[test]
fn a_vacancy_lowers_the_coordination_of_its_neighbours() {
    for (prototype, sites, expected) in [
        (Prototype::Fcc, 108, 12),
        (Prototype::Bcc, 128, 8),
        (Prototype::Diamond, 216, 4),
        (IDEAL_HCP, 150, 12),
    ] {
        let found = vacancy(prototype, aluminium(), 2.7);
        assert_eq!(found.structure.len(), sites - 1);
        let distances = found.distances();
        for (distance, neighbours) in distances.iter().zip(coordination(&found.structure, 2.7)) {
            let is_next = (distance - 2.7).abs() < 1e-9;
            assert!(is_next || *distance > 3.0, "{prototype}: {distance}");
            assert_eq!(neighbours, expected - usize::from(is_next), "{prototype}: {distance}");
        }
        assert_eq!(distances.iter().filter(|distance| **distance < 3.0).count(), expected);
    }
}

#[test]
fn slabs_have_their_facets() {
    use Facet::{Basal, F100, F110, F111};
    use Prototype::{Bcc, Diamond, Fcc, SimpleCubic};
    for (prototype, facet, layers, of_surface, of_inside) in [
        (Fcc, F111, 9, 9, 12),
        (Fcc, F100, 9, 8, 12),
        (Fcc, F110, 11, 7, 12),
        (Bcc, F111, 15, 4, 8),
        (Bcc, F100, 9, 4, 8),
        (Bcc, F110, 11, 6, 8),
        (Diamond, F111, 12, 3, 4),
        (Diamond, F100, 9, 2, 4),
        (Diamond, F110, 11, 3, 4),
        (SimpleCubic, F100, 9, 5, 6),
        (IDEAL_HCP, Basal, 9, 9, 12),
    ] {
        let found = slab(prototype, aluminium(), 2.8, facet);
        let (structure, name) = (&found.structure, format!("{prototype} {}", facet.name()));
        let per_layer = structure.len() / layers;
        assert_eq!(
            (structure.len() % layers, per_layer % 9, structure.periodic),
            (0, 0, [true, true, false]),
            "{name}"
        );
        assert!((shortest(structure) - 2.8).abs() < 1e-9, "{name}");
        for (layer, neighbours) in found.layers.iter().zip(coordination(structure, 2.8)) {
            match layer {
                0 => assert_eq!(neighbours, of_surface, "{name}"),
                3.. => assert_eq!(neighbours, of_inside, "{name}, layer {layer}"),
                _ => assert!(neighbours <= of_inside, "{name}"),
            }
        }
        let heights: Vec<_> = structure.positions.iter().map(|r| r[2]).collect();
        let top = heights.iter().copied().fold(0.0, f64::max);
        assert!(
            (structure.cell.0[2][2] - top - 12.0).abs() < 1e-9 && heights.iter().all(|z| *z >= 0.0),
            "{name}"
        );
        // The slab has the density of the crystal.
        let crystal = prototype.structure(aluminium(), 2.8);
        let volume =
            structure.cell.volume() * top / structure.cell.0[2][2] * layers as f64 / (layers - 1) as f64;
        let ratio = structure.len() as f64 / volume * crystal.cell.volume() / crystal.len() as f64;
        let tolerance = if prototype == Diamond { 0.1 } else { 1e-9 };
        assert!((ratio - 1.0).abs() < tolerance, "{name}: {ratio}");
    }
}

#[test]
fn a_grain_boundary_is_symmetric_and_without_overlaps() {
    for (prototype, coordination_inside) in [(Prototype::Fcc, 12), (Prototype::Bcc, 8)] {
        let found = grain_boundary(prototype, aluminium(), 2.8).unwrap();
        let (structure, length) = (&found.structure, found.structure.cell.0[0][0]);
        assert!(shortest(structure) > 0.72 * 2.8, "{prototype}: {}", shortest(structure));
        let distances = found.distances();
        for (distance, neighbours) in distances.iter().zip(coordination(structure, 2.8)) {
            assert!(*distance <= 0.25 * length + 1e-9);
            assert!(
                *distance < 4.5 || neighbours == coordination_inside,
                "{prototype}: {neighbours} at {distance} Å"
            );
        }
        assert!(
            distances
                .iter()
                .zip(coordination(structure, 2.8))
                .any(|(d, n)| *d < 3.0 && n != coordination_inside)
        );
        // Mirrored in either boundary, the atoms are the same.
        for plane in found.planes {
            for r in &structure.positions {
                let mirrored = [(2.0 * plane - r[0]).rem_euclid(length), r[1], r[2]];
                let is_there = structure.positions.iter().any(|other| {
                    let d = sub(*other, mirrored);
                    norm([d[0] - length * (d[0] / length).round(), d[1], d[2]]) < 1e-6
                });
                assert!(is_there, "{prototype}: {r:?}");
            }
        }
        // Merged mirror images are all that is missing from the crystal.
        let crystal = prototype.structure(aluminium(), 2.8);
        let expected = structure.cell.volume() * crystal.len() as f64 / crystal.cell.volume();
        let missing = expected - structure.len() as f64;
        assert!(
            (missing - if prototype == Prototype::Fcc { 4.0 } else { 0.0 }).abs() < 1e-6,
            "{prototype}: {missing}"
        );
    }
    assert!(grain_boundary(Prototype::Diamond, aluminium(), 2.35).is_none());
}
