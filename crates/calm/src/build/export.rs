//! The built mixture inside the export of its model (`kokkos.npz`), where LAMMPS and walkers read it.

use std::io::{self, Read, Seek, Write};

use npz::Writer;

use super::artifact::{BuiltMixture, UNUSED, schema, single, unused_inverse};
use super::components::BuiltComponent;
use crate::artifact::Projection;
use crate::linear::REGULARISATION;

/// The arrays of an export that describe a mixture.
const MIXTURE: [&str; 7] = [
    "uq_n_elements",
    "uq_max_clusters",
    "uq_feature_dim",
    "uq_centroids",
    "uq_inv_cov",
    "uq_n_clusters",
    "uq_interp_thresholds",
];

/// The arrays of an export that describe its features.
const FEATURES: [&str; 8] = [
    SCHEMA,
    "uq_rp_dim",
    "uq_rp_matrix",
    "uq_rp_seed",
    "uq_rp_normalize",
    "uq_rp_add_density_channel",
    "uq_rp_density_scale",
    "uq_feature_transform",
];

/// Without it, an export has no features.
const SCHEMA: &str = "uq_schema_version";

/// Diagonal of the inverse covariance of an element without atoms.
const MISSING_ELEMENT: &str = "uq_missing_elem_inv_cov_diag";

/// Writes a copy of a model's export with a mixture of `[elements, K slots, D features]`; all other arrays are copied byte by
/// byte. A model without features gets those of the projection, whose random seed may be known. Unused slots count, with
/// centroids that are never the nearest.
pub(super) fn embed<R: Read + Seek, W: Write + Seek>(
    mut model: R,
    out: W,
    projection: (&Projection, Option<i64>),
    [elements, slots, dimension]: [usize; 3],
    thresholds: impl IntoIterator<Item = f32>,
    centroids: impl IntoIterator<Item = f32>,
    inverses: impl IntoIterator<Item = f32>,
) -> io::Result<W> {
    let mut file = Writer::new(out);
    let has_features = npz::names(&mut model)?.iter().any(|key| key == SCHEMA);
    file.copy(model, |key| {
        key == MISSING_ELEMENT || MIXTURE.contains(&key) || (!has_features && FEATURES.contains(&key))
    })?;
    if !has_features {
        write_features(&mut file, projection)?;
    }
    for (key, number) in [MIXTURE[0], MIXTURE[1], MIXTURE[2]].into_iter().zip([elements, slots, dimension]) {
        file.array(key, &[1], [number as i64])?;
    }
    file.array(MISSING_ELEMENT, &[1], [(1.0 / REGULARISATION) as f32])?;
    file.array("uq_n_clusters", &[elements], vec![slots as i32; elements])?;
    file.array("uq_interp_thresholds", &[elements, slots], thresholds)?;
    file.array("uq_centroids", &[elements, slots, dimension], centroids)?;
    file.array("uq_inv_cov", &[elements, slots, dimension, dimension], inverses)?;
    file.finish()
}

/// The arrays of the projection, with the types of a model's export.
fn write_features<W: Write + Seek>(
    file: &mut Writer<W>,
    (projection, seed): (&Projection, Option<i64>),
) -> io::Result<()> {
    let flags = [projection.normalised, projection.density_channels, projection.asinh].map(i64::from);
    file.array(SCHEMA, &[1], [schema(projection)])?;
    file.array("uq_rp_dim", &[1], [projection.columns as i64])?;
    let matrix = projection.matrix.iter().copied();
    file.array("uq_rp_matrix", &[projection.rows, projection.columns], matrix)?;
    if let Some(seed) = seed {
        file.array("uq_rp_seed", &[1], [seed])?;
    }
    file.array("uq_rp_normalize", &[1], [flags[0]])?;
    file.array("uq_rp_add_density_channel", &[1], [flags[1]])?;
    file.array("uq_rp_density_scale", &[1], [projection.density_scale])?;
    file.array("uq_feature_transform", &[1], [flags[2]])
}

impl BuiltMixture {
    /// Writes a copy of the model's export with this mixture, which [`Artifact::load_export`](crate::Artifact::load_export)
    /// reads. All other arrays are copied byte by byte. They include the projection, unless the model has none.
    ///
    /// # Errors
    /// If reading or writing fails.
    pub fn write_export<R: Read + Seek, W: Write + Seek>(&self, model: R, out: W) -> io::Result<W> {
        let (elements, slots, dimension) = (self.elements().len(), self.slots(), self.dimension());
        let thresholds = self.thresholds().iter().flat_map(|thresholds| single(&thresholds.weighted));
        let centroids = self.slots_of_all().flat_map(|(of, slot)| match of {
            None => vec![0.0; dimension],
            Some(components) => components
                .get(slot)
                .map_or(vec![UNUSED; dimension], |component| single(&component.centroid).collect()),
        });
        let inverses = self.slots_of_all().flat_map(|(of, slot)| {
            let component = of.and_then(|components| components.get(slot));
            component.map_or_else(
                || unused_inverse(dimension).collect::<Vec<_>>(),
                |component| single(&component.inverse).collect(),
            )
        });
        embed(model, out, self.projection(), [elements, slots, dimension], thresholds, centroids, inverses)
    }

    /// Each slot of each element, with the element's components unless it has no atoms.
    fn slots_of_all(&self) -> impl Iterator<Item = (Option<&[BuiltComponent]>, usize)> {
        let components =
            self.elements().iter().map(|found| found.as_ref().map(|found| &found.components[..]));
        components.flat_map(|of| (0..self.slots()).map(move |slot| (of, slot)))
    }
}
