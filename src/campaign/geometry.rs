//! What the neighbour list of a seed structure shows. The list is built once for all checks of the structure.

use atoms::{NeighbourList, ShortestDistances, Structure, StructureError, shortest_distance};

/// Distances between neighbours in a structure.
#[derive(Clone, Debug)]
pub struct Geometry {
    /// The shortest distance of each pair of elements.
    pub shortest: ShortestDistances,
    /// The two atoms that are closest, and their distance, Å.
    pub closest: Option<(usize, usize, f64)>,
    /// Number of neighbours within the cutoff, summed over the atoms.
    pub bonds: usize,
    /// An atom without neighbours in a structure with several atoms.
    pub isolated: Option<usize>,
    /// The distance of an atom to its nearest neighbour, Å, and the same divided by the sum of their radii: the median
    /// of the atoms, by the ratio.
    pub nearest: Option<(f64, f64)>,
}

impl Geometry {
    /// The neighbours within `cutoff`, Å.
    ///
    /// # Errors
    /// An invalid structure, or far too many neighbours.
    pub fn new(structure: &Structure, cutoff: f64) -> Result<Self, StructureError> {
        let mut neighbours = NeighbourList::new(cutoff, 0.0);
        neighbours.update(structure)?;
        let bonds = |i: &usize| neighbours.neighbours_of(*i).len();
        let is_alone = |i: &usize| structure.len() > 1 && bonds(i) == 0;
        Ok(Self {
            shortest: ShortestDistances::from_neighbours(structure, &neighbours),
            closest: shortest_distance(structure, &neighbours),
            bonds: (0..structure.len()).map(|i| bonds(&i)).sum(),
            isolated: (0..structure.len()).find(is_alone),
            nearest: median_nearest(structure, &neighbours),
        })
    }
}

/// See [`Geometry::nearest`].
fn median_nearest(structure: &Structure, neighbours: &NeighbourList) -> Option<(f64, f64)> {
    let mut bonds = Vec::new();
    let mut nearest: Vec<(f64, f64)> = (0..structure.len())
        .filter_map(|i| {
            neighbours.bonds_within(structure, i, neighbours.cutoff(), &mut bonds);
            let relative = bonds.iter().filter_map(|bond| {
                let other = structure.species[bond.atom as usize];
                Some((bond.r, bond.r / (structure.species[i].radius()? + other.radius()?)))
            });
            relative.min_by(|a, b| a.1.total_cmp(&b.1))
        })
        .collect();
    nearest.sort_by(|a, b| a.1.total_cmp(&b.1));
    nearest.get(nearest.len() / 2).copied()
}

/// Why the cell of a structure cannot have a bias, which is a stress, if it cannot.
pub(super) fn cell_bias_fault(structure: &Structure) -> Option<&'static str> {
    let fault = "the lattice vectors do not span space, so the cell has no volume on which a stress could act: give it a third vector";
    (structure.cell.volume() == 0.0).then_some(fault)
}
