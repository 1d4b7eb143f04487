//! The sum over bonds in the first layer: from neighbours to the atomic density A, and from its cotangents back
//! to forces.
//!
//! A_a,lm,n = Σ_j R_nl(r) Y_lm(v) ζ_n(μ_j), with d = r_j − r_a, r = √(d·d + 10⁻¹⁰) and v = d / r.

use atoms::{Matrix3, NeighbourList, Structure, Vec3};

use super::batches::Batches;
use super::chunked_slices::{ChunkedSlice, PerChunk, PlaceLayout};
use super::layer::Layer;
use super::radial::RadialFunctions;
use super::radial_network::RadialWork;
use super::tape::TapeSlot;
use super::threads::Threads;
use super::vector::{MAX_LANES, Number, Vector};

/// Keeps r differentiable at d = 0, Å².
const SQUARE_FLOOR: f64 = 1e-10;

/// A bond within the cutoff of its pair.
#[derive(Clone, Copy, Debug)]
pub(super) struct GraceBond {
    /// Place of the neighbour.
    pub neighbour: u32,
    /// Its element index.
    pub element: u32,
    /// d, Å.
    pub d: Vec3,
    /// r, Å.
    pub r: f64,
}

/// The bonds of all atoms, atoms in evaluation order, the bonds of each in the order of the neighbour list.
#[derive(Clone, Debug, Default)]
pub(super) struct GraceBonds {
    pub offsets: Vec<usize>,
    pub bonds: Vec<GraceBond>,
    /// First block of each atom; a block has as many bonds as a vector has lanes.
    pub block_offsets: Vec<usize>,
    incoming_offsets: Vec<usize>,
    /// The bonds that end at each atom, ascending.
    incoming: Vec<u32>,
    /// The bonds of each chunk, before concatenation.
    found: Vec<Vec<GraceBond>>,
}

impl GraceBonds {
    /// Collects the bonds within the cutoff of their pair. Call it within [`Threads::run`].
    pub fn update<V: Vector>(
        &mut self,
        layer: &Layer<V>,
        structure: &Structure,
        neighbours: &NeighbourList,
        elements: &[usize],
        (batches, threads): (&Batches, &Threads),
    ) {
        let Self { offsets, bonds, block_offsets, found, .. } = self;
        let n = batches.order.len();
        offsets.clear();
        offsets.resize(n + 1, 0);
        found.resize_with(batches.chunks.len().max(found.len()), Vec::new);
        let counts = ChunkedSlice::new(PlaceLayout::Even(1), 0, &mut offsets[1..]);
        let work = (counts, PerChunk::within(&batches.chunks, found));
        threads.for_each_chunk(&batches.chunks, work, &|chunk, (mut counts, mut found), _| {
            let Some(found) = found.only() else { return };
            found.clear();
            for place in chunk.places.clone() {
                let before = found.len();
                let atom = batches.order[place] as usize;
                found.extend(bonds_of(atom, &layer.radial, structure, neighbours, elements, batches));
                counts.slice(&(place..place + 1))[0] = found.len() - before;
            }
        });
        block_offsets.clear();
        block_offsets.push(0);
        for place in 0..n {
            block_offsets.push(block_offsets[place] + offsets[place + 1].div_ceil(V::LANES));
            offsets[place + 1] += offsets[place];
        }
        bonds.resize(offsets[n], GraceBond { neighbour: 0, element: 0, d: [0.0; 3], r: 0.0 });
        let all = ChunkedSlice::new(PlaceLayout::Ragged(offsets, 1), 0, &mut bonds[..]);
        threads.for_each_chunk(&batches.chunks, all, &|chunk, mut all, _| {
            all.slice(&chunk.places).copy_from_slice(&found[chunk.number]);
        });
        self.find_incoming();
    }

    fn find_incoming(&mut self) {
        let n = self.offsets.len() - 1;
        // Counts are stored two places ahead, so that their prefix sums serve as insertion points.
        self.incoming_offsets.clear();
        self.incoming_offsets.resize(n + 2, 0);
        for bond in &self.bonds {
            self.incoming_offsets[bond.neighbour as usize + 2] += 1;
        }
        for place in 2..n + 2 {
            self.incoming_offsets[place] += self.incoming_offsets[place - 1];
        }
        self.incoming.resize(self.bonds.len(), 0);
        for (k, bond) in self.bonds.iter().enumerate() {
            let next = &mut self.incoming_offsets[bond.neighbour as usize + 1];
            self.incoming[*next] = k as u32;
            *next += 1;
        }
    }

    /// The bonds of the atom at a place.
    #[inline(always)]
    pub fn at(&self, place: usize) -> &[GraceBond] {
        &self.bonds[self.offsets[place]..self.offsets[place + 1]]
    }

    /// With g = ∂H/∂d of each bond: adds −∂H/∂r of the atom at a place to `force` and returns Σ g ⊗ d over its
    /// own bonds.
    #[inline(always)]
    pub fn gather(&self, place: usize, gradients: &[Vec3], force: &mut Vec3) -> Matrix3 {
        let own = self.offsets[place]..self.offsets[place + 1];
        let incoming = &self.incoming[self.incoming_offsets[place]..self.incoming_offsets[place + 1]];
        let mut virial = [[0.0; 3]; 3];
        let before = incoming.partition_point(|k| (*k as usize) < own.start);
        for k in &incoming[..before] {
            subtract(force, &gradients[*k as usize]);
        }
        for (bond, g) in self.bonds[own.clone()].iter().zip(&gradients[own.clone()]) {
            // The force of an atom on its own image cancels that of the image on the atom.
            if bond.neighbour as usize != place {
                (0..3).for_each(|a| force[a] += g[a]);
            }
            for (row, g) in virial.iter_mut().zip(g) {
                (0..3).for_each(|b| row[b] += g * bond.d[b]);
            }
        }
        for k in incoming[before..].iter().skip_while(|k| (**k as usize) < own.end) {
            subtract(force, &gradients[*k as usize]);
        }
        virial
    }
}

/// The bonds of an atom within the cutoff of their pair.
pub(super) fn bonds_of<V: Vector>(
    atom: usize,
    radial: &RadialFunctions<V>,
    structure: &Structure,
    neighbours: &NeighbourList,
    elements: &[usize],
    batches: &Batches,
) -> impl Iterator<Item = GraceBond> {
    neighbours.neighbours_of(atom).iter().filter_map(move |neighbour| {
        let j = neighbour.atom as usize;
        let d = neighbour.displacement(structure, atom);
        let r = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + SQUARE_FLOOR).sqrt();
        let is_within = r < radial.cutoff(radial.pair(elements[atom], elements[j]));
        is_within.then(|| GraceBond { neighbour: batches.places[j], element: elements[j] as u32, d, r })
    })
}

#[inline(always)]
fn subtract(sum: &mut Vec3, x: &Vec3) {
    (0..3).for_each(|a| sum[a] -= x[a]);
}

/// Scratch arrays for one block of bonds.
#[derive(Clone, Debug, Default)]
pub(super) struct BondWork<V> {
    /// Y_lm, \[lm\]\[bond\]
    pub harmonics: Vec<V>,
    /// ∂Y_lm/∂v
    pub gradients: Vec<[V; 3]>,
    /// R_nl ζ_n, \[bond\]\[l\]\[channel\]
    values: Vec<V>,
    /// dR_nl/dr ζ_n
    derivatives: Vec<V>,
    /// R_nl Y_lm, \[bond\], in later layers.
    pub terms: Vec<V>,
    pub radial: RadialWork,
}

impl<V: Vector> BondWork<V> {
    pub fn new(layer: &Layer<V>) -> Self {
        let (functions, lanes) = (layer.harmonics.len(), V::LANES * layer.radial.output_lanes());
        Self {
            harmonics: vec![V::ZERO; functions],
            gradients: vec![[V::ZERO; 3]; functions],
            values: vec![V::ZERO; lanes],
            derivatives: vec![V::ZERO; lanes],
            terms: vec![V::ZERO; V::LANES],
            radial: RadialWork::default(),
        }
    }

    /// R_nl(r) ζ_n and derivatives of a block; unused lanes are zero.
    #[inline(always)]
    fn radial(&mut self, layer: &Layer<V>, centre: usize, bonds: &[GraceBond]) {
        let (lanes, distances) = (layer.radial.output_lanes(), distances(layer, centre, bonds));
        let (values, derivatives) = (&mut self.values[..], &mut self.derivatives[..]);
        layer.radial.evaluate(&distances[..bonds.len()], &mut self.radial, values, derivatives);
        for (b, bond) in bonds.iter().enumerate() {
            let (row, embedding) =
                (b * lanes..(b + 1) * lanes, &layer.message.constants[bond.element as usize][..]);
            multiply_channels(&mut values[row.clone()], embedding);
            multiply_channels(&mut derivatives[row], embedding);
        }
        values[bonds.len() * lanes..].fill(V::ZERO);
        derivatives[bonds.len() * lanes..].fill(V::ZERO);
    }
}

/// Index of the pair of elements and distance of each bond, Å.
#[inline(always)]
pub(super) fn distances<V: Vector>(
    layer: &Layer<V>,
    centre: usize,
    bonds: &[GraceBond],
) -> [(usize, f64); MAX_LANES] {
    let mut distances = [(0, 0.0); MAX_LANES];
    for (distance, bond) in distances.iter_mut().zip(bonds) {
        *distance = (layer.radial.pair(centre, bond.element as usize), bond.r);
    }
    distances
}

#[inline(always)]
fn multiply_channels<V: Vector>(orders: &mut [V], embedding: &[V]) {
    let mut channels = embedding.iter().cycle();
    for (x, e) in orders.iter_mut().zip(&mut channels) {
        *x = x.product(e);
    }
}

/// \[bond\]\[function\] → \[function\]\[bond\] for a block.
#[inline(always)]
fn transpose<V: Vector>(rows: &[V], columns: &mut [V]) {
    let lanes = rows.len() / V::LANES;
    for (c, block) in columns.chunks_exact_mut(V::LANES).enumerate() {
        for b in 0..V::LANES {
            let row = &rows[b * lanes + c];
            for k in 0..V::LANES {
                block[k][b] = row[k];
            }
        }
    }
}

/// v and r of a block; v is zero in unused lanes. Both are rounded after the division.
#[inline(always)]
pub(super) fn directions<V: Vector>(bonds: &[GraceBond]) -> ([V; 3], V) {
    let (mut ds, mut rs) = ([[0.0; MAX_LANES]; 3], [1.0; MAX_LANES]);
    for (b, bond) in bonds.iter().enumerate() {
        rs[b] = bond.r;
        for (axis, d) in ds.iter_mut().zip(bond.d) {
            axis[b] = d;
        }
    }
    let (mut v, mut r) = ([V::ZERO; 3], V::ZERO);
    for b in 0..V::LANES {
        r[b] = V::Number::round(rs[b]);
        for (v, d) in v.iter_mut().zip(&ds) {
            v[b] = V::Number::round(d[b] / rs[b]);
        }
    }
    (v, r)
}

/// The bonds of one atom with the data that the forward pass leaves for the reverse pass.
pub(super) struct OwnBonds<'a, V> {
    pub bonds: &'a [GraceBond],
    /// R_nl ζ_n, \[block\]\[l\]\[channel\]\[bond\]; in later layers R_nl, \[block\]\[bond\]\[l\]\[channel\].
    pub values: &'a mut [V],
    /// dR_nl/dr in the same layout.
    pub derivatives: &'a mut [V],
}

impl<'a, V: Vector> OwnBonds<'a, V> {
    /// The bonds in blocks of a vector's lanes, with their values and derivatives.
    #[inline(always)]
    pub fn blocks(
        self,
        layer: &Layer<V>,
    ) -> impl Iterator<Item = (&'a [GraceBond], &'a mut [V], &'a mut [V])> + use<'a, V> {
        let lanes = V::LANES * layer.radial.output_lanes();
        let values = self.values.chunks_exact_mut(lanes).zip(self.derivatives.chunks_exact_mut(lanes));
        self.bonds
            .chunks(V::LANES)
            .zip(values)
            .map(|(bonds, (values, derivatives))| (bonds, values, derivatives))
    }
}

/// Adds the bonds of an atom of element `centre` to its density, \[lm\]\[channel\].
#[inline(always)]
pub(super) fn accumulate<V: Vector>(
    layer: &Layer<V>,
    centre: usize,
    own: OwnBonds<V>,
    (density, slot): (&mut [V], TapeSlot),
    work: &mut BondWork<V>,
) {
    for (bonds, values, derivatives) in own.blocks(layer) {
        let (v, _) = directions(bonds);
        layer.harmonics.evaluate::<V, false>(&v, &mut work.harmonics, &mut work.gradients);
        work.radial(layer, centre, bonds);
        transpose(&work.values, values);
        transpose(&work.derivatives, derivatives);
        add_bonds(layer, density, slot, work);
    }
}

/// ∂/∂d of Σ A·Ā for each bond of an atom, for `N` cotangents Ā of its density at once.
///
/// With c_lm = Σ_n Ā_lm,n R_nl ζ_n, and c′_lm from dR/dr, it is g v + (G − (G·v) v)/r, where g = Σ c′_lm Y_lm
/// and G = Σ c_lm ∂Y_lm/∂v.
#[inline(always)]
pub(super) fn reverse<V: Vector, const N: usize>(
    layer: &Layer<V>,
    own: OwnBonds<V>,
    (cotangent, slots): (&[V], [TapeSlot; N]),
    work: &mut BondWork<V>,
    mut gradients: [&mut [Vec3]; N],
) {
    for (block, (bonds, values, derivatives)) in own.blocks(layer).enumerate() {
        let (v, r) = directions(bonds);
        layer.harmonics.evaluate::<V, true>(&v, &mut work.harmonics, &mut work.gradients);
        let slopes = slopes(layer, (cotangent, slots), (values, derivatives), work);
        for (gradients, (along, across)) in gradients.iter_mut().zip(&slopes) {
            let of_block = bond_gradient(&v, &r, along, across);
            put(&of_block, &mut gradients[block * V::LANES..][..bonds.len()]);
        }
    }
}

/// Writes the gradients of a block bond by bond.
#[inline(always)]
pub(super) fn put<V: Vector>(of_block: &[V; 3], gradients: &mut [Vec3]) {
    for (b, gradient) in gradients.iter_mut().enumerate() {
        *gradient = of_block.map(|axis| axis[b].into());
    }
}

/// A_lm,n += Σ_b Y_lm(v_b) R_nl(r_b) ζ_n over a block.
#[inline(always)]
fn add_bonds<V: Vector>(layer: &Layer<V>, density: &mut [V], slot: TapeSlot, work: &BondWork<V>) {
    let (width, lanes) = (layer.density.width, layer.radial.output_lanes());
    for l in 0..=layer.harmonics.lmax() {
        for lm in l * l..(l + 1) * (l + 1) {
            let row = &mut density[slot.row(&layer.density, lm)..][..width];
            for (c, sum) in row.iter_mut().enumerate() {
                let mut density = *sum;
                for (b, values) in work.values.chunks_exact(lanes).enumerate() {
                    density.add_scaled(work.harmonics[lm][b], &values[l * width + c]);
                }
                *sum = density;
            }
        }
    }
}

/// g and G of a block for each cotangent.
#[inline(always)]
fn slopes<V: Vector, const N: usize>(
    layer: &Layer<V>,
    (cotangent, slots): (&[V], [TapeSlot; N]),
    (values, derivatives): (&[V], &[V]),
    work: &BondWork<V>,
) -> [(V, [V; 3]); N] {
    let of_order = layer.density.width * V::LANES;
    let mut slopes = [(V::ZERO, [V::ZERO; 3]); N];
    let orders = values.chunks_exact(of_order).zip(derivatives.chunks_exact(of_order));
    for (l, order) in orders.enumerate() {
        let (mut lm, end) = (l * l, (l + 1) * (l + 1));
        while lm + 2 <= end {
            add_slopes::<V, N, 2>(layer, (cotangent, slots), order, work, lm, &mut slopes);
            lm += 2;
        }
        add_slopes::<V, N, 1>(layer, (cotangent, slots), order, work, lm, &mut slopes);
    }
    slopes
}

/// Adds the contributions of `M` harmonics from `lm` to g and G, with c_lm = Σ_n Ā_lm,n R_nl ζ_n and c′_lm.
#[inline(always)]
fn add_slopes<V: Vector, const N: usize, const M: usize>(
    layer: &Layer<V>,
    (cotangent, slots): (&[V], [TapeSlot; N]),
    (values, derivatives): (&[V], &[V]),
    work: &BondWork<V>,
    lm: usize,
    slopes: &mut [(V, [V; 3]); N],
) {
    let row = |slot: TapeSlot, m: usize| {
        let row = &cotangent[slot.row(&layer.density, lm + m)..][..layer.density.width];
        &V::flat(row)[..layer.density.channels]
    };
    let rows: [[&[V::Number]; M]; N] = std::array::from_fn(|k| std::array::from_fn(|m| row(slots[k], m)));
    let mut sums = [[[V::ZERO; 2]; M]; N];
    let channels = values.iter().zip(derivatives).take(layer.density.channels);
    for (n, (value, derivative)) in channels.enumerate() {
        for (rows, sums) in rows.iter().zip(&mut sums) {
            for (row, [c, c_prime]) in rows.iter().zip(sums) {
                c.add_scaled(row[n], value);
                c_prime.add_scaled(row[n], derivative);
            }
        }
    }
    for ((along, across), sums) in slopes.iter_mut().zip(&sums) {
        for (m, [c, c_prime]) in sums.iter().enumerate() {
            along.add_product(&work.harmonics[lm + m], c_prime);
            for (across, gradient) in across.iter_mut().zip(&work.gradients[lm + m]) {
                across.add_product(gradient, c);
            }
        }
    }
}

/// g v + (G − (G·v) v)/r of a block, from g and G.
#[inline(always)]
pub(super) fn bond_gradient<V: Vector>(v: &[V; 3], r: &V, along: &V, across: &[V; 3]) -> [V; 3] {
    let mut result = [V::ZERO; 3];
    for b in 0..V::LANES {
        let radial = across[0][b] * v[0][b] + across[1][b] * v[1][b] + across[2][b] * v[2][b];
        for axis in 0..3 {
            result[axis][b] = along[b] * v[axis][b] + (across[axis][b] - radial * v[axis][b]) / r[b];
        }
    }
    result
}
