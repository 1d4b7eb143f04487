//! Pairs of elements, and the shortest distances between their atoms.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{NeighbourList, Species, Structure, cell};

/// Two elements, in either order: `Al-O` is `O-Al`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ElementPair(Species, Species);

/// The shortest distance between atoms of each pair of elements in a structure, with periodic images.
#[derive(Clone, Debug, PartialEq)]
pub struct ShortestDistances {
    /// The elements of the structure, ascending.
    elements: Vec<Species>,
    /// Index of each atom's element.
    indices: Vec<usize>,
    /// Squared, `[i * elements + j]` with i ≤ j, Å²; infinite where no pair was added.
    squared: Vec<f64>,
}

impl ElementPair {
    /// The pair of two elements.
    pub fn new(a: Species, b: Species) -> Self {
        Self(a.min(b), a.max(b))
    }

    /// Sum of the covalent radii, Å.
    pub fn covalent_radii(self) -> f64 {
        self.0.covalent_radius() + self.1.covalent_radius()
    }
}

impl TryFrom<String> for ElementPair {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let parse = |(a, b): (&str, &str)| Some(Self::new(a.parse().ok()?, b.parse().ok()?));
        text.split_once('-')
            .and_then(parse)
            .ok_or_else(|| format!("'{text}' is not a pair of elements (expected one such as Si-O)"))
    }
}

impl From<ElementPair> for String {
    fn from(pair: ElementPair) -> Self {
        pair.to_string()
    }
}

impl fmt::Display for ElementPair {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.0, self.1)
    }
}

impl ShortestDistances {
    /// Of a structure with these elements, before any pair was added.
    pub fn new(structure: &Structure) -> Self {
        let mut elements = structure.species.clone();
        elements.sort_unstable();
        elements.dedup();
        let index = |species| elements.binary_search(species).unwrap_or_default();
        let indices = structure.species.iter().map(index).collect();
        let squared = vec![f64::INFINITY; elements.len() * elements.len()];
        Self { elements, indices, squared }
    }

    /// Of the pairs in a neighbour list.
    pub fn from_neighbours(structure: &Structure, neighbours: &NeighbourList) -> Self {
        let mut shortest = Self::new(structure);
        for i in 0..neighbours.len() {
            for neighbour in neighbours.later_neighbours_of(i) {
                let d = neighbour.displacement(structure, i);
                shortest.add(i, neighbour.atom as usize, cell::dot(d, d));
            }
        }
        shortest
    }

    /// Adds a pair of atoms with its squared distance, Å².
    pub fn add(&mut self, i: usize, j: usize, squared: f64) {
        let (a, b) = (self.indices[i], self.indices[j]);
        let shortest = &mut self.squared[a.min(b) * self.elements.len() + a.max(b)];
        if squared < *shortest {
            *shortest = squared;
        }
    }

    /// Each pair of elements of the structure with its shortest distance, Å; infinite if no pair was added.
    pub fn iter(&self) -> impl Iterator<Item = (ElementPair, f64)> + '_ {
        let n = self.elements.len();
        let pairs = (0..n).flat_map(move |a| (a..n).map(move |b| (a, b)));
        pairs.map(move |(a, b)| {
            (ElementPair(self.elements[a], self.elements[b]), self.squared[a * n + b].sqrt())
        })
    }

    /// The shortest distance of all, Å; infinite if no pair was added.
    pub fn shortest(&self) -> f64 {
        self.squared.iter().copied().fold(f64::INFINITY, f64::min).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Cell;

    #[test]
    fn each_pair_of_elements_has_its_shortest_distance() {
        let species = ["O", "H", "H", "Al"].map(|symbol| symbol.parse().unwrap()).to_vec();
        let structure = Structure {
            species,
            positions: vec![[0.0; 3], [0.96, 0.0, 0.0], [-0.24, 0.93, 0.0], [0.0, 0.0, 2.0]],
            cell: Cell::orthorhombic(4.0, 4.0, 4.0),
            periodic: [true; 3],
        };
        let mut neighbours = NeighbourList::new(4.5, 0.0);
        neighbours.update(&structure).unwrap();
        let shortest = ShortestDistances::from_neighbours(&structure, &neighbours);
        let found: Vec<_> = shortest.iter().map(|(pair, d)| (pair.to_string(), d)).collect();
        let expected = [
            ("H-H", (1.2_f64 * 1.2 + 0.93 * 0.93).sqrt()),
            ("H-O", 0.96),
            ("H-Al", (0.96_f64 * 0.96 + 4.0).sqrt()),
            ("O-O", 4.0),
            ("O-Al", 2.0),
            ("Al-Al", 4.0),
        ];
        assert_eq!(found.len(), expected.len());
        for ((pair, d), (name, distance)) in found.iter().zip(expected) {
            assert!(pair == name && (d - distance).abs() < 1e-12, "{pair} {d}, expected {name} {distance}");
        }
        assert!((shortest.shortest() - 0.96).abs() < 1e-12);
    }

    #[test]
    fn pairs_have_no_order() {
        let parse = |text: &str| ElementPair::try_from(text.to_owned());
        assert_eq!(parse("O-Al"), parse("Al-O"));
        assert_eq!(parse("O-Al").unwrap().to_string(), "O-Al");
        assert!((parse("H-O").unwrap().covalent_radii() - 0.97).abs() < 1e-12);
        assert!(parse("Al").is_err() && parse("Al-X").is_err());
    }
}
