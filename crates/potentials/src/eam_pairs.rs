//! The pair terms of the embedded-atom method: densities and pair energies, and, given F′(ρ), forces.

use atoms::{Evaluation, NeighbourList};

use crate::eam_spline::{self, Cubic};
use crate::grace::SimdPass;
use crate::near_pairs::{LANES, Lanes, NearPairs, sum};
use crate::setfl::{EamStyle, Setfl};

/// φ(r) and ρ(r) of each ordered pair of elements.
#[derive(Clone, Debug)]
pub(crate) struct Functions {
    /// Cutoff, Å.
    pub cutoff: f64,
    /// 1 / spacing of r, 1/Å.
    scale: f64,
    elements: usize,
    /// Number of intervals per pair of elements.
    intervals: usize,
    /// `[(host * elements + source) * intervals + interval]`, followed by one that is zero.
    pieces: Vec<TableInterval>,
}

/// The coefficients of r φ(r), eV Å, and of the density ρ(r) of the source on the host within one interval,
/// stored together because they are used together.
type TableInterval = [[f64; 2]; 4];

impl Functions {
    pub fn new(tables: &Setfl, style: EamStyle) -> Self {
        let elements = tables.species.len();
        let mut pieces = Vec::new();
        for host in 0..elements {
            for source in 0..elements {
                let column = if style == EamStyle::FinnisSinclair { host } else { 0 };
                let density = eam_spline::cubic_pieces(&tables.density[source][column]);
                let pair = eam_spline::cubic_pieces(&tables.pair[host.max(source)][host.min(source)]);
                let together =
                    |(pair, density): (Cubic, Cubic)| std::array::from_fn(|n| [pair[n], density[n]]);
                pieces.extend(pair.into_iter().zip(density).map(together));
            }
        }
        let intervals = pieces.len() / (elements * elements);
        pieces.push([[0.0; 2]; 4]);
        Self { cutoff: tables.cutoff, scale: 1.0 / tables.distance_spacing, elements, intervals, pieces }
    }

    /// Index of the first piece of a host and a source.
    #[inline(always)]
    fn start(&self, host: usize, source: usize) -> usize {
        (host * self.elements + source) * self.intervals
    }

    /// Values and derivatives by p of one function (0: r φ, 1: ρ) for eight pairs, each at its piece and p.
    #[inline(always)]
    fn evaluate(&self, function: usize, pieces: &[usize; LANES], p: &Lanes) -> (Lanes, Lanes) {
        let mut c = [NONE; 4];
        for b in 0..LANES {
            let piece = &self.pieces[pieces[b]];
            (0..4).for_each(|n| c[n][b] = piece[n][function]);
        }
        let (mut values, mut slopes) = (NONE, NONE);
        for b in 0..LANES {
            values[b] = ((c[3][b] * p[b] + c[2][b]) * p[b] + c[1][b]) * p[b] + c[0][b];
            slopes[b] = (3.0 * c[3][b] * p[b] + 2.0 * c[2][b]) * p[b] + c[1][b];
        }
        (values, slopes)
    }
}

const NONE: Lanes = [0.0; LANES];

/// All pairs within the cutoff in blocks of eight, kept until the densities are known.
#[derive(Clone, Debug, Default)]
pub(crate) struct EamBonds {
    blocks: Vec<PairBlock>,
    /// End of each atom's blocks.
    ends: Vec<usize>,
}

/// Eight pairs of an atom. Unused lanes are zero and point to the atom itself.
#[derive(Clone, Copy, Debug)]
struct PairBlock {
    atoms: [u32; LANES],
    d: [Lanes; 3],
    /// φ′(r) / r, eV/Å².
    pair_slope: Lanes,
    /// ρ′(r) / r of the neighbour on this atom, 1/Å².
    slope_here: Lanes,
    /// ρ′(r) / r of this atom on the neighbour, 1/Å².
    slope_there: Lanes,
}

impl EamBonds {
    pub fn clear(&mut self) {
        self.blocks.clear();
        self.ends.clear();
    }
}

/// Adds pair energies and densities to `sums` and records the bonds.
pub(crate) struct AddPairs<'a> {
    pub neighbours: &'a NeighbourList,
    pub functions: &'a Functions,
    pub kinds: &'a [usize],
    pub near: &'a mut NearPairs,
    pub sums: &'a mut [[f64; 2]],
    pub bonds: &'a mut EamBonds,
}

impl SimdPass for AddPairs<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        if self.functions.elements == 1 { self.add::<true>() } else { self.add::<false>() }
    }
}

impl AddPairs<'_> {
    /// `ONE`: all atoms have the same element.
    #[inline(always)]
    fn add<const ONE: bool>(self) {
        let squared_cutoff = self.functions.cutoff * self.functions.cutoff;
        for i in 0..self.kinds.len() {
            let (later, sites) = (self.neighbours.later_neighbours_of(i), self.neighbours.later_sites_of(i));
            let (near, atoms) = self.near.collect(i, later, sites, squared_cutoff);
            let mut here = [NONE; 2];
            for (near, atoms) in near.chunks(LANES).zip(atoms.chunks(LANES)) {
                let (atoms, d, squared) = columns(i, near, atoms);
                let pieces =
                    PairIntervals::new::<ONE>(self.functions, self.kinds, i, &atoms, near.len(), &squared);
                let (block, energies, densities) = add_block::<ONE>(self.functions, &pieces, atoms, d);
                for b in 0..LANES {
                    here[0][b] += energies[b];
                    here[1][b] += densities[0][b];
                    let there = &mut self.sums[atoms[b] as usize];
                    *there = [there[0] + energies[b], there[1] + densities[1][b]];
                }
                self.bonds.blocks.push(block);
            }
            for (sum_here, lanes) in self.sums[i].iter_mut().zip(&here) {
                *sum_here += sum(lanes);
            }
            self.bonds.ends.push(self.bonds.blocks.len());
        }
    }
}

/// Atoms, d and d² of up to eight neighbours of atom `i`.
#[inline(always)]
fn columns(i: usize, near: &[[f64; 4]], atoms: &[u32]) -> ([u32; LANES], [Lanes; 3], Lanes) {
    let (mut others, mut d, mut squared) = ([i as u32; LANES], [NONE; 3], [1.0; LANES]);
    for (b, (near, atom)) in near.iter().zip(atoms).enumerate() {
        others[b] = *atom;
        (0..3).for_each(|k| d[k][b] = near[k]);
        squared[b] = near[3];
    }
    (others, d, squared)
}

/// Table lookups for eight pairs.
struct PairIntervals {
    /// Of the neighbour on this atom.
    here: [usize; LANES],
    /// Of this atom on the neighbour.
    there: [usize; LANES],
    p: Lanes,
    /// 1 / r, 1/Å.
    per_r: Lanes,
}

impl PairIntervals {
    /// The lookups of `count` pairs; unused lanes point to the zero piece.
    #[inline(always)]
    fn new<const ONE: bool>(
        functions: &Functions,
        kinds: &[usize],
        i: usize,
        atoms: &[u32; LANES],
        count: usize,
        squared: &Lanes,
    ) -> Self {
        let (mut p, mut per_r, mut interval) = (NONE, NONE, [0; LANES]);
        for b in 0..LANES {
            let r = squared[b].sqrt();
            per_r[b] = 1.0 / r;
            (interval[b], p[b]) = eam_spline::locate(r * functions.scale, functions.intervals);
        }
        let (mut here, mut there) = (interval, interval);
        if !ONE {
            for b in 0..LANES {
                let other = kinds[atoms[b] as usize];
                here[b] += functions.start(kinds[i], other);
                there[b] += functions.start(other, kinds[i]);
            }
        }
        let nowhere = functions.pieces.len() - 1;
        for b in 0..LANES {
            here[b] = if b < count { here[b] } else { nowhere };
            there[b] = if b < count { there[b] } else { nowhere };
        }
        Self { here, there, p, per_r }
    }
}

/// Processes eight pairs: the data that forces need, half of each pair's energy, and the densities on both
/// atoms.
#[inline(always)]
fn add_block<const ONE: bool>(
    functions: &Functions,
    PairIntervals { here, there, p, per_r }: &PairIntervals,
    atoms: [u32; LANES],
    d: [Lanes; 3],
) -> (PairBlock, Lanes, [Lanes; 2]) {
    let (mut energies, pair_slopes) = functions.evaluate(0, here, p);
    let (density_here, slopes_here) = functions.evaluate(1, here, p);
    let (density_there, slopes_there) =
        if ONE { (density_here, slopes_here) } else { functions.evaluate(1, there, p) };
    let mut block = PairBlock { atoms, d, pair_slope: NONE, slope_here: NONE, slope_there: NONE };
    for b in 0..LANES {
        let phi = energies[b] * per_r[b];
        energies[b] = 0.5 * phi;
        // φ = (r φ) / r, so φ′ = ((r φ)′ − φ) / r.
        block.pair_slope[b] = (pair_slopes[b] * functions.scale - phi) * per_r[b] * per_r[b];
        block.slope_here[b] = slopes_here[b] * (functions.scale * per_r[b]);
        block.slope_there[b] = slopes_there[b] * (functions.scale * per_r[b]);
    }
    (block, energies, [density_here, density_there])
}

/// Adds forces and virial of all bonds, given F′(ρ) of each atom.
pub(crate) struct AddForces<'a> {
    pub bonds: &'a EamBonds,
    pub embedding_slopes: &'a [f64],
    pub out: &'a mut Evaluation,
}

/// The independent components of a symmetric matrix.
const UPPER: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)];

impl SimdPass for AddForces<'_> {
    #[inline(always)]
    fn run(self, _: bool) {
        let forces = &mut self.out.forces[..];
        let mut virial = [[0.0; LANES]; 6];
        let mut start = 0;
        for (i, end) in self.bonds.ends.iter().enumerate() {
            let mut here = [[0.0; LANES]; 3];
            for block in &self.bonds.blocks[start..*end] {
                let slope = slope(block, self.embedding_slopes[i], self.embedding_slopes);
                let mut force = [[0.0; LANES]; 3];
                for k in 0..3 {
                    for b in 0..LANES {
                        force[k][b] = slope[b] * block.d[k][b];
                        here[k][b] += force[k][b];
                    }
                }
                for (sum, (k, l)) in virial.iter_mut().zip(UPPER) {
                    for b in 0..LANES {
                        sum[b] -= force[k][b] * block.d[l][b];
                    }
                }
                for (b, atom) in block.atoms.iter().enumerate() {
                    let there = &mut forces[*atom as usize];
                    (0..3).for_each(|k| there[k] -= force[k][b]);
                }
            }
            (0..3).for_each(|k| forces[i][k] += sum(&here[k]));
            start = *end;
        }
        for (lanes, (k, l)) in virial.iter().zip(UPPER) {
            self.out.virial[k][l] = sum(lanes);
            self.out.virial[l][k] = self.out.virial[k][l];
        }
    }
}

/// E′(r) / r of eight pairs, eV/Å².
#[inline(always)]
fn slope(block: &PairBlock, here: f64, embedding_slopes: &[f64]) -> Lanes {
    let mut slope = block.pair_slope;
    for b in 0..LANES {
        let there = embedding_slopes[block.atoms[b] as usize];
        slope[b] += here * block.slope_here[b] + there * block.slope_there[b];
    }
    slope
}
