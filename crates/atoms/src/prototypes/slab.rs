//! Slabs: crystals between two surfaces.

use super::Prototype;
use crate::cell::{Cell, Vec3, add, cross, dot, norm, scale, unit};
use crate::{Species, Structure};

/// A surface of a crystal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Facet {
    /// (100) of a cubic crystal.
    F100,
    /// (110) of a cubic crystal.
    F110,
    /// (111) of a cubic crystal.
    F111,
    /// (0001) of a hexagonal crystal.
    Basal,
}

/// A slab with two surfaces, periodic along its first two lattice vectors; the third one is normal to them, along z.
#[derive(Clone, Debug, PartialEq)]
pub struct Slab {
    /// The atoms, layer by layer from below.
    pub structure: Structure,
    /// Layer of each atom, `[n]`, 0 at the nearer surface.
    pub layers: Vec<usize>,
}

/// Heights that differ by less, in units of the lattice constant, are one layer.
const FLATNESS: f64 = 1e-6;

impl Facet {
    /// Name by Miller indices.
    pub fn name(self) -> &'static str {
        match self {
            Self::F100 => "(100)",
            Self::F110 => "(110)",
            Self::F111 => "(111)",
            Self::Basal => "(0001)",
        }
    }

    /// The low-index facets of a crystal.
    pub fn for_prototype(prototype: Prototype) -> &'static [Self] {
        if prototype.is_cubic() { &[Self::F111, Self::F100, Self::F110] } else { &[Self::Basal] }
    }

    /// Number of layers: 15 for bcc (111), 11 for (110), 9 otherwise (paper, 'Controlled structural and chemical extrapolation');
    /// 12 for diamond (111), whose layers are in pairs.
    pub fn layers(self, prototype: Prototype) -> usize {
        match (self, prototype) {
            (Self::F111, Prototype::Bcc) => 15,
            (Self::F111, Prototype::Diamond) => 12,
            (Self::F110, _) => 11,
            _ => 9,
        }
    }

    /// The shortest lattice vectors in the plane, in units of a.
    fn in_plane(self, prototype: Prototype) -> [Vec3; 2] {
        let half = |[x, y, z]: [f64; 3]| [0.5 * x, 0.5 * y, 0.5 * z];
        match (self, prototype) {
            (Self::Basal, _) => [[1.0, 0.0, 0.0], [-0.5, 0.75_f64.sqrt(), 0.0]],
            (Self::F100, Prototype::Fcc | Prototype::Diamond) => {
                [half([0.0, 1.0, 1.0]), half([0.0, -1.0, 1.0])]
            }
            (Self::F110, Prototype::Fcc | Prototype::Diamond) => [half([1.0, -1.0, 0.0]), [0.0, 0.0, -1.0]],
            (Self::F111, Prototype::Fcc | Prototype::Diamond) => {
                [half([1.0, -1.0, 0.0]), half([0.0, 1.0, -1.0])]
            }
            (Self::F110, Prototype::Bcc) => [half([1.0, -1.0, 1.0]), half([1.0, -1.0, -1.0])],
            (Self::F100, _) => [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            (Self::F110, _) => [[1.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
            (Self::F111, _) => [[1.0, -1.0, 0.0], [0.0, 1.0, -1.0]],
        }
    }
}

impl Slab {
    /// Depth of each atom below the nearer surface, its outermost layer, `[n]`, Å.
    pub fn depths(&self) -> Vec<f64> {
        let heights = self.structure.positions.iter().map(|r| r[2]);
        let top = heights.clone().fold(0.0, f64::max);
        heights.map(|z| z.min(top - z)).collect()
    }
}

/// A slab of `facet.layers(prototype)` layers and 3 × 3 surface cells with 12 Å of vacuum. `distance` of nearest neighbours in Å.
pub fn slab(prototype: Prototype, species: Species, distance: f64, facet: Facet) -> Slab {
    const TIMES: usize = 3;
    const VACUUM: f64 = 12.0;
    let a = prototype.lattice_constant(distance);
    let [u, v] = facet.in_plane(prototype).map(|vector| scale(vector, a));
    let crystal = prototype.structure(species, distance);
    let layers = facet.layers(prototype);
    let column = LayerStack::new(&crystal, u, v, layers + 4);
    // A surface is where the fewest bonds are cut: at the widest gap between layers.
    let gap = |k: usize| column.layers[k + 1].height - column.layers[k].height;
    let widest =
        (0..4).reduce(|best, k| if gap(k) > gap(best) + FLATNESS * a { k } else { best }).unwrap_or(0);
    let chosen = &column.layers[widest + 1..=widest + layers];
    let bottom = chosen[0].height;
    let (mut positions, mut numbers) = (Vec::new(), Vec::new());
    for (number, layer) in chosen.iter().enumerate() {
        for (i, j) in (0..TIMES).flat_map(|i| (0..TIMES).map(move |j| (i, j))) {
            let shift = add(scale(column.u, i as f64), scale(column.v, j as f64));
            for [x, y] in &layer.sites {
                positions.push(add([*x, *y, layer.height - bottom], shift));
                numbers.push(number.min(layers - 1 - number));
            }
        }
    }
    let height = chosen[layers - 1].height - bottom + VACUUM;
    let cell = Cell([scale(column.u, TIMES as f64), scale(column.v, TIMES as f64), [0.0, 0.0, height]]);
    let species = vec![species; positions.len()];
    let structure = Structure { species, positions, cell, periodic: [true, true, false] };
    Slab { structure, layers: numbers }
}

/// A crystal above one cell of a lattice plane, turned so that the plane is that of x and y.
struct LayerStack {
    u: Vec3,
    v: Vec3,
    layers: Vec<AtomicLayer>,
}

struct AtomicLayer {
    height: f64,
    sites: Vec<[f64; 2]>,
}

impl LayerStack {
    /// The lowest `number` layers from a lattice point on, above the cell of the lattice vectors `u` and `v`.
    fn new(crystal: &Structure, u: Vec3, v: Vec3, number: usize) -> Self {
        let tolerance = FLATNESS * norm(crystal.cell.0[0]);
        let normal = unit(cross(u, v));
        let (first, second) = (unit(u), cross(normal, unit(u)));
        let turn = |r: Vec3| [dot(r, first), dot(r, second), dot(r, normal)];
        let plane = Cell([u, v, normal]);
        let volume_per_atom = crystal.cell.volume() / crystal.len() as f64;
        // At least one atom is in each of so many layers of this height.
        let height =
            number as f64 * volume_per_atom * (1.0 + tolerance) / norm(cross(u, v)) * crystal.len() as f64;
        let reach = height + norm(u) + norm(v);
        let images = crystal.cell.heights().map(|h| (reach / h).ceil() as i32 + 1);
        let range = |k: usize| -images[k]..=images[k];
        let mut layers: Vec<AtomicLayer> = Vec::new();
        for (i, j, k) in range(0).flat_map(|i| range(1).flat_map(move |j| range(2).map(move |k| (i, j, k)))) {
            for position in &crystal.positions {
                let r = add(*position, crystal.cell.translation([i, j, k]));
                let [p, q, h] = plane.fractional(r);
                let inside = |x: f64| (-1e-9..1.0 - 1e-9).contains(&x);
                if !(inside(p) && inside(q) && (-tolerance..height).contains(&h)) {
                    continue;
                }
                let [x, y, h] = turn(r);
                match layers.iter_mut().find(|layer| (layer.height - h).abs() < tolerance) {
                    Some(layer) => layer.sites.push([x, y]),
                    None => layers.push(AtomicLayer { height: h, sites: vec![[x, y]] }),
                }
            }
        }
        layers.sort_by(|a, b| a.height.total_cmp(&b.height));
        Self { u: turn(u), v: turn(v), layers }
    }
}
