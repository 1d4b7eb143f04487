//! Linked cells: atoms sorted into bins, so that the search for neighbours looks nearby only.

use super::Neighbour;
use crate::cell::{Cell, Vec3};
use crate::structure::{Structure, StructureError};

/// Atoms farther than this many lattice vectors (Å where nothing repeats) from the cell are refused.
const FARTHEST: f64 = 1e8;

/// A search that would visit more bins than this for one atom is refused.
const MOST_BINS_VISITED: f64 = 1e6;

/// Every atom in the bin of its image inside the cell.
pub(super) struct LinkedCells {
    periodic: [bool; 3],
    /// Number of bins in each direction.
    counts: [i32; 3],
    /// How many bins away the reach extends.
    span: [i32; 3],
    /// Bin of each atom.
    bins: Vec<[i32; 3]>,
    /// Lattice translation of each atom from its image inside the cell.
    wraps: Vec<[i32; 3]>,
    /// Where each bin starts in `members`.
    starts: Vec<usize>,
    /// Atoms, bin by bin.
    members: Vec<u32>,
}

impl LinkedCells {
    /// Sorts the atoms into bins about half of `reach` (Å) wide.
    pub fn new(structure: &Structure, reach: f64) -> Result<Self, StructureError> {
        let periodic = structure.periodic;
        let lattice = structure.cell.completed(periodic);
        // A hair more than the reach covers what rounding does to atoms on the edge of a bin.
        let reach = reach * (1.0 + 1e-6);
        let (fractional, wraps) = wrapped(structure, &lattice)?;
        let (origin, extent) = bounds(&fractional, periodic);
        let widths: Vec3 = std::array::from_fn(|k| extent[k] * lattice.heights()[k]);
        let counts = bin_counts(widths, reach, fractional.len());
        let span = bin_span(widths, reach, counts, periodic)?;
        let bins: Vec<[i32; 3]> = fractional
            .iter()
            .map(|f| {
                std::array::from_fn(|k| {
                    let bin = (f[k] - origin[k]) / extent[k] * f64::from(counts[k]);
                    (bin as i32).clamp(0, counts[k] - 1)
                })
            })
            .collect();
        let (starts, members) = sort_into(&bins, counts);
        Ok(Self { periodic, counts, span, bins, wraps, starts, members })
    }

    /// Shows `visit` every pair that may lie within the reach of atom `i`, each once, `i` itself included.
    pub fn candidates<E>(
        &self,
        i: usize,
        mut visit: impl FnMut(Neighbour) -> Result<(), E>,
    ) -> Result<(), E> {
        for (a, image_a) in self.nearby(i, 0) {
            for (b, image_b) in self.nearby(i, 1) {
                for (c, image_c) in self.nearby(i, 2) {
                    let index = flat([a, b, c], self.counts);
                    for &atom in &self.members[self.starts[index]..self.starts[index + 1]] {
                        let wrap = self.wraps[atom as usize];
                        visit(Neighbour {
                            atom,
                            image: [image_a - wrap[0], image_b - wrap[1], image_c - wrap[2]],
                        })?;
                    }
                }
            }
        }
        Ok(())
    }

    /// The bins along direction `k` within the reach of atom `i`, each with the lattice translation to it from the atom.
    fn nearby(&self, i: usize, k: usize) -> impl Iterator<Item = (i32, i32)> {
        let (own, span, count) = (self.bins[i][k], self.span[k], self.counts[k]);
        let (low, high) = (own - span, own + span);
        let (low, high) = if self.periodic[k] { (low, high) } else { (low.max(0), high.min(count - 1)) };
        let first = (low.rem_euclid(count), low.div_euclid(count) + self.wraps[i][k]);
        // Counted on, since a division for each bin would take longer than the rest of the search.
        let next = move |&(bin, image): &(i32, i32)| {
            Some(if bin + 1 == count { (0, image + 1) } else { (bin + 1, image) })
        };
        std::iter::successors(Some(first), next).take((high - low + 1).max(0) as usize)
    }
}

/// Fractional coordinates brought into the cell where it repeats, and the translations taken off.
fn wrapped(structure: &Structure, lattice: &Cell) -> Result<(Vec<Vec3>, Vec<[i32; 3]>), StructureError> {
    let reciprocal = lattice.reciprocal();
    let mut fractional = Vec::with_capacity(structure.len());
    let mut wraps = Vec::with_capacity(structure.len());
    for (atom, position) in structure.positions.iter().enumerate() {
        let f = reciprocal.map(|b| crate::cell::dot(b, *position));
        if !f.iter().all(|x| x.abs() <= FARTHEST) {
            return Err(StructureError::FarAway { atom, limit: FARTHEST });
        }
        let wrap: Vec3 = std::array::from_fn(|k| if structure.periodic[k] { f[k].floor() } else { 0.0 });
        fractional.push(crate::cell::sub(f, wrap));
        wraps.push(wrap.map(|x| x as i32));
    }
    Ok((fractional, wraps))
}

/// Origin and extent of the bins in fractional coordinates: the cell where it repeats, else the atoms.
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

/// Bins of at least half the reach, and not many more bins than atoms.
fn bin_counts(widths: Vec3, reach: f64, atoms: usize) -> [i32; 3] {
    let mut counts = widths.map(|width| (2.0 * width / reach).floor().clamp(1.0, 1e6));
    while counts.iter().product::<f64>() > 4.0 * atoms as f64 + 64.0 {
        let largest = counts.iter().copied().fold(1.0, f64::max);
        counts = counts.map(|count| if count == largest { (count / 2.0).floor().max(1.0) } else { count });
    }
    counts.map(|count| (count as i32).max(1))
}

/// How many bins away the reach extends in each direction.
fn bin_span(
    widths: Vec3,
    reach: f64,
    counts: [i32; 3],
    periodic: [bool; 3],
) -> Result<[i32; 3], StructureError> {
    let mut span: Vec3 = std::array::from_fn(|k| (reach * f64::from(counts[k]) / widths[k]).ceil());
    for k in (0..3).filter(|k| !periodic[*k]) {
        span[k] = span[k].min(f64::from(counts[k] - 1));
    }
    if span.iter().map(|s| 2.0 * s + 1.0).product::<f64>() > MOST_BINS_VISITED {
        let height = (0..3).filter(|k| periodic[*k]).map(|k| widths[k]).fold(f64::INFINITY, f64::min);
        return Err(StructureError::CellThin { height, reach });
    }
    Ok(span.map(|s| s as i32))
}

/// Counting sort of the atoms by bin: the start of each bin, and the atoms bin by bin.
fn sort_into(bins: &[[i32; 3]], counts: [i32; 3]) -> (Vec<usize>, Vec<u32>) {
    let mut starts = vec![0; counts.iter().map(|count| *count as usize).product::<usize>() + 1];
    for bin in bins {
        starts[flat(*bin, counts) + 1] += 1;
    }
    for index in 1..starts.len() {
        starts[index] += starts[index - 1];
    }
    let mut next = starts.clone();
    let mut members = vec![0; bins.len()];
    for (atom, bin) in bins.iter().enumerate() {
        let slot = &mut next[flat(*bin, counts)];
        members[*slot] = atom as u32;
        *slot += 1;
    }
    (starts, members)
}

fn flat(bin: [i32; 3], counts: [i32; 3]) -> usize {
    ((bin[0] * counts[1] + bin[1]) * counts[2] + bin[2]) as usize
}
