//! What a walker asks a device for.

use std::sync::Arc;

use atoms::{NeighbourList, Structure};
use bytemuck::{cast_slice, cast_slice_mut};

use crate::shapes::Shape;

/// Elements and directed bonds of a structure; they stay while the neighbour list does.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Topology {
    /// Element index of each atom, `[n]`.
    pub species: Vec<i32>,
    /// First atom of each bond, `[m]`, ascending.
    pub centres: Vec<i32>,
    /// Second atom of each bond, `[m]`.
    pub neighbours: Vec<i32>,
    /// Periodic image of the second atom, `[m]`.
    pub images: Vec<[i32; 3]>,
}

/// Positions of a structure and its bonds.
#[derive(Clone, Debug, PartialEq)]
pub struct BondGeometry {
    /// Elements and bonds.
    pub topology: Arc<Topology>,
    /// Positions, `[n]`, Å.
    pub positions: Vec<[f64; 3]>,
    /// Lattice vectors as rows, Å.
    pub cell: [[f64; 3]; 3],
    /// Periodic directions.
    pub periodic: [bool; 3],
}

/// A request of one client.
#[derive(Clone, Debug, PartialEq)]
pub enum Call {
    /// Energies, forces and virial of a structure.
    Evaluate {
        /// The structure.
        geometry: BondGeometry,
        /// What is wanted beside energies.
        wanted: Wanted,
    },
    /// The pull-back of a cotangent of the features of the client's last structure, `[n, D]`.
    PullBack {
        /// The cotangent.
        cotangent: Vec<f64>,
        /// Whether the gradient of the energy is in it, too.
        with_energy: bool,
    },
}

/// What a client wants of an evaluation beside the energies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Wanted {
    /// Features.
    pub features: bool,
    /// Forces and virial.
    pub forces: bool,
    /// Whether the client will call for a pull-back, so that the device keeps what it needs for that.
    pub pull_back_follows: bool,
}

impl Wanted {
    /// Energies, forces and virial.
    pub const FORCES: Self = Self { features: false, forces: true, pull_back_follows: false };
    /// Features as well, without a pull-back.
    pub const FEATURES: Self = Self { features: true, ..Self::FORCES };
    /// All, before a pull-back.
    pub const ALL: Self = Self { pull_back_follows: true, ..Self::FEATURES };
    /// Features, before a pull-back that has the gradient of the energy in it.
    pub const WITHOUT_FORCES: Self = Self { forces: false, ..Self::ALL };
}

impl Topology {
    /// Whether these are the bonds of a neighbour list.
    fn has_bonds_of(&self, list: &NeighbourList) -> bool {
        let own = self.centres.iter().zip(&self.neighbours).zip(&self.images);
        let listed =
            (0..list.len()).flat_map(|i| list.neighbours_of(i).iter().map(move |one| (i as i32, one)));
        listed.map(|(i, one)| (i, one.atom as i32, one.image)).eq(own.map(|((i, j), image)| (*i, *j, *image)))
    }

    /// The topology of a structure whose neighbour list is up to date; `last`, which was that of the build of a list, if it is the same.
    pub(crate) fn from_list(
        species: &[usize],
        list: &NeighbourList,
        last: Option<&(u64, Arc<Self>)>,
    ) -> Arc<Self> {
        let is_same = |(build, last): &&(u64, Arc<Self>)| {
            let is_built = *build == list.build_number() || last.has_bonds_of(list);
            is_built && last.species.iter().map(|s| *s as usize).eq(species.iter().copied())
        };
        if let Some((_, last)) = last.filter(is_same) {
            return Arc::clone(last);
        }
        let mut found = Self { species: species.iter().map(|s| *s as i32).collect(), ..Self::default() };
        for i in 0..list.len() {
            for neighbour in list.neighbours_of(i) {
                found.centres.push(i as i32);
                found.neighbours.push(neighbour.atom as i32);
                found.images.push(neighbour.image);
            }
        }
        Arc::new(found)
    }
}

impl BondGeometry {
    /// The geometry of a structure with these bonds.
    pub(crate) fn from_structure(structure: &Structure, topology: Arc<Topology>) -> Self {
        Self {
            topology,
            positions: structure.positions.clone(),
            cell: structure.cell.0,
            periodic: structure.periodic,
        }
    }

    /// Numbers of atoms and bonds.
    pub fn shape(&self) -> Shape {
        Shape { structures: 1, atoms: self.positions.len(), bonds: self.topology.centres.len() }
    }

    /// Vectors from the first to the second atom of each bond, Å.
    pub(crate) fn write_bonds(&self, out: &mut [[f64; 3]]) {
        let Topology { centres, neighbours, images, .. } = &*self.topology;
        for (((bond, i), j), image) in out.iter_mut().zip(centres).zip(neighbours).zip(images) {
            let (ri, rj) = (self.positions[*i as usize], self.positions[*j as usize]);
            let shift = |axis: usize| -> f64 {
                if *image == [0; 3] {
                    return 0.0;
                }
                (0..3).map(|k| f64::from(image[k]) * self.cell[k][axis]).sum()
            };
            *bond = std::array::from_fn(|axis| rj[axis] - ri[axis] + shift(axis));
        }
    }
}

/// Kinds of messages in shared memory.
const EVALUATE: u64 = 1;
const PULL_BACK: u64 = 2;
const PULL_BACK_WITH_ENERGY: u64 = 3;
/// Words before the numbers of an evaluation: kind, options, atoms, bonds + 1 or 0 where the topology is that of the last call.
const HEAD: usize = 4;
const CELL: usize = 9;

/// Words that `count` 32-bit integers take.
fn half(count: usize) -> usize {
    count.div_ceil(2)
}

/// The words of an evaluation in shared memory; `topology`: whether it is sent along.
pub(crate) fn evaluate_words(geometry: &BondGeometry, topology: bool) -> usize {
    let Shape { atoms, bonds, .. } = geometry.shape();
    let integers = if topology { half(atoms) + 2 * half(bonds) + half(3 * bonds) } else { 0 };
    HEAD + 3 * atoms + CELL + integers
}

/// Writes an evaluation.
pub(crate) fn write_evaluate(geometry: &BondGeometry, wanted: Wanted, topology: bool, words: &mut [u64]) {
    let Shape { atoms, bonds, .. } = geometry.shape();
    let periodic = geometry.periodic.iter().enumerate().map(|(k, on)| u64::from(*on) << (8 + k)).sum::<u64>();
    words[0] = EVALUATE;
    let Wanted { features, forces, pull_back_follows } = wanted;
    words[1] = u64::from(features) | u64::from(pull_back_follows) << 1 | u64::from(forces) << 2 | periodic;
    words[2] = atoms as u64;
    words[3] = if topology { bonds as u64 + 1 } else { 0 };
    let (numbers, integers) = words[HEAD..].split_at_mut(3 * atoms + CELL);
    let numbers: &mut [f64] = cast_slice_mut(numbers);
    numbers[..3 * atoms].copy_from_slice(geometry.positions.as_flattened());
    numbers[3 * atoms..].copy_from_slice(geometry.cell.as_flattened());
    if topology {
        let mut rest = integers;
        let Topology { species, centres, neighbours, images } = &*geometry.topology;
        for part in [species, centres, neighbours, images.as_flattened()] as [&[i32]; 4] {
            let (own, others) = rest.split_at_mut(half(part.len()));
            cast_slice_mut::<u64, i32>(own)[..part.len()].copy_from_slice(part);
            rest = others;
        }
    }
}

/// Writes a pull-back, which takes one word and one for each number.
pub(crate) fn write_pull_back(cotangent: &[f64], with_energy: bool, words: &mut [u64]) {
    words[0] = if with_energy { PULL_BACK_WITH_ENERGY } else { PULL_BACK };
    cast_slice_mut::<u64, f64>(&mut words[1..]).copy_from_slice(cotangent);
}

/// Reads a call. `last` is the topology of the client's last evaluation.
///
/// # Errors
/// What is wrong with the message.
pub(crate) fn read(words: &[u64], last: Option<&Arc<Topology>>) -> Result<Call, String> {
    match words.first() {
        Some(kind @ &(PULL_BACK | PULL_BACK_WITH_ENERGY)) => {
            let with_energy = *kind == PULL_BACK_WITH_ENERGY;
            Ok(Call::PullBack { cotangent: cast_slice(&words[1..]).to_vec(), with_energy })
        }
        Some(&EVALUATE) => read_evaluate(words, last),
        kind => Err(format!(
            "a message of the kind {kind:?}; expected {EVALUATE}, {PULL_BACK} or {PULL_BACK_WITH_ENERGY}"
        )),
    }
}

fn read_evaluate(words: &[u64], last: Option<&Arc<Topology>>) -> Result<Call, String> {
    let short = || format!("a message of {} words, which is too short", words.len());
    let [_, options, atoms, bonds, rest @ ..] = words else { return Err(short()) };
    let size = |count: u64| usize::try_from(count).ok().filter(|count| *count < 1 << 40).ok_or_else(short);
    let atoms = size(*atoms)?;
    let (numbers, mut integers) = rest.split_at_checked(3 * atoms + CELL).ok_or_else(short)?;
    let numbers: &[f64] = cast_slice(numbers);
    let (positions, cell) = numbers.split_at(3 * atoms);
    let topology = match bonds.checked_sub(1) {
        None => Arc::clone(last.ok_or("an evaluation without bonds before one with them")?),
        Some(bonds) => {
            let bonds = size(bonds)?;
            let mut take = |count: usize| {
                let (own, rest) = integers.split_at_checked(half(count)).ok_or_else(short)?;
                integers = rest;
                Ok::<_, String>(cast_slice::<u64, i32>(own)[..count].to_vec())
            };
            let (species, centres, neighbours) = (take(atoms)?, take(bonds)?, take(bonds)?);
            let images = take(3 * bonds)?.as_chunks().0.to_vec();
            let known = |atom: &i32| usize::try_from(*atom).is_ok_and(|atom| atom < atoms);
            if !centres.iter().chain(&neighbours).all(known) {
                return Err(format!("a bond of an atom that is not one of {atoms}"));
            }
            Arc::new(Topology { species, centres, neighbours, images })
        }
    };
    if topology.species.len() != atoms {
        return Err(format!("{atoms} atoms, but bonds of {}", topology.species.len()));
    }
    let cell: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|k| cell[3 * i + k]));
    let periodic = std::array::from_fn(|k| options >> (8 + k) & 1 == 1);
    let geometry = BondGeometry { topology, positions: positions.as_chunks().0.to_vec(), cell, periodic };
    let is_set = |bit: u64| options & bit == bit;
    let wanted = Wanted { features: is_set(1), pull_back_follows: is_set(2), forces: is_set(4) };
    Ok(Call::Evaluate { geometry, wanted })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn geometries() -> impl Strategy<Value = BondGeometry> {
        (1_usize..20, 0_usize..40).prop_flat_map(|(atoms, bonds)| {
            let index = || prop::collection::vec(0..atoms as i32, bonds);
            let images = prop::collection::vec(prop::array::uniform3(-3_i32..4), bonds);
            let numbers = prop::collection::vec(prop::array::uniform3(-50.0_f64..50.0), atoms);
            let species = prop::collection::vec(0_i32..5, atoms);
            let cell = prop::array::uniform3(prop::array::uniform3(-9.0_f64..9.0));
            (species, index(), index(), images, numbers, cell, prop::array::uniform3(any::<bool>())).prop_map(
                |(species, centres, neighbours, images, positions, cell, periodic)| {
                    let topology = Arc::new(Topology { species, centres, neighbours, images });
                    BondGeometry { topology, positions, cell, periodic }
                },
            )
        })
    }

    proptest! {
        #[test]
        fn evaluations_survive_shared_memory(geometry in geometries(), options in any::<[bool; 3]>(), sent in any::<bool>()) {
            let [features, forces, pull_back_follows] = options;
            let wanted = Wanted { features, forces, pull_back_follows };
            let mut words = vec![0; evaluate_words(&geometry, sent)];
            write_evaluate(&geometry, wanted, sent, &mut words);
            let read = read(&words, Some(&geometry.topology)).unwrap();
            prop_assert_eq!(read, Call::Evaluate { geometry, wanted });
        }

        #[test]
        fn broken_messages_are_refused(geometry in geometries(), cut in 1_usize..200) {
            let mut words = vec![0; evaluate_words(&geometry, true)];
            write_evaluate(&geometry, Wanted::ALL, true, &mut words);
            words.truncate(words.len().saturating_sub(cut));
            prop_assert!(read(&words, None).is_err());
        }
    }

    #[test]
    fn pull_backs_survive_shared_memory() {
        for with_energy in [false, true] {
            let cotangent = vec![1.5, -0.25, 1e300];
            let mut words = vec![0; 4];
            write_pull_back(&cotangent, with_energy, &mut words);
            assert_eq!(read(&words, None).unwrap(), Call::PullBack { cotangent, with_energy });
        }
    }
}
