//! The built mixture inside the export of its model (`kokkos.npz`), where LAMMPS and walkers read it.

use std::io::{self, Read, Seek, Write};

use npz::Writer;

use super::artifact::{BuiltMixture, UNUSED, single};
use super::components::BuiltComponent;
use crate::linear::REGULARISATION;

/// The arrays of an export that describe a mixture. Those of the projection stay those of the model.
const MIXTURE: [&str; 7] = [
    "uq_n_elements",
    "uq_max_clusters",
    "uq_feature_dim",
    "uq_centroids",
    "uq_inv_cov",
    "uq_n_clusters",
    "uq_interp_thresholds",
];

/// Diagonal of the inverse covariance of an element without atoms.
const MISSING_ELEMENT: &str = "uq_missing_elem_inv_cov_diag";

impl BuiltMixture {
    /// Writes a copy of the model's export with this mixture, which [`Artifact::load_export`](crate::Artifact::load_export)
    /// reads. All other arrays, which include the projection, are copied byte by byte.
    ///
    /// # Errors
    /// If reading or writing fails.
    pub fn write_export<R: Read + Seek, W: Write + Seek>(&self, model: R, out: W) -> io::Result<W> {
        let mut file = Writer::new(out);
        file.copy(model, |key| key == MISSING_ELEMENT || MIXTURE.contains(&key))?;
        let (elements, slots, dimension) = (self.elements().len(), self.slots(), self.dimension());
        for (key, number) in
            [MIXTURE[0], MIXTURE[1], MIXTURE[2]].into_iter().zip([elements, slots, dimension])
        {
            file.array(key, &[1], [number as i64])?;
        }
        let missing = 1.0 / REGULARISATION;
        file.array(MISSING_ELEMENT, &[1], [missing as f32])?;
        // Unused slots count, with centroids that are never the nearest.
        file.array("uq_n_clusters", &[elements], vec![slots as i32; elements])?;
        let thresholds = self.thresholds().iter().flat_map(|thresholds| single(&thresholds.weighted));
        file.array("uq_interp_thresholds", &[elements, slots], thresholds)?;

        let centroids = self.slots_of_all().flat_map(|(of, slot)| match of {
            None => vec![0.0; dimension],
            Some(components) => components
                .get(slot)
                .map_or(vec![UNUSED; dimension], |component| single(&component.centroid).collect()),
        });
        file.array("uq_centroids", &[elements, slots, dimension], centroids)?;
        let empty = || {
            (0..dimension * dimension).map(|at| if at % (dimension + 1) == 0 { missing as f32 } else { 0.0 })
        };
        let inverses = self.slots_of_all().flat_map(|(of, slot)| {
            let component = of.and_then(|components| components.get(slot));
            component
                .map_or_else(|| empty().collect::<Vec<_>>(), |component| single(&component.inverse).collect())
        });
        file.array("uq_inv_cov", &[elements, slots, dimension, dimension], inverses)?;
        file.finish()
    }

    /// Each slot of each element, with the element's components unless it has no atoms.
    fn slots_of_all(&self) -> impl Iterator<Item = (Option<&[BuiltComponent]>, usize)> {
        let components =
            self.elements().iter().map(|found| found.as_ref().map(|found| &found.components[..]));
        components.flat_map(|of| (0..self.slots()).map(move |slot| (of, slot)))
    }
}
