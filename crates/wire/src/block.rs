//! A candidate as one block of bytes: a little-endian header, then 8-byte-aligned arrays. The same bytes
//! serve memory, network, database and numpy; reading them copies nothing.
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
//! The arrays follow the header in this order without gaps, so their places follow from
//! n and D; the header repeats the length of the whole, and a CRC-32 of everything after itself.

mod candidate;
mod layout;
mod view;

use std::fmt;
use std::sync::Arc;

use zerocopy::IntoBytes;

use layout::{Counts, HEADER, Header, VERSION, length, write_checksum};

pub use candidate::Candidate;
pub use view::CandidateView;

/// Why bytes are not a candidate.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BlockError {
    /// Fewer bytes than a header.
    #[error("a candidate block of {0} bytes: its header alone has {HEADER}")]
    Short(usize),
    /// Bytes that cannot be read in place.
    #[error("a candidate block whose bytes are not aligned to 8: copy it first")]
    Unaligned,
    /// Another file or message.
    #[error("not a candidate block (it begins with {0:02x?})")]
    Magic([u8; 8]),
    /// A block of another version of this program.
    #[error("a candidate block of version {0}; this program reads version {VERSION}")]
    Version(u32),
    /// Length and counts do not agree.
    #[error("a candidate block of {found} bytes whose header says {expected}")]
    Length {
        /// Bytes at hand.
        found: u64,
        /// Bytes that the header asks for.
        expected: u64,
    },
    /// Damaged.
    #[error("a damaged candidate block: checksum {found:08x}, expected {expected:08x}")]
    Checksum {
        /// Of the bytes at hand.
        found: u32,
        /// In the header.
        expected: u32,
    },
    /// A field with a value that has no meaning.
    #[error("a candidate block with {field} = {value}")]
    Field {
        /// Name of the field.
        field: &'static str,
        /// Its value.
        value: String,
    },
}

/// A checked block, in memory of this process or in memory that a walker shares. Clones share it.
#[derive(Clone)]
pub struct CandidateBlock {
    owner: Arc<dyn AsRef<[u8]> + Send + Sync>,
    /// As they were checked: what a walker might write to its memory afterwards moves no array.
    counts: Counts,
}

/// Memory of this process, aligned to 8.
struct AlignedBytes(Vec<u64>);

impl CandidateBlock {
    /// Encodes a candidate into memory of this process.
    ///
    /// # Panics
    /// As [`Candidate::encode_into`].
    pub fn encode(candidate: &Candidate) -> Self {
        let mut words = vec![0_u64; candidate.encoded_len() / 8];
        candidate.encode_into(words.as_mut_bytes());
        let counts = Counts { atoms: candidate.structure.len(), features: candidate.feature_dimension() };
        Self { owner: Arc::new(AlignedBytes(words)), counts }
    }

    /// Checks a block where it stands and keeps its owner, copying nothing. The bytes must not change any more.
    ///
    /// # Errors
    /// Other or damaged bytes, bytes that are not aligned to 8.
    pub fn in_place(owner: Arc<dyn AsRef<[u8]> + Send + Sync>) -> Result<Self, BlockError> {
        let counts = CandidateView::new((*owner).as_ref())?.counts;
        Ok(Self { owner, counts })
    }

    /// Copies and checks `bytes`.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, BlockError> {
        let mut words = vec![0_u64; bytes.len().div_ceil(8)];
        let (copy, _) = words.as_mut_bytes().split_at_mut(bytes.len());
        copy.copy_from_slice(bytes);
        let counts = CandidateView::new(copy)?.counts;
        Ok(Self { owner: Arc::new(AlignedBytes(words)), counts })
    }

    /// The bytes, 8-byte aligned.
    pub fn as_bytes(&self) -> &[u8] {
        (*self.owner).as_ref()
    }

    /// The block read in place.
    pub fn view(&self) -> CandidateView<'_> {
        CandidateView::arrays(self.as_bytes(), self.counts)
            .expect("its owner gives the bytes that were checked")
    }

    /// The same block with other features ([n × D]), such as those that it had before they were kept apart.
    ///
    /// # Errors
    /// [`BlockError::Field`] if they are not as many for each atom.
    pub fn with_features(&self, features: &[f64]) -> Result<Self, BlockError> {
        let header = self.view().header;
        let atoms = self.counts.atoms;
        if !features.len().is_multiple_of(atoms) {
            let value = format!("{} numbers for {atoms} atoms", features.len());
            return Err(BlockError::Field { field: "features", value });
        }
        let counts = Counts { atoms, features: features.len() / atoms };
        let length = length(atoms as u64, counts.features as u64);
        let mut words = vec![0_u64; length as usize / 8];
        let bytes = words.as_mut_bytes();
        // They stand last.
        let (before, place) = bytes.split_at_mut(bytes.len() - size_of_val(features));
        before.copy_from_slice(&self.as_bytes()[..before.len()]);
        place.copy_from_slice(features.as_bytes());
        let header = Header { length, features: counts.features as u64, ..header.clone() };
        bytes[..HEADER].copy_from_slice(header.as_bytes());
        write_checksum(bytes);
        Ok(Self { owner: Arc::new(AlignedBytes(words)), counts })
    }

    /// The same block without its features, for a store that keeps those apart.
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
