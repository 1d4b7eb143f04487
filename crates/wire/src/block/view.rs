//! Reading a block in place, and its validation.

use atoms::{Cell, Matrix3, Species, Structure, Vec3};
use zerocopy::{CastError, FromBytes};

use super::BlockError;
use super::candidate::Candidate;
use super::layout::{
    BlockDimensions, CHECKED_FROM, CandidateBlockHeader, LARGEST, MAGIC, VERSION, length, unflatten,
};
use crate::ids::{CampaignId, CandidateId, ContentHash, Origin, WalkId};

/// A block read in place.
#[derive(Clone, Debug)]
pub struct CandidateView<'a> {
    pub(super) header: &'a CandidateBlockHeader,
    pub(super) counts: BlockDimensions,
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

impl<'a> CandidateView<'a> {
    /// Validates `bytes` (aligned to 8) and returns a view of them.
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
        if ContentHash::from_structure(&view.structure()) != view.id().content {
            return field("content hash", view.id().content.to_string());
        }
        Ok(view)
    }

    /// Locates the arrays and checks their lengths.
    fn split(bytes: &'a [u8]) -> Result<Self, BlockError> {
        let short = || BlockError::Short(bytes.len());
        let (header, _) = CandidateBlockHeader::ref_from_prefix(bytes).map_err(|error| match error {
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
        Self::arrays(bytes, BlockDimensions { atoms: atoms as usize, features: features as usize })
    }

    /// Locates the arrays of a block with these counts.
    pub(super) fn arrays(bytes: &'a [u8], counts: BlockDimensions) -> Result<Self, BlockError> {
        let short = || BlockError::Short(bytes.len());
        let (header, rest) = CandidateBlockHeader::ref_from_prefix(bytes).map_err(|_| short())?;
        let n = counts.atoms;
        let (numbers, rest) = <[u64]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let (positions, rest) = <[Vec3]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let (forces, rest) = <[Vec3]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let (gamma, rest) = <[f64]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let (gamma_nbr, rest) = <[f64]>::ref_from_prefix_with_elems(rest, n).map_err(|_| short())?;
        let features = <[f64]>::ref_from_bytes_with_elems(rest, n * counts.features).map_err(|_| short())?;
        Ok(Self { header, counts, numbers, positions, forces, gamma, gamma_nbr, features })
    }

    /// Identifier.
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

    /// Mixture version that the walker used.
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

    /// Features per atom, D.
    pub fn feature_dimension(&self) -> usize {
        self.counts.features
    }

    /// A copy of the structure.
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

    /// A copy of the whole candidate.
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
