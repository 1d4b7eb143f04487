//! Identifiers. The id of a candidate consists of campaign, walk, segment, step and content, so no two structures share
//! an id and sending a candidate twice has no effect.

use std::fmt;
use std::str::FromStr;

use atoms::Structure;
use serde::{Deserialize, Serialize};

/// Text that is not a valid identifier.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("'{found}' is not {expected}")]
pub struct IdError {
    found: String,
    expected: &'static str,
}

/// A campaign: the hash of everything that must not change during the campaign.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct CampaignId(pub [u8; 16]);

/// A walk of a campaign, numbered from 0 in the order of creation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct WalkId(pub u32);

/// Whether a walk is biased, or the unbiased control of a biased walk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Origin {
    /// Driven by the gradient of the grade.
    Biased,
    /// τ = 0 and no mixture updates, with the random numbers of the biased walk it matches.
    Control,
}

impl Origin {
    /// `"biased"` or `"control"`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Biased => "biased",
            Self::Control => "control",
        }
    }
}

/// BLAKE3 hash of species, positions, cell and periodicity, bit by bit.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct ContentHash(pub [u8; 32]);

impl ContentHash {
    /// Hashes a structure. Two structures have the same hash only if all their numbers are bitwise equal.
    pub fn from_structure(structure: &Structure) -> Self {
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"calmwalk structure 1");
        hasher.update(&(structure.len() as u64).to_le_bytes());
        for species in &structure.species {
            hasher.update(&[species.atomic_number()]);
        }
        for x in structure.cell.0.iter().chain(&structure.positions).flatten() {
            hasher.update(&x.to_le_bytes());
        }
        hasher.update(&structure.periodic.map(u8::from));
        Self(*hasher.finalize().as_bytes())
    }
}

/// Id of a candidate, written `campaign-walk.segment.step-content`, for example `9f8e7d6c-3.0.1240-0123456789abcdef`
/// (first 4 bytes of the campaign, first 8 bytes of the content).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct CandidateId {
    /// Campaign.
    pub campaign: CampaignId,
    /// Walk.
    pub walk: WalkId,
    /// Piece of the walk between two rollbacks, from 0.
    pub segment: u32,
    /// Step of the walk, including equilibration.
    pub step: u64,
    /// Hash of the structure.
    pub content: ContentHash,
}

impl fmt::Display for CandidateId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { campaign, walk, segment, step, content } = self;
        hex(f, &campaign.0[..4])?;
        write!(f, "-{walk}.{segment}.{step}-")?;
        hex(f, &content.0[..8])
    }
}

impl fmt::Display for CampaignId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        hex(f, &self.0)
    }
}

impl fmt::Display for WalkId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl fmt::Display for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        hex(f, &self.0)
    }
}

impl fmt::Debug for ContentHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        hex(f, &self.0)
    }
}

impl FromStr for CampaignId {
    type Err = IdError;

    fn from_str(text: &str) -> Result<Self, IdError> {
        unhex(text)
            .map(Self)
            .ok_or_else(|| IdError { found: text.into(), expected: "a campaign id (32 hexadecimal digits)" })
    }
}

impl FromStr for ContentHash {
    type Err = IdError;

    fn from_str(text: &str) -> Result<Self, IdError> {
        unhex(text)
            .map(Self)
            .ok_or_else(|| IdError { found: text.into(), expected: "a content hash (64 hexadecimal digits)" })
    }
}

fn hex(f: &mut fmt::Formatter<'_>, bytes: &[u8]) -> fmt::Result {
    bytes.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
}

fn unhex<const N: usize>(text: &str) -> Option<[u8; N]> {
    if text.len() != 2 * N || !text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return None;
    }
    let mut bytes = [0; N];
    for (k, byte) in bytes.iter_mut().enumerate() {
        *byte = u8::from_str_radix(text.get(2 * k..2 * k + 2)?, 16).ok()?;
    }
    Some(bytes)
}
