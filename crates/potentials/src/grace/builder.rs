//! Assembles a model from its layers.

use atoms::Species;
use npz::NpzFile;

use super::basis::BasisLayout;
use super::description::{Architecture, GraceDescription};
use super::error::{GraceError, mismatch};
use super::layer::LayerDraft;
use super::network::Network;
use super::networks::readout;
use super::projection::{FeatureMap, GraceProjection, has_projection};
use super::shared_reader::reject_unread_arrays;
use super::vector::Vector;
use super::weight_arrays::WeightArrays;

/// What a reader has extracted from a file.
pub(super) struct ModelBuilder<'a, V: Vector> {
    pub archive: &'a NpzFile,
    pub architecture: Architecture,
    pub elements: Vec<Species>,
    pub layers: Vec<LayerDraft<'a, V>>,
    /// The layers in the order of their blocks in the file's basis B.
    pub block_order: Vec<usize>,
    /// Number of densities y.
    pub n_densities: usize,
    /// The trained arrays outside the graphs.
    pub weights: WeightArrays,
}

/// All parts of a model.
pub(super) struct ModelParts<V: Vector> {
    pub network: Network<V>,
    /// The largest r_c over all layers for centre and neighbour element, `[n_elements²]`, Å.
    pub pair_cutoffs: Vec<f64>,
    pub description: GraceDescription,
    pub arrays: WeightArrays,
}

impl<V: Vector> ModelBuilder<'_, V> {
    /// Reads what follows the layers; `training` as in [`super::read_options::ReadOptions`]. Rejects the file if an array remains unread.
    pub fn finish(mut self, training: bool) -> Result<ModelParts<V>, GraceError> {
        let archive = self.archive;
        let blocks = self.layers.iter().map(|layer| layer.block.clone()).collect();
        let readout = readout(archive, blocks, self.n_densities, self.elements.len(), &mut self.weights)?;
        let sources: Vec<_> = self.layers.iter().map(|layer| layer.graph.sources.clone()).collect();
        let basis = BasisLayout::new::<V>(&sources, &self.block_order);
        let feature_map = feature_map(archive, &basis)?;
        reject_unread_arrays(archive, self.architecture.number_of_layers())?;
        for layer in &mut self.layers {
            self.weights.append(std::mem::take(&mut layer.graph.weights));
        }
        let description = self.describe(basis.dimension, feature_map.as_ref())?;
        let pairs = 0..self.elements.len() * self.elements.len();
        let radial = self.layers.iter().map(|layer| &layer.radial);
        let cutoff = |pair| radial.clone().map(|radial| radial.cutoff(pair)).fold(0.0, f64::max);
        let pair_cutoffs = pairs.map(cutoff).collect();
        let (mut layers, mut drafts) = (Vec::new(), self.layers.into_iter().peekable());
        while let Some(draft) = drafts.next() {
            let message = drafts.peek_mut().and_then(|next| next.message.from.as_mut());
            layers.push(draft.finish(message, training));
        }
        let network = Network { layers, readout, basis, feature_map };
        Ok(ModelParts { network, pair_cutoffs, description, arrays: self.weights })
    }

    fn describe(
        &self,
        basis_dimension: usize,
        feature_map: Option<&FeatureMap<V>>,
    ) -> Result<GraceDescription, GraceError> {
        let radial = self.layers.iter().map(|layer| &layer.radial);
        let first = &self.layers[0];
        Ok(GraceDescription {
            architecture: self.architecture,
            elements: self.elements.clone(),
            cutoff: radial.clone().map(|radial| radial.largest_cutoff()).fold(0.0, f64::max),
            pair_cutoffs: self.archive.count("has_bond_specific_cutoff", 0, 1)? == 1,
            lmax: first.lmax,
            radial_basis_size: first.radial.basis_size(),
            channels: first.graph.density().channels,
            basis_functions: self.layers.iter().flat_map(|layer| layer.graph.source_names.clone()).collect(),
            basis_dimension,
            feature_dimension: feature_map.map_or(0, |map| map.projection.feature_dimension()),
            weights: self.weights.count(),
            radial_tables: radial
                .flat_map(|radial| radial.tables())
                .map(|table| (table.intervals(), table.errors()))
                .collect(),
        })
    }
}

/// The feature map, if the file has one.
fn feature_map<V: Vector>(
    archive: &NpzFile,
    basis: &BasisLayout,
) -> Result<Option<FeatureMap<V>>, GraceError> {
    if !has_projection(archive) {
        return Ok(None);
    }
    let version = archive.count("uq_schema_version", 0, usize::MAX)?;
    let dimension = archive.count("uq_rp_dim", 1, 1 << 16)?;
    let matrix = archive.floats_f32("uq_rp_matrix")?.finite()?.with_shape(&[basis.dimension, dimension])?;
    let normalize = archive.flag_or("uq_rp_normalize", false)?;
    let density_channels = archive.flag_or("uq_rp_add_density_channel", false)?;
    let asinh = archive.flag_or("uq_feature_transform", false)?;
    let expected = match (normalize || density_channels, asinh) {
        (true, _) => 6,
        (false, true) => 4,
        (false, false) => 3,
    };
    if version != expected {
        return Err(mismatch(
            archive,
            "uq_schema_version",
            version.to_string(),
            format!("{expected}, as its flags imply"),
        ));
    }
    let layers = basis.blocks.len();
    let density_scale = archive.scalar_or("uq_rp_density_scale", 1.0)? as f32;
    let projection =
        GraceProjection { matrix, dimension, normalize, density_channels, density_scale, asinh, layers };
    archive.expect_count("uq_feature_dim", projection.feature_dimension())?;
    Ok(Some(FeatureMap::new(projection, basis)))
}
