//! Memory layout of a block, see [`crate::block`].

use atoms::Matrix3;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

#[cfg(not(target_endian = "little"))]
compile_error!("candidate blocks are little-endian and read in place");

pub(super) const MAGIC: [u8; 8] = *b"CALMCAND";
pub(super) const VERSION: u32 = 1;
/// Limit for the number of atoms and of features; a header with more is damaged.
pub(super) const LARGEST: u64 = 1 << 32;

/// The header of a block, 288 bytes.
#[derive(Clone, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub(super) struct CandidateBlockHeader {
    pub magic: [u8; 8],
    pub version: u32,
    pub checksum: u32,
    pub length: u64,
    pub atoms: u64,
    pub features: u64,
    pub campaign: [u8; 16],
    pub content: [u8; 32],
    pub walk: u32,
    pub segment: u32,
    pub step: u64,
    pub mixture_version: u64,
    pub origin: u32,
    pub periodic: [u8; 4],
    pub temperature: f64,
    pub relative_volume: f64,
    pub energy: f64,
    pub cell: [f64; 9],
    pub virial: [f64; 9],
}

pub(super) const HEADER: usize = size_of::<CandidateBlockHeader>();
/// The checksum covers everything after this offset.
pub(super) const CHECKED_FROM: usize = 16;

/// Number of atoms, and of features per atom.
#[derive(Clone, Copy, Debug)]
pub(super) struct BlockDimensions {
    pub atoms: usize,
    pub features: usize,
}

/// Length of a block with `atoms` atoms and `features` features per atom, bytes.
pub(super) fn length(atoms: u64, features: u64) -> u64 {
    HEADER as u64 + 8 * atoms * (1 + 3 + 3 + 1 + 1 + features)
}

/// Writes the checksum of a block into its header.
pub(super) fn write_checksum(block: &mut [u8]) {
    let checksum = crc32fast::hash(&block[CHECKED_FROM..]);
    block[CHECKED_FROM - 4..CHECKED_FROM].copy_from_slice(&checksum.to_le_bytes());
}

pub(super) fn flatten(m: &Matrix3) -> [f64; 9] {
    std::array::from_fn(|k| m[k / 3][k % 3])
}

pub(super) fn unflatten(m: &[f64; 9]) -> Matrix3 {
    std::array::from_fn(|i| std::array::from_fn(|k| m[3 * i + k]))
}
