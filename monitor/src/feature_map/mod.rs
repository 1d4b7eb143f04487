//! A map of feature space: where the environments of collected structures lie along two principal components, and the data behind the
//! initial mixture beside them.
//!
//! One plane for each element, and one of all elements together. Its axes are the first two principal components of a set of which one
//! half is the data behind the components, and the other a sample of the atoms that the campaign collected; without statistics
//! of the mixture, all of it is the sample. So both the known and the new have a part in what is seen.

mod plane;
mod read;

use serde::Serialize;

pub use self::read::{MapSample, read};

/// Largest number of elements with a plane of their own. Those with the most collected atoms are kept.
pub const MAX_ELEMENTS: usize = 6;

/// The planes and the structures in them.
#[derive(Clone, Debug, Serialize)]
pub struct FeatureSpaceMap {
    /// Version of the potential that has these features; `None` in a campaign whose walks all had version 0.
    pub version: Option<u32>,
    /// Dimension D of the features; 0 without any.
    pub dimension: usize,
    /// Candidates accepted, and how many of them are shown.
    pub accepted: ShownPart,
    /// Frames of control walks.
    pub control: ShownPart,
    /// The structures that are shown; points refer to them by place.
    pub structures: Vec<MappedStructure>,
    /// That of all elements first, if there are several.
    pub planes: Vec<MapPlane>,
}

/// How many of all are shown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ShownPart {
    /// In the campaign, of the version.
    pub all: u64,
    /// On the map.
    pub shown: u64,
}

/// A structure on the map.
#[derive(Clone, Debug, Serialize)]
pub struct MappedStructure {
    /// Its name.
    pub id: String,
    /// `biased` or `control`.
    pub origin: &'static str,
    /// Number of its walk.
    pub walk: u32,
    /// Step of the walk.
    pub step: u64,
}

/// The plane of an element, or of all.
#[derive(Clone, Debug, Serialize)]
pub struct MapPlane {
    /// The element; `None` for all together.
    pub element: Option<&'static str>,
    /// Share of the variance along each axis.
    pub shares: [f64; 2],
    /// Atoms from which the collected half of the axes follows.
    pub sampled_atoms: usize,
    /// Components of the initial mixture; empty without statistics.
    pub components: Vec<MapComponent>,
    /// One for each structure and element.
    pub points: Vec<MapPoint>,
}

/// The training data of one component as an ellipse.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MapComponent {
    /// Its element.
    pub element: &'static str,
    /// Its number.
    pub component: usize,
    /// Environments in its data.
    pub environments: f64,
    /// The mean.
    pub centre: [f64; 2],
    /// The covariance: xx, xy, yy.
    pub covariance: [f64; 3],
}

/// The atoms of one element of a structure.
#[derive(Clone, Debug, Serialize)]
pub struct MapPoint {
    /// Place in [`FeatureSpaceMap::structures`].
    pub structure: usize,
    /// The element.
    pub element: &'static str,
    /// The atom with the largest γ₀ of this element, from 0.
    pub atom: usize,
    /// Its place.
    pub at: [f32; 2],
    /// The mean place of all atoms of this element.
    pub mean: [f32; 2],
    /// γ₀ of that atom.
    pub gamma: Option<f32>,
    /// Largest γ of an atom of this element under the selector's mixture at the decision.
    pub gamma_current: Option<f32>,
    /// Largest |F_model − F_label| of an atom of this element, eV/Å; `None` without a label.
    pub force_error: Option<f32>,
}
