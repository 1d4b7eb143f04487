//! How the cell moves.

use serde::{Deserialize, Serialize};

use crate::barostat::Barostat;
use crate::volume_ramp::VolumeRamp;

/// How the cell moves during a run: at most in one way.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum CellMotion {
    /// Not at all.
    #[default]
    Fixed,
    /// Its volume follows a ramp.
    VolumeRamp(VolumeRamp),
    /// It responds to the stress.
    Barostat(Box<Barostat>),
}

impl CellMotion {
    /// The volume ramp, if there is one.
    pub fn ramp(&self) -> Option<VolumeRamp> {
        match self {
            Self::VolumeRamp(ramp) => Some(*ramp),
            Self::Fixed | Self::Barostat(_) => None,
        }
    }

    /// The barostat, if there is one.
    pub fn barostat(&self) -> Option<&Barostat> {
        match self {
            Self::Barostat(barostat) => Some(barostat),
            Self::Fixed | Self::VolumeRamp(_) => None,
        }
    }

    pub(crate) fn barostat_mut(&mut self) -> Option<&mut Barostat> {
        match self {
            Self::Barostat(barostat) => Some(barostat),
            Self::Fixed | Self::VolumeRamp(_) => None,
        }
    }
}

impl From<VolumeRamp> for CellMotion {
    fn from(ramp: VolumeRamp) -> Self {
        Self::VolumeRamp(ramp)
    }
}

impl From<Barostat> for CellMotion {
    fn from(barostat: Barostat) -> Self {
        Self::Barostat(Box::new(barostat))
    }
}

/// Fixed where there is nothing.
impl<M: Into<CellMotion>> From<Option<M>> for CellMotion {
    fn from(motion: Option<M>) -> Self {
        motion.map_or(Self::Fixed, Into::into)
    }
}
