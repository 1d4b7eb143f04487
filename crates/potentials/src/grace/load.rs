//! Reads a model: detects its architecture, calls that reader, and checks the result.

use std::path::Path;
use std::sync::Arc;

use npz::NpzFile;

use super::builder::ModelParts;
use super::description::Architecture;
use super::error::GraceError;
use super::model::GraceModel;
use super::network::{AnyNetwork, Network};
use super::precision::Precision;
use super::projection::has_projection;
use super::radial::RadialPath;
use super::read_options::ReadOptions;
use super::symmetry::require_invariance;
use super::vector::Vector;
use super::weight_arrays::WeightArrays;
use super::{one_layer, three_layers, two_layers};

impl GraceModel {
    /// Reads a model for double precision with tabulated radial functions.
    ///
    /// # Errors
    /// With file, array, what was found and what was expected.
    pub fn load(path: &Path) -> Result<Self, GraceError> {
        Self::load_in(path, Precision::Double, RadialPath::default())
    }

    /// Reads a model for this precision, with this evaluation of radial functions.
    ///
    /// # Errors
    /// As [`GraceModel::load`].
    pub fn load_in(path: &Path, precision: Precision, radial: RadialPath) -> Result<Self, GraceError> {
        let archive = NpzFile::open(path)?;
        let options = ReadOptions { radial, training: false };
        let read = match precision {
            Precision::Double => Self::read(&archive, options, AnyNetwork::Double),
            Precision::Mixed => Self::read(&archive, options, AnyNetwork::Mixed),
        };
        read.map(|(model, _)| model)
    }

    /// Whether a file has a projection of the features.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn has_projection(path: &Path) -> Result<bool, GraceError> {
        Ok(has_projection(&NpzFile::open(path)?))
    }

    /// The model and its trained arrays.
    pub(super) fn read<V: Vector>(
        archive: &NpzFile,
        options: ReadOptions,
        any: fn(Arc<Network<V>>) -> AnyNetwork,
    ) -> Result<(Self, WeightArrays), GraceError> {
        let architecture = detect(archive);
        let ModelParts { network, pair_cutoffs, description, arrays } = match architecture {
            Architecture::OneLayer => one_layer::read(archive, options)?,
            Architecture::TwoLayer => two_layers::read(archive, options)?,
            Architecture::ThreeLayer => three_layers::read(archive, options)?,
        };
        let model = Self { network: any(Arc::new(network)), pair_cutoffs, description };
        let model = match architecture {
            Architecture::OneLayer => model,
            _ => require_invariance(archive, model)?,
        };
        Ok((model, arrays))
    }
}

/// Detects the depth by the lists of single-particle basis functions that only deeper models have.
fn detect(archive: &NpzFile) -> Architecture {
    if archive.contains("spbf_names") {
        Architecture::ThreeLayer
    } else if archive.contains("spb_names") {
        Architecture::TwoLayer
    } else {
        Architecture::OneLayer
    }
}
