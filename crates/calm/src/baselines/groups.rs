//! Division of atoms into groups: by element, or by nearest centroid of their element.

use super::error::{BaselineError, check_element};
use crate::grade::nearest;
use crate::mixture::Mixture;

/// Atoms of a group that are visited together: their rows, and products of these, stay in the cache.
const BLOCK_ROWS: usize = 256;

/// The groups, those of the first element first.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct AtomGroups {
    dimension: usize,
    /// `[K × D]` for each element; without centroids, the element is one group.
    centroids: Vec<Vec<f64>>,
}

impl AtomGroups {
    /// One group for each element.
    pub fn of_elements(dimension: usize, elements: usize) -> Self {
        Self { dimension, centroids: vec![Vec::new(); elements] }
    }

    /// The atoms nearest to each centroid, `[K × D]` for each element.
    pub fn of_centroids(dimension: usize, centroids: Vec<Vec<f64>>) -> Self {
        Self { dimension, centroids }
    }

    /// One group for each component with atoms. An element without atoms has no centroid: that of
    /// [`crate::Component::unknown_element`] has no meaning.
    pub fn of_components(mixture: &Mixture) -> Self {
        let mut centroids = vec![Vec::new(); mixture.element_count()];
        for (element, _, component) in mixture.iter() {
            if component.statistics().is_none_or(|statistics| statistics.count > 0.0) {
                centroids[element].extend_from_slice(component.centroid());
            }
        }
        Self { dimension: mixture.dimension(), centroids }
    }

    pub fn dimension(&self) -> usize {
        self.dimension
    }

    /// The centroids of each element.
    pub fn centroids(&self) -> &[Vec<f64>] {
        &self.centroids
    }

    /// Number of groups of each element.
    pub fn counts(&self) -> impl Iterator<Item = usize> {
        self.centroids.iter().map(|centroids| (centroids.len() / self.dimension).max(1))
    }

    /// Number of groups.
    pub fn count(&self) -> usize {
        self.counts().sum()
    }

    /// Centroid of a group; `None` for the group of an element.
    pub fn centroid(&self, mut group: usize) -> Option<&[f64]> {
        for (centroids, count) in self.centroids.iter().zip(self.counts()) {
            if group < count {
                return centroids.chunks_exact(self.dimension).nth(group);
            }
            group -= count;
        }
        None
    }

    /// The group of each atom of a batch, `[atoms × D]`.
    pub fn assign(&self, elements: &[usize], features: &[f64]) -> Result<Vec<usize>, BaselineError> {
        let mut firsts = vec![0];
        self.counts().for_each(|count| firsts.push(firsts[firsts.len() - 1] + count));
        let rows = elements.iter().zip(features.chunks_exact(self.dimension)).enumerate();
        rows.map(|(atom, (&element, z))| {
            check_element(atom, element, self.centroids.len())?;
            let centroids = self.centroids[element].chunks_exact(self.dimension);
            Ok(firsts[element] + if centroids.len() > 1 { nearest(centroids, z) } else { 0 })
        })
        .collect()
    }
}

/// Calls `visit` with each group that has atoms, the indices of its atoms, and their rows `[atoms × D]`; several times with a group of more
/// than [`BLOCK_ROWS`] atoms.
pub(super) fn for_each_group(
    groups: &[usize],
    dimension: usize,
    features: &[f64],
    mut visit: impl FnMut(usize, &[usize], &mut Vec<f64>),
) {
    let mut order: Vec<usize> = (0..groups.len()).collect();
    order.sort_by_key(|&atom| groups[atom]);
    let mut rows = Vec::new();
    let all = order.chunk_by(|&a, &b| groups[a] == groups[b]);
    for atoms in all.flat_map(|atoms| atoms.chunks(BLOCK_ROWS)) {
        rows.clear();
        atoms.iter().for_each(|atom| rows.extend_from_slice(&features[atom * dimension..][..dimension]));
        visit(groups[atoms[0]], atoms, &mut rows);
    }
}

/// Subtracts a centroid from each row.
pub(super) fn subtract(rows: &mut [f64], centroid: &[f64]) {
    for row in rows.chunks_exact_mut(centroid.len()) {
        row.iter_mut().zip(centroid).for_each(|(z, centre)| *z -= centre);
    }
}
