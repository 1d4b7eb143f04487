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
//! The arrays follow the header (see [`Header`]) in this order without gaps, so their places follow from
//! n and D; the header repeats the length of the whole, and a CRC-32 of everything after itself.

use std::fmt;
use std::sync::Arc;

use atoms::{Cell, Matrix3, Species, Structure, Vec3};
use zerocopy::{CastError, FromBytes, Immutable, IntoBytes, KnownLayout};

use crate::ids::{CampaignId, CandidateId, ContentHash, Origin, WalkId};

#[cfg(not(target_endian = "little"))]
compile_error!("candidate blocks are little-endian and read in place");

const MAGIC: [u8; 8] = *b"CALMCAND";
const VERSION: u32 = 1;
/// More atoms or features than this are taken for a damaged header.
const LARGEST: u64 = 1 << 32;

/// What a walker knows of a structure when it offers it.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// Its name.
    pub id: CandidateId,
    /// Biased, or a frame of a control walk.
    pub origin: Origin,
    /// Version of the mixture that the walker saw.
    pub mixture_version: u64,
    /// Kinetic temperature, K.
    pub temperature: f64,
    /// V / V₀.
    pub relative_volume: f64,
    /// Energy of the potential, without bias and ZBL, eV.
    pub energy: f64,
    /// −∂E/∂ε of the same, eV.
    pub virial: Matrix3,
    /// The structure.
    pub structure: Structure,
    /// −∂E/∂r of the same, [n], eV/Å.
    pub forces: Vec<Vec3>,
    /// γ under the walker's mixture, [n].
    pub gamma: Vec<f64>,
    /// γ_nbr under the walker's mixture, [n].
    pub gamma_nbr: Vec<f64>,
    /// Features, [n × D].
    pub features: Vec<f64>,
}

/// The fixed part of a block, 288 bytes.
#[derive(Clone, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct Header {
    magic: [u8; 8],
    version: u32,
    checksum: u32,
    length: u64,
    atoms: u64,
    features: u64,
    campaign: [u8; 16],
    content: [u8; 32],
    walk: u32,
    segment: u32,
    step: u64,
    mixture_version: u64,
    origin: u32,
    periodic: [u8; 4],
    temperature: f64,
    relative_volume: f64,
    energy: f64,
    cell: [f64; 9],
    virial: [f64; 9],
}

const HEADER: usize = size_of::<Header>();
/// The checksum covers everything behind itself.
const CHECKED_FROM: usize = 16;

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

/// Numbers of atoms and of features an atom.
#[derive(Clone, Copy, Debug)]
struct Counts {
    atoms: usize,
    features: usize,
}

/// Memory of this process, aligned to 8.
struct Words(Vec<u64>);

/// A block read in place.
#[derive(Clone, Debug)]
pub struct CandidateView<'a> {
    header: &'a Header,
    counts: Counts,
    /// Atomic numbers, [n].
    pub numbers: &'a [u64],
    /// Positions, [n], Å.
    pub positions: &'a [Vec3],
    /// Forces of the potential, [n], eV/Å.
    pub forces: &'a [Vec3],
    /// γ under the walker's mixture, [n].
    pub gamma: &'a [f64],
    /// γ_nbr under the walker's mixture, [n].
    pub gamma_nbr: &'a [f64],
    /// Features, [n × D].
    pub features: &'a [f64],
}

/// Bytes of a block with `atoms` atoms and `features` features an atom.
fn length(atoms: u64, features: u64) -> u64 {
    HEADER as u64 + 8 * atoms * (1 + 3 + 3 + 1 + 1 + features)
}

/// Writes the checksum of a block into its header.
fn seal(block: &mut [u8]) {
    let checksum = crc32fast::hash(&block[CHECKED_FROM..]);
    block[CHECKED_FROM - 4..CHECKED_FROM].copy_from_slice(&checksum.to_le_bytes());
}

impl Candidate {
    /// Bytes of its block.
    pub fn encoded_len(&self) -> usize {
        length(self.structure.len() as u64, self.feature_dimension() as u64) as usize
    }

    /// Features an atom, D.
    fn feature_dimension(&self) -> usize {
        self.features.len().checked_div(self.structure.len()).unwrap_or(0)
    }

    /// Writes its block to `out`, [`Candidate::encoded_len`] bytes. The arrays must have the lengths their
    /// documentation gives, and its name the hash of its structure.
    ///
    /// # Panics
    /// If they have not: that is an error of the caller, not of input.
    pub fn encode_into(&self, out: &mut [u8]) {
        let Self { structure, forces, gamma, gamma_nbr, features, .. } = self;
        let n = structure.len();
        assert!([structure.positions.len(), forces.len(), gamma.len(), gamma_nbr.len()] == [n; 4] && n > 0);
        assert_eq!(features.len() % n, 0, "features of every atom");
        assert_eq!(self.id.content, ContentHash::of(structure), "the hash of this very structure");
        assert_eq!(out.len(), self.encoded_len(), "room for the block");
        let header = self.header();
        let numbers: Vec<u64> = structure.species.iter().map(|s| u64::from(s.atomic_number())).collect();
        let parts = [
            header.as_bytes(),
            numbers.as_bytes(),
            structure.positions.as_bytes(),
            forces.as_bytes(),
            gamma.as_bytes(),
            gamma_nbr.as_bytes(),
            features.as_bytes(),
        ];
        let mut rest = &mut *out;
        for part in parts {
            let (place, behind) = rest.split_at_mut(part.len());
            place.copy_from_slice(part);
            rest = behind;
        }
        seal(out);
    }

    fn header(&self) -> Header {
        let Self { id, structure, .. } = self;
        let [x, y, z] = structure.periodic.map(u8::from);
        Header {
            magic: MAGIC,
            version: VERSION,
            checksum: 0,
            length: self.encoded_len() as u64,
            atoms: structure.len() as u64,
            features: self.feature_dimension() as u64,
            campaign: id.campaign.0,
            content: id.content.0,
            walk: id.walk.0,
            segment: id.segment,
            step: id.step,
            mixture_version: self.mixture_version,
            origin: self.origin as u32,
            periodic: [x, y, z, 0],
            temperature: self.temperature,
            relative_volume: self.relative_volume,
            energy: self.energy,
            cell: flatten(&structure.cell.0),
            virial: flatten(&self.virial),
        }
    }
}

impl CandidateBlock {
    /// Encodes a candidate into memory of this process.
    ///
    /// # Panics
    /// As [`Candidate::encode_into`].
    pub fn encode(candidate: &Candidate) -> Self {
        let mut words = vec![0_u64; candidate.encoded_len() / 8];
        candidate.encode_into(words.as_mut_bytes());
        let counts = Counts { atoms: candidate.structure.len(), features: candidate.feature_dimension() };
        Self { owner: Arc::new(Words(words)), counts }
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
        Ok(Self { owner: Arc::new(Words(words)), counts })
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

    /// The same block without its features, for a store that keeps those apart.
    pub fn without_features(&self) -> Self {
        let header = self.view().header;
        let counts = Counts { features: 0, ..self.counts };
        let length = length(counts.atoms as u64, 0);
        let mut words = vec![0_u64; length as usize / 8];
        let bytes = words.as_mut_bytes();
        // The features are what stands last.
        bytes.copy_from_slice(&self.as_bytes()[..bytes.len()]);
        bytes[..HEADER].copy_from_slice(
            Header { length, atoms: counts.atoms as u64, features: 0, ..header.clone() }.as_bytes(),
        );
        seal(bytes);
        Self { owner: Arc::new(Words(words)), counts }
    }
}

impl AsRef<[u8]> for Words {
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

impl<'a> CandidateView<'a> {
    /// Reads `bytes` (8-byte aligned) in place after checking all of them.
    pub fn new(bytes: &'a [u8]) -> Result<Self, BlockError> {
        let view = Self::split(bytes)?;
        let expected = view.header.checksum;
        let found = crc32fast::hash(&bytes[CHECKED_FROM..]);
        if found != expected {
            return Err(BlockError::Checksum { found, expected });
        }
        let field = |field, value: String| Err(BlockError::Field { field, value });
        if view.header.origin > 1 {
            return field("origin", view.header.origin.to_string());
        }
        if let Some(number) = view.numbers.iter().find(|z| !(1..=118).contains(*z)) {
            return field("atomic number", number.to_string());
        }
        if view.header.periodic.iter().any(|p| *p > 1) || view.header.periodic[3] != 0 {
            return field("periodic", format!("{:?}", view.header.periodic));
        }
        if ContentHash::of(&view.structure()) != view.id().content {
            return field("content hash", view.id().content.to_string());
        }
        Ok(view)
    }

    /// Places of the arrays, checked against the length at hand.
    fn split(bytes: &'a [u8]) -> Result<Self, BlockError> {
        let short = || BlockError::Short(bytes.len());
        let (header, _) = Header::ref_from_prefix(bytes).map_err(|error| match error {
            CastError::Alignment(_) => BlockError::Unaligned,
            _ => short(),
        })?;
        if header.magic != MAGIC {
            return Err(BlockError::Magic(header.magic));
        }
        if header.version != VERSION {
            return Err(BlockError::Version(header.version));
        }
        let found = bytes.len() as u64;
        let (atoms, features) = (header.atoms, header.features);
        let plausible = (1..LARGEST).contains(&atoms) && atoms.saturating_mul(features) < LARGEST;
        let expected = if plausible { length(atoms, features) } else { header.length };
        if !plausible || header.length != expected || found != expected {
            return Err(BlockError::Length { found, expected });
        }
        Self::arrays(bytes, Counts { atoms: atoms as usize, features: features as usize })
    }

    /// Places of the arrays of a block with so many atoms and features.
    fn arrays(bytes: &'a [u8], counts: Counts) -> Result<Self, BlockError> {
        let short = || BlockError::Short(bytes.len());
        let (header, rest) = Header::ref_from_prefix(bytes).map_err(|_| short())?;
        let n = counts.atoms;
        let (numbers, rest) = <[u64]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let (positions, rest) = <[Vec3]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let (forces, rest) = <[Vec3]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let (gamma, rest) = <[f64]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let (gamma_nbr, rest) = <[f64]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let features = <[f64]>::ref_from_bytes_with_elems(rest, n * counts.features).map_err(|_| short())?;
        Ok(Self { header, counts, numbers, positions, forces, gamma, gamma_nbr, features })
    }

    /// Its name.
    pub fn id(&self) -> CandidateId {
        CandidateId {
            campaign: CampaignId(self.header.campaign),
            walk: WalkId(self.header.walk),
            segment: self.header.segment,
            step: self.header.step,
            content: ContentHash(self.header.content),
        }
    }

    /// Biased or control.
    pub fn origin(&self) -> Origin {
        if self.header.origin == Origin::Control as u32 { Origin::Control } else { Origin::Biased }
    }

    /// Version of the mixture that the walker saw.
    pub fn mixture_version(&self) -> u64 {
        self.header.mixture_version
    }

    /// Kinetic temperature, K.
    pub fn temperature(&self) -> f64 {
        self.header.temperature
    }

    /// V / V₀.
    pub fn relative_volume(&self) -> f64 {
        self.header.relative_volume
    }

    /// Energy of the potential, eV.
    pub fn energy(&self) -> f64 {
        self.header.energy
    }

    /// −∂E/∂ε of the potential, eV.
    pub fn virial(&self) -> Matrix3 {
        unflatten(&self.header.virial)
    }

    /// Features an atom, D.
    pub fn feature_dimension(&self) -> usize {
        self.counts.features
    }

    /// The structure, copied out.
    pub fn structure(&self) -> Structure {
        let species =
            self.numbers.iter().filter_map(|z| Species::from_atomic_number(*z as u8).ok()).collect();
        let periodic = std::array::from_fn(|k| self.header.periodic[k] == 1);
        Structure {
            species,
            positions: self.positions.to_vec(),
            cell: Cell(unflatten(&self.header.cell)),
            periodic,
        }
    }

    /// Everything, copied out.
    pub fn to_candidate(&self) -> Candidate {
        Candidate {
            id: self.id(),
            origin: self.origin(),
            mixture_version: self.mixture_version(),
            temperature: self.temperature(),
            relative_volume: self.relative_volume(),
            energy: self.energy(),
            virial: self.virial(),
            structure: self.structure(),
            forces: self.forces.to_vec(),
            gamma: self.gamma.to_vec(),
            gamma_nbr: self.gamma_nbr.to_vec(),
            features: self.features.to_vec(),
        }
    }
}

fn flatten(m: &Matrix3) -> [f64; 9] {
    std::array::from_fn(|k| m[k / 3][k % 3])
}

fn unflatten(m: &[f64; 9]) -> Matrix3 {
    std::array::from_fn(|i| std::array::from_fn(|k| m[3 * i + k]))
}
