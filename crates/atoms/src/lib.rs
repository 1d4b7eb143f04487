//! Atomic structures: species, cell, neighbour list, the [`Potential`] trait, and file formats.
//!
//! Internal units: eV, Å, fs, u, K. The module of a foreign format converts its units.

pub mod cell;
mod covalent_radius;
mod element_pair;
pub mod extxyz;
mod fragments;
pub mod lammps_dump;
mod min_distances;
mod neighbours;
pub mod poscar;
mod potential;
pub mod prototypes;
mod read;
mod species;
mod structure;
mod supercell;
pub mod units;

pub use cell::{Cell, Matrix3, Vec3};
pub use element_pair::{ElementPair, ShortestDistances};
pub use fragments::{BOND_FACTOR, fragments};
pub use min_distances::{CloseContact, MinDistanceRule, MinDistances, PerPair, Uniform};
pub use neighbours::{Bond, Neighbour, NeighbourList, shortest_distance};
pub use potential::{Evaluation, Potential, PotentialError};
pub use read::{FileError, open_extxyz, read_extxyz, read_poscar, read_structures};
pub use species::{Species, UnknownSpecies, composition, element_symbol};
pub use structure::{Structure, StructureError};
pub use supercell::Repetition;
