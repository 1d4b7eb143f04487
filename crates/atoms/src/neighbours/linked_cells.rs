//! Linked cells: bins of atoms that limit the neighbour search to nearby atoms.

use super::Neighbour;
use crate::cell::{self, Cell, Vec3};
use crate::structure::{Structure, StructureError};

/// Largest distance from the cell in lattice vectors (in Å along non-periodic directions).
const MAX_DISTANCE: f64 = 1e8;

/// Largest number of bins that the search for one atom may visit.
const MAX_BINS_VISITED: f64 = 1e6;

/// Relative margin of the reach for atoms on the edge of a bin or of the sphere.
const RELATIVE_MARGIN: f64 = 1e-6;

/// All atoms, in the bins of their images inside the cell.
pub(super) struct LinkedCells {
    periodic: [bool; 3],
    /// The cell with unit vectors along non-periodic directions.
    lattice: Cell,
    /// Å
    reach: f64,
    /// Number of bins in each direction.
    counts: [i32; 3],
    /// Number of bins within the reach.
    spans: Vec3,
    /// Coordinates of each atom in units of bins.
    coordinates: Vec<Vec3>,
    /// Lattice translation of each atom from its image inside the cell.
    wraps: Vec<[i32; 3]>,
    /// The image of each atom inside the cell, Å.
    wrapped: Vec<Vec3>,
    /// Index of each bin's first atom in `members`.
    starts: Vec<usize>,
    /// Atoms by bin, with their images inside the cell.
    members: Vec<(u32, Vec3)>,
}

impl LinkedCells {
    /// Sorts the atoms into bins about half of `reach` (Å) wide.
    pub fn new(structure: &Structure, reach: f64) -> Result<Self, StructureError> {
        let periodic = structure.periodic;
        let lattice = structure.cell.completed(periodic);
        let (fractional, wraps) = fractional(structure, &lattice)?;
        let (origin, extent) = bounds(&fractional, periodic);
        let heights = lattice.heights();
        let widths: Vec3 = std::array::from_fn(|k| extent[k] * heights[k]);
        let counts = bin_counts(widths, reach, fractional.len());
        let spans = bin_spans(widths, reach * (1.0 + RELATIVE_MARGIN), counts, periodic)?;
        let in_bins =
            |f: &Vec3| std::array::from_fn(|k| (f[k] - origin[k]) / extent[k] * f64::from(counts[k]));
        let coordinates: Vec<Vec3> = fractional.iter().map(in_bins).collect();
        let inside = |(r, wrap): (&Vec3, &[i32; 3])| cell::sub(*r, lattice.translation(*wrap));
        let wrapped: Vec<Vec3> = structure.positions.iter().zip(&wraps).map(inside).collect();
        let (starts, members) = sort_into(&coordinates, &wrapped, counts);
        Ok(Self { periodic, lattice, reach, counts, spans, coordinates, wraps, wrapped, starts, members })
    }

    /// Calls `visit` for every pair that may be within the reach of atom `i`, each once, including `i` itself,
    /// with the images of a neighbour in ascending order; the flag says whether it certainly is. `near` is
    /// scratch memory.
    pub fn candidates<E>(
        &self,
        i: usize,
        near: &mut Vec<(u32, f64)>,
        mut visit: impl FnMut(Neighbour, bool) -> Result<(), E>,
    ) -> Result<(), E> {
        let runs = self.runs(i);
        let (outer, inner) =
            ((self.reach * (1.0 + RELATIVE_MARGIN)).powi(2), (self.reach * (1.0 - RELATIVE_MARGIN)).powi(2));
        near.resize(self.members.len(), (0, 0.0));
        for (a, image_a) in self.nearby(i, 0) {
            for (b, image_b) in self.nearby(i, 1) {
                let row = flat([a, b, 0], self.counts);
                for &(first, last, image_c) in &runs {
                    let image = [image_a, image_b, image_c];
                    let centre = cell::sub(self.wrapped[i], self.lattice.translation(image));
                    let members = &self.members[self.starts[row + first]..self.starts[row + last + 1]];
                    for &(atom, square) in select(members, centre, outer, near) {
                        let (from, to) = (self.wraps[i], self.wraps[atom as usize]);
                        let image = std::array::from_fn(|k| image[k] + from[k] - to[k]);
                        visit(Neighbour { atom, image }, square < inner)?;
                    }
                }
            }
        }
        Ok(())
    }

    /// First and last bin along direction `k` within the reach of atom `i`, not wrapped into the cell.
    fn range(&self, i: usize, k: usize) -> (i32, i32) {
        let (own, span) = (self.coordinates[i][k], self.spans[k]);
        let (low, high) = ((own - span).floor() as i32, (own + span).floor() as i32);
        if self.periodic[k] { (low, high) } else { (low.max(0), high.min(self.counts[k] - 1)) }
    }

    /// These bins, each with its lattice translation.
    fn nearby(&self, i: usize, k: usize) -> impl Iterator<Item = (i32, i32)> {
        let ((low, high), count) = (self.range(i, k), self.counts[k]);
        let first = (low.rem_euclid(count), low.div_euclid(count));
        // Incremented, because a division per bin would dominate the search.
        let next = move |&(bin, image): &(i32, i32)| {
            Some(if bin + 1 == count { (0, image + 1) } else { (bin + 1, image) })
        };
        std::iter::successors(Some(first), next).take((high - low + 1).max(0) as usize)
    }

    /// These bins along the last direction, where adjacent bins are adjacent in memory: first and last bin
    /// inside each image of the cell, with its lattice translation.
    fn runs(&self, i: usize) -> Vec<(usize, usize, i32)> {
        let ((low, high), count) = (self.range(i, 2), self.counts[2]);
        let images = low.div_euclid(count)..=high.div_euclid(count);
        let run = |image: i32| {
            let (first, last) = (low.max(image * count), high.min(image * count + count - 1));
            ((first - image * count) as usize, (last - image * count) as usize, image)
        };
        images.map(run).collect()
    }
}

/// The members with squared distance below `outer`, and these squared distances, Å².
fn select<'a>(
    members: &[(u32, Vec3)],
    centre: Vec3,
    outer: f64,
    near: &'a mut [(u32, f64)],
) -> &'a [(u32, f64)] {
    let mut count = 0;
    for &(atom, r) in members {
        let d = cell::sub(r, centre);
        let square = cell::dot(d, d);
        // Write always and count only if near: a branch would be mispredicted every few atoms.
        near[count] = (atom, square);
        count += usize::from(square <= outer);
    }
    &near[..count]
}

/// Fractional coordinates wrapped into the cell along periodic directions, and the translations removed.
fn fractional(structure: &Structure, lattice: &Cell) -> Result<(Vec<Vec3>, Vec<[i32; 3]>), StructureError> {
    let reciprocal = lattice.reciprocal();
    let mut fractional = Vec::with_capacity(structure.len());
    let mut wraps = Vec::with_capacity(structure.len());
    for (atom, position) in structure.positions.iter().enumerate() {
        let f = reciprocal.map(|b| cell::dot(b, *position));
        if !f.iter().all(|x| x.abs() <= MAX_DISTANCE) {
            return Err(StructureError::FarAway { atom, limit: MAX_DISTANCE });
        }
        let wrap: Vec3 = std::array::from_fn(|k| if structure.periodic[k] { f[k].floor() } else { 0.0 });
        fractional.push(cell::sub(f, wrap));
        wraps.push(wrap.map(|x| x as i32));
    }
    Ok((fractional, wraps))
}

/// Origin and extent of the bins in fractional coordinates: the cell along periodic directions, else the atoms.
fn bounds(fractional: &[Vec3], periodic: [bool; 3]) -> (Vec3, Vec3) {
    let mut origin = [0.0; 3];
    let mut extent = [1.0; 3];
    for k in (0..3).filter(|k| !periodic[*k]) {
        let low = fractional.iter().map(|f| f[k]).fold(f64::INFINITY, f64::min);
        let high = fractional.iter().map(|f| f[k]).fold(f64::NEG_INFINITY, f64::max);
        origin[k] = low;
        extent[k] = (high - low).max(1e-3);
    }
    (origin, extent)
}

/// Bins of at least half the reach, and not many more than there are atoms.
fn bin_counts(widths: Vec3, reach: f64, atoms: usize) -> [i32; 3] {
    let mut counts = widths.map(|width| (2.0 * width / reach).floor().clamp(1.0, 1e6));
    while counts.iter().product::<f64>() > 4.0 * atoms as f64 + 64.0 {
        let largest = counts.iter().copied().fold(1.0, f64::max);
        counts = counts.map(|count| if count == largest { (count / 2.0).floor().max(1.0) } else { count });
    }
    counts.map(|count| (count as i32).max(1))
}

/// Number of bins within the reach in each direction.
fn bin_spans(
    widths: Vec3,
    reach: f64,
    counts: [i32; 3],
    periodic: [bool; 3],
) -> Result<Vec3, StructureError> {
    let spans: Vec3 = std::array::from_fn(|k| reach * f64::from(counts[k]) / widths[k]);
    let visited = |k: usize| {
        if periodic[k] {
            2.0 * spans[k].ceil() + 1.0
        } else {
            f64::from(counts[k]).min(2.0 * spans[k].ceil() + 1.0)
        }
    };
    if (0..3).map(visited).product::<f64>() > MAX_BINS_VISITED {
        let height = (0..3).filter(|k| periodic[*k]).map(|k| widths[k]).fold(f64::INFINITY, f64::min);
        return Err(StructureError::CellThin { height, reach });
    }
    Ok(spans)
}

/// Counting sort of the atoms by bin: start of each bin and the atoms in order.
fn sort_into(coordinates: &[Vec3], wrapped: &[Vec3], counts: [i32; 3]) -> (Vec<usize>, Vec<(u32, Vec3)>) {
    let bin = |x: &Vec3| flat(std::array::from_fn(|k| (x[k] as i32).clamp(0, counts[k] - 1)), counts);
    let mut starts = vec![0; counts.iter().map(|count| *count as usize).product::<usize>() + 1];
    for x in coordinates {
        starts[bin(x) + 1] += 1;
    }
    for index in 1..starts.len() {
        starts[index] += starts[index - 1];
    }
    let mut next = starts.clone();
    let mut members = vec![(0, [0.0; 3]); coordinates.len()];
    for (atom, x) in coordinates.iter().enumerate() {
        let slot = &mut next[bin(x)];
        members[*slot] = (atom as u32, wrapped[atom]);
        *slot += 1;
    }
    (starts, members)
}

fn flat(bin: [i32; 3], counts: [i32; 3]) -> usize {
    ((bin[0] * counts[1] + bin[1]) * counts[2] + bin[2]) as usize
}
