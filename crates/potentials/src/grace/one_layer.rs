//! Reads GRACE-1L and builds its graph:
//!
//! A → A1 = FC(A, A) → AA = A1 × A1 → AA1 = FC(AA, A) → AAA = AA1 × A1; AA2 = FC(AA, A) → AAAA = AA2 × AA2.
//!
//! The energy uses the invariants up to the model's maximum order.

use npz::NpzFile;

use super::builder::{ModelBuilder, ModelParts};
use super::description::Architecture;
use super::error::GraceError;
use super::graph::Graph;
use super::layer::{LayerDraft, LayerMessage};
use super::networks::radial_network;
use super::radial::RadialFunctions;
use super::read_options::ReadOptions;
use super::readout::ReadoutBlock;
use super::shared_reader::{Embedding, Powers, cutoffs, elements, reject_unsupported_radial_variants};
use super::vector::Vector;
use super::weight_arrays::WeightArrays;

pub(super) fn read<V: Vector>(archive: &NpzFile, options: ReadOptions) -> Result<ModelParts<V>, GraceError> {
    let elements = elements(archive)?;
    reject_unsupported_radial_variants(archive, "mlp_rad", "A")?;
    let lmax = archive.count("lmax", 0, 12)?;
    let channels = archive.count("mlp_rad_n_rad_max", 1, 4096)?;
    if archive.contains("nradmax") {
        archive.expect_count("nradmax", channels)?;
    }
    let cutoffs = cutoffs(archive, elements.len())?;
    let mut weights = WeightArrays::default();
    let network = radial_network::<V>(archive, "mlp_rad", lmax, channels, &mut weights)?;
    let embedding = Embedding::read(archive, elements.len(), &mut weights)?;
    let scale = archive.scalar("A_inv_avg_n_neigh")?;
    let factors = embedding.transformed(archive, "A_lin_transform", channels, scale, &mut weights)?;

    let mut graph = Graph::new(archive, "A", (lmax + 1) * (lmax + 1), channels)?;
    let a = graph.density();
    Powers { letter: "A", third_with_mixed: true, taken_by: &["rho"] }.make(&mut graph, a)?;
    let (of_basis, map) = graph.invariants("rho", elements.len())?;
    let block = ReadoutBlock { weights: of_basis, map, norm: None };
    let radial = RadialFunctions::new(network, elements.len(), cutoffs, options.table_error::<V>());
    let constants = factors.rows(&weights);
    let message = LayerMessage { from: None, components: 1, constants, factors };
    let n_densities = archive.count("rho_n_out", 1, 4096)?;
    ModelBuilder {
        archive,
        architecture: Architecture::OneLayer,
        elements,
        layers: vec![LayerDraft { graph, radial, lmax, message, block }],
        block_order: vec![0],
        n_densities,
        weights,
    }
    .finish(options.training)
}
