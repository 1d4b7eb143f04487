//! A candidate as a walker holds it, and its encoding.

use atoms::{Matrix3, Structure, Vec3};
use zerocopy::IntoBytes;

use super::layout::{CandidateBlockHeader, MAGIC, VERSION, flatten, length, write_checksum};
use crate::ids::{CandidateId, ContentHash, Origin};

/// A structure with everything that its walker computed for it.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// Identifier.
    pub id: CandidateId,
    /// Biased, or a frame of a control walk.
    pub origin: Origin,
    /// Mixture version that the walker used.
    pub mixture_version: u64,
    /// Kinetic temperature, K.
    pub temperature: f64,
    /// V / V₀.
    pub relative_volume: f64,
    /// Energy of the potential, without bias and ZBL, eV.
    pub energy: f64,
    /// −∂E/∂ε of the potential, eV.
    pub virial: Matrix3,
    /// The structure.
    pub structure: Structure,
    /// −∂E/∂r of the potential, [n], eV/Å.
    pub forces: Vec<Vec3>,
    /// γ under the walker's mixture, [n].
    pub gamma: Vec<f64>,
    /// γ_nbr under the walker's mixture, [n].
    pub gamma_nbr: Vec<f64>,
    /// Features, [n × D].
    pub features: Vec<f64>,
}

impl Candidate {
    /// Length of the encoded block, bytes.
    pub fn encoded_len(&self) -> usize {
        length(self.structure.len() as u64, self.feature_dimension() as u64) as usize
    }

    /// Features per atom, D.
    pub(super) fn feature_dimension(&self) -> usize {
        self.features.len().checked_div(self.structure.len()).unwrap_or(0)
    }

    /// Encodes the candidate into `out`, which has [`Candidate::encoded_len`] bytes.
    ///
    /// # Panics
    /// If an array does not have the documented length, or if the id does not contain the hash of the structure. Both
    /// are errors of the caller, not of input.
    pub fn encode_into(&self, out: &mut [u8]) {
        let Self { structure, forces, gamma, gamma_nbr, features, .. } = self;
        let n = structure.len();
        assert!([structure.positions.len(), forces.len(), gamma.len(), gamma_nbr.len()] == [n; 4] && n > 0);
        assert_eq!(features.len() % n, 0, "features of every atom");
        assert_eq!(
            self.id.content,
            ContentHash::from_structure(structure),
            "the id contains the hash of the structure"
        );
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
            let (array, after) = rest.split_at_mut(part.len());
            array.copy_from_slice(part);
            rest = after;
        }
        write_checksum(out);
    }

    fn header(&self) -> CandidateBlockHeader {
        let Self { id, structure, .. } = self;
        let [x, y, z] = structure.periodic.map(u8::from);
        CandidateBlockHeader {
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
