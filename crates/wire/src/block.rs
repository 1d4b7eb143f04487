//! A candidate as one block of bytes: a little-endian header followed by 8-byte-aligned arrays. Memory, network,
//! database and NumPy use the same bytes, and reading them copies nothing.
//!
//! | array | type | shape |
//! | --- | --- | --- |
//! | atomic numbers | u64 | n |
//! | positions | f64 | n × 3, Å |
//! | forces of the potential, without bias and ZBL | f64 | n × 3, eV/Å |
//! | γ under the walker's mixture | f64 | n |
//! | γ_nbr under the walker's mixture | f64 | n |
//! | features z | f64 | n × D |
//!
//! The arrays follow the header in this order without gaps, so n and D determine their offsets. The header contains the
//! total length and a CRC-32 of everything after the checksum.

mod candidate;
mod layout;
mod view;

use std::fmt;
use std::sync::Arc;

use zerocopy::IntoBytes;

use layout::{BlockDimensions, CandidateBlockHeader, HEADER, VERSION, length, write_checksum};

pub use candidate::Candidate;
pub use view::CandidateView;

/// Why bytes are not a valid candidate block.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BlockError {
    /// Shorter than the header.
    #[error("candidate block too short: {0} bytes, the header alone has {HEADER}")]
    Short(usize),
    /// Not aligned, so the block cannot be read in place.
    #[error("candidate block is not aligned to 8 bytes: copy it first")]
    Unaligned,
    /// Wrong magic bytes.
    #[error("not a candidate block (it begins with {0:02x?})")]
    Magic([u8; 8]),
    /// Another format version.
    #[error("candidate block of version {0}, expected version {VERSION}")]
    Version(u32),
    /// The length does not match the header.
    #[error("candidate block of {found} bytes, its header says {expected}")]
    Length {
        /// Actual length, bytes.
        found: u64,
        /// Length according to the header, bytes.
        expected: u64,
    },
    /// Wrong checksum.
    #[error("damaged candidate block: checksum {found:08x}, expected {expected:08x}")]
    Checksum {
        /// Checksum of the bytes.
        found: u32,
        /// Checksum in the header.
        expected: u32,
    },
    /// A field with an invalid value.
    #[error("candidate block with invalid {field}: {value}")]
    Field {
        /// Name of the field.
        field: &'static str,
        /// Its value.
        value: String,
    },
}

/// A validated block, in memory of this process or in shared memory of a walker. Clones share the memory.
#[derive(Clone)]
pub struct CandidateBlock {
    owner: Arc<dyn AsRef<[u8]> + Send + Sync>,
    /// Kept from validation, so that a later write of a walker to its memory cannot change the extent of an array.
    counts: BlockDimensions,
}

/// Memory of this process, aligned to 8 bytes.
struct AlignedBytes(Vec<u64>);

impl CandidateBlock {
    /// Encodes a candidate into memory of this process.
    ///
    /// # Panics
    /// See [`Candidate::encode_into`].
    pub fn encode(candidate: &Candidate) -> Self {
        let mut words = vec![0_u64; candidate.encoded_len() / 8];
        candidate.encode_into(words.as_mut_bytes());
        let counts =
            BlockDimensions { atoms: candidate.structure.len(), features: candidate.feature_dimension() };
        Self { owner: Arc::new(AlignedBytes(words)), counts }
    }

    /// Validates a block in place and keeps its owner, without copying. The bytes must not change afterwards.
    ///
    /// # Errors
    /// Invalid or damaged bytes, or bytes that are not aligned to 8.
    pub fn in_place(owner: Arc<dyn AsRef<[u8]> + Send + Sync>) -> Result<Self, BlockError> {
        let counts = CandidateView::new((*owner).as_ref())?.counts;
        Ok(Self { owner, counts })
    }

    /// Copies and validates `bytes`.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, BlockError> {
        let mut words = vec![0_u64; bytes.len().div_ceil(8)];
        let (copy, _) = words.as_mut_bytes().split_at_mut(bytes.len());
        copy.copy_from_slice(bytes);
        let counts = CandidateView::new(copy)?.counts;
        Ok(Self { owner: Arc::new(AlignedBytes(words)), counts })
    }

    /// The bytes of the block, aligned to 8.
    pub fn as_bytes(&self) -> &[u8] {
        (*self.owner).as_ref()
    }

    /// A view that reads the block in place.
    pub fn view(&self) -> CandidateView<'_> {
        CandidateView::arrays(self.as_bytes(), self.counts)
            .expect("the owner returns the bytes that were validated")
    }

    /// A copy of the block with other features ([n × D]), for example to restore features that were stored separately.
    ///
    /// # Errors
    /// [`BlockError::Field`] if the number of features is not a multiple of the number of atoms.
    pub fn with_features(&self, features: &[f64]) -> Result<Self, BlockError> {
        let header = self.view().header;
        let atoms = self.counts.atoms;
        if !features.len().is_multiple_of(atoms) {
            let value = format!("{} numbers for {atoms} atoms", features.len());
            return Err(BlockError::Field { field: "features", value });
        }
        let counts = BlockDimensions { atoms, features: features.len() / atoms };
        let length = length(atoms as u64, counts.features as u64);
        let mut words = vec![0_u64; length as usize / 8];
        let bytes = words.as_mut_bytes();
        // The features come last.
        let (before, tail) = bytes.split_at_mut(bytes.len() - size_of_val(features));
        before.copy_from_slice(&self.as_bytes()[..before.len()]);
        tail.copy_from_slice(features.as_bytes());
        let header = CandidateBlockHeader { length, features: counts.features as u64, ..header.clone() };
        bytes[..HEADER].copy_from_slice(header.as_bytes());
        write_checksum(bytes);
        Ok(Self { owner: Arc::new(AlignedBytes(words)), counts })
    }

    /// A copy of the block without features, for stores that keep them separately.
    pub fn without_features(&self) -> Self {
        self.with_features(&[]).expect("none for each atom")
    }
}

impl AsRef<[u8]> for AlignedBytes {
    fn as_ref(&self) -> &[u8] {
        self.0.as_bytes()
    }
}

impl PartialEq for CandidateBlock {
    fn eq(&self, other: &Self) -> bool {
        self.as_bytes() == other.as_bytes()
    }
}

impl fmt::Debug for CandidateBlock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "CandidateBlock({}, {} bytes)", self.view().id(), self.as_bytes().len())
    }
}
