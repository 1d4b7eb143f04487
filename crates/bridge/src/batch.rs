//! Structures side by side in an arena, as one block-diagonal graph (`docs/python-protocol.md`).

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use bytemuck::{Pod, cast_slice, cast_slice_mut};
use serde::Serialize;

use crate::arena::Arena;
use crate::call::{BondGeometry, Topology};
use crate::shapes::Shape;

/// Sections begin at multiples of this, bytes.
const ALIGNMENT: usize = 64;

/// Where each section is.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Layout {
    sections: BTreeMap<&'static str, Range<usize>>,
    bytes: usize,
}

impl Layout {
    fn new(shape: Shape, dimension: usize) -> Self {
        let Shape { structures, atoms, bonds } = shape;
        let sizes = [
            ("species", 4 * atoms),
            ("structure_of_atom", 4 * atoms),
            ("centres", 4 * bonds),
            ("neighbours", 4 * bonds),
            ("structure_of_bond", 4 * bonds),
            ("bonds", 24 * bonds),
            ("positions", 24 * atoms),
            ("cells", 72 * structures),
            ("periodic", 3 * structures),
            ("energies", 8 * atoms),
            ("features", 8 * atoms * dimension),
            ("forces", 24 * atoms),
            ("virials", 72 * structures),
            ("feature_cotangents", 8 * atoms * dimension),
            ("energy_cotangents", 8 * atoms),
            ("gradients", 24 * atoms),
            ("gradient_virials", 72 * structures),
        ];
        let mut bytes = 0;
        let sections = sizes.map(|(name, size)| {
            let range = bytes..bytes + size;
            bytes = range.end.next_multiple_of(ALIGNMENT);
            (name, range)
        });
        Self { sections: sections.into_iter().collect(), bytes }
    }

    fn range(&self, name: &str) -> Range<usize> {
        self.sections.get(name).cloned().unwrap_or_default()
    }
}

/// A message about a batch.
#[derive(Debug, Serialize)]
pub(crate) struct BatchMessage<'a> {
    id: u64,
    arena: usize,
    path: &'a Path,
    bytes: usize,
    structures: usize,
    atoms: usize,
    bonds: usize,
    real: RealShape,
    topology: u64,
    #[serde(flatten)]
    kind: BatchKind,
    sections: BTreeMap<&'static str, usize>,
}

#[derive(Debug, Serialize)]
struct RealShape {
    structures: usize,
    atoms: usize,
    bonds: usize,
}

/// What a batch is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "call", rename_all = "snake_case")]
pub(crate) enum BatchKind {
    /// Energies.
    Evaluate {
        /// Whether features are wanted.
        features: bool,
        /// Whether forces and virials are wanted.
        forces: bool,
    },
    /// A pull-back.
    PullBack {
        /// The message whose inputs are the same.
        kept: Option<u64>,
        /// Whether there are cotangents of the energies.
        energy: bool,
    },
}

/// An arena with a batch.
#[derive(Debug)]
pub(crate) struct BatchArena {
    arena: Arena,
    number: usize,
    dimension: usize,
    layout: Layout,
    padded: Shape,
    real: Shape,
    topologies: Vec<Arc<Topology>>,
    /// Changes with the topologies.
    topology: u64,
}

impl BatchArena {
    /// An empty one, for a model with so many features.
    pub fn new(directory: &Path, number: usize, dimension: usize) -> Self {
        Self {
            arena: Arena::new(directory, number),
            number,
            dimension,
            layout: Layout::new(Shape::default(), dimension),
            padded: Shape::default(),
            real: Shape::default(),
            topologies: Vec::new(),
            topology: 0,
        }
    }

    /// The server has the arena: its name is no longer needed, and nothing is left of it when this program is killed.
    pub fn unlink(&mut self) {
        self.arena.unlink();
    }

    /// The padded shape of the batch.
    pub fn shape(&self) -> Shape {
        self.padded
    }

    /// Writes structures. Padding bonds are longer than `cutoff`, Å.
    ///
    /// # Errors
    /// Shared memory that is full.
    pub fn write(&mut self, structures: &[&BondGeometry], padding: bool, cutoff: f64) -> std::io::Result<()> {
        self.real = structures.iter().fold(Shape::default(), |sum, one| sum.plus(one.shape()));
        let padded = if padding { self.real.padded() } else { self.real };
        let layout = Layout::new(padded, self.dimension);
        let lost = self.arena.reserve(layout.bytes)?;
        let same = self
            .topologies
            .iter()
            .map(Arc::as_ptr)
            .eq(structures.iter().map(|one| Arc::as_ptr(&one.topology)));
        if lost || !same || self.padded != padded {
            (self.padded, self.layout) = (padded, layout);
            self.topologies = structures.iter().map(|one| Arc::clone(&one.topology)).collect();
            self.topology += 1;
            self.write_topology();
        }
        self.write_geometry(structures, cutoff);
        Ok(())
    }

    fn section<T: Pod>(&mut self, name: &str) -> &mut [T] {
        let range = self.layout.range(name);
        cast_slice_mut(&mut self.arena.bytes()[range])
    }

    fn write_topology(&mut self) {
        let topologies = std::mem::take(&mut self.topologies);
        let Shape { structures, atoms, bonds } = self.padded;
        let last = (structures.saturating_sub(1)) as i32;
        let of_structures = |count: fn(&Topology) -> usize, length: usize| {
            let numbers = topologies.iter().enumerate();
            let mut of: Vec<i32> =
                numbers.flat_map(|(k, one)| std::iter::repeat_n(k as i32, count(one))).collect();
            of.resize(length, last);
            of
        };
        let indices = |list: fn(&Topology) -> &Vec<i32>| {
            let (mut all, mut first) = (Vec::with_capacity(bonds), 0);
            for one in &topologies {
                all.extend(list(one).iter().map(|atom| atom + first));
                first += one.species.len() as i32;
            }
            all.resize(bonds, (atoms - 1) as i32);
            all
        };
        let mut species: Vec<i32> = topologies.iter().flat_map(|one| one.species.iter().copied()).collect();
        species.resize(atoms, 0);
        self.section("species").copy_from_slice(&species);
        self.section("structure_of_atom").copy_from_slice(&of_structures(|one| one.species.len(), atoms));
        self.section("structure_of_bond").copy_from_slice(&of_structures(|one| one.centres.len(), bonds));
        self.section("centres").copy_from_slice(&indices(|one| &one.centres));
        self.section("neighbours").copy_from_slice(&indices(|one| &one.neighbours));
        self.topologies = topologies;
    }

    fn write_geometry(&mut self, structures: &[&BondGeometry], cutoff: f64) {
        let beyond = [100.0 + 2.0 * cutoff, 0.0, 0.0];
        let bonds = self.section::<[f64; 3]>("bonds");
        let mut rest = bonds;
        for one in structures {
            let (own, others) = rest.split_at_mut(one.shape().bonds);
            one.write_bonds(own);
            rest = others;
        }
        rest.fill(beyond);
        let mut rest = self.section::<[f64; 3]>("positions");
        for one in structures {
            let (own, others) = rest.split_at_mut(one.positions.len());
            own.copy_from_slice(&one.positions);
            rest = others;
        }
        rest.fill([0.0; 3]);
        let cells = self.section::<[[f64; 3]; 3]>("cells");
        cells.fill([[0.0; 3]; 3]);
        cells.iter_mut().zip(structures).for_each(|(cell, one)| *cell = one.cell);
        let periodic = self.section::<[u8; 3]>("periodic");
        periodic.fill([0; 3]);
        periodic.iter_mut().zip(structures).for_each(|(out, one)| *out = one.periodic.map(u8::from));
    }

    /// Writes cotangents of the features: those of one structure after the other, zero where there is none.
    pub fn write_cotangents<'a>(&mut self, cotangents: impl Iterator<Item = Option<&'a [f64]>>) {
        let dimension = self.dimension;
        let sizes: Vec<usize> = self.topologies.iter().map(|one| dimension * one.species.len()).collect();
        let mut rest = self.section::<f64>("feature_cotangents");
        for (size, cotangent) in sizes.into_iter().zip(cotangents) {
            let (own, others) = rest.split_at_mut(size);
            match cotangent.filter(|cotangent| cotangent.len() == size) {
                Some(cotangent) => own.copy_from_slice(cotangent),
                None => own.fill(0.0),
            }
            rest = others;
        }
        rest.fill(0.0);
    }

    /// Writes cotangents of the energies: 1 for the atoms of the structures whose energy's gradient is wanted, else 0.
    pub fn write_energy_cotangents(&mut self, wanted: impl Iterator<Item = bool>) {
        let sizes: Vec<usize> = self.topologies.iter().map(|one| one.species.len()).collect();
        let mut rest = self.section::<f64>("energy_cotangents");
        for (size, is_wanted) in sizes.into_iter().zip(wanted) {
            let (own, others) = rest.split_at_mut(size);
            own.fill(if is_wanted { 1.0 } else { 0.0 });
            rest = others;
        }
        rest.fill(0.0);
    }

    /// The message for the server, without its line break.
    pub fn message(&self, id: u64, kind: BatchKind) -> String {
        let Shape { structures, atoms, bonds } = self.padded;
        let real =
            RealShape { structures: self.real.structures, atoms: self.real.atoms, bonds: self.real.bonds };
        let message = BatchMessage {
            id,
            arena: self.number,
            path: self.arena.path(),
            bytes: self.arena.len(),
            structures,
            atoms,
            bonds,
            real,
            topology: self.topology,
            kind,
            sections: self.layout.sections.iter().map(|(name, range)| (*name, range.start)).collect(),
        };
        serde_json::to_string(&message).expect("plain data becomes JSON")
    }

    /// The result for one structure of the batch, in the form of [`ResultLayout`].
    pub fn result(&mut self, structure: usize, kind: BatchKind) -> ResultParts<'_> {
        let first: usize = self.topologies[..structure].iter().map(|one| one.species.len()).sum();
        let atoms = self.topologies[structure].species.len();
        let dimension = self.dimension;
        let layout = &self.layout;
        let bytes = self.arena.bytes();
        let numbers = |name: &str, width: usize, first: usize, count: usize| -> &[f64] {
            let all: &[f64] = cast_slice(&bytes[layout.range(name)]);
            &all[width * first..][..width * count]
        };
        match kind {
            BatchKind::Evaluate { features, forces } => ResultParts {
                energies: numbers("energies", 1, first, atoms),
                vectors: if forces { numbers("forces", 3, first, atoms) } else { &[] },
                virial: if forces { numbers("virials", 9, structure, 1) } else { &[] },
                features: if features { numbers("features", dimension, first, atoms) } else { &[] },
            },
            BatchKind::PullBack { .. } => ResultParts {
                energies: &[],
                vectors: numbers("gradients", 3, first, atoms),
                virial: numbers("gradient_virials", 9, structure, 1),
                features: &[],
            },
        }
    }
}

/// The numbers of one structure.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ResultParts<'a> {
    /// `[n]`, of an evaluation.
    pub energies: &'a [f64],
    /// Forces, if wanted, or gradients, `[n × 3]`.
    pub vectors: &'a [f64],
    /// 3 × 3, with them.
    pub virial: &'a [f64],
    /// `[n × D]`, if wanted.
    pub features: &'a [f64],
}

impl ResultParts<'_> {
    /// All numbers, one part after the other.
    pub fn parts(&self) -> [&[f64]; 4] {
        [self.energies, self.vectors, self.virial, self.features]
    }

    /// How many numbers these are.
    pub fn len(&self) -> usize {
        self.parts().iter().map(|part| part.len()).sum()
    }

    /// Writes all of them.
    pub fn write(&self, out: &mut [f64]) {
        let mut rest = out;
        for part in self.parts() {
            let (own, others) = rest.split_at_mut(part.len());
            own.copy_from_slice(part);
            rest = others;
        }
    }

    /// The first number that is not finite, in words.
    pub fn not_finite(&self) -> Option<String> {
        let names = ["energies", "forces or gradients", "virial", "features"];
        names.iter().zip(self.parts()).find_map(|(name, part)| {
            part.iter().find(|x| !x.is_finite()).map(|x| format!("{x} among the {name}"))
        })
    }
}
