//! The factors of the elements' channels in a sum over neighbours.

use super::vector::{Vector, to_lanes};
use super::weight_arrays::WeightArrays;

/// Name of the embedding Z of the elements, `[element, size]`.
pub(super) const EMBEDDING: &str = "chem_embedding";

/// ζ_e,n = s Σ_k Z_ek W_kn
#[derive(Clone, Debug)]
pub(super) struct ElementFactors {
    /// Name of W `[size, channels]`.
    pub transform: String,
    pub channels: usize,
    /// s
    pub scale: f64,
}

impl ElementFactors {
    /// ζ of each element.
    pub fn rows<V: Vector>(&self, arrays: &WeightArrays) -> Vec<Vec<V>> {
        let (transform, channels) = (&arrays[self.transform.as_str()], self.channels);
        let size = transform.len() / channels;
        let channel = |z: &[f64], n: usize| -> f64 {
            z.iter().enumerate().map(|(k, z)| z * transform[k * channels + n]).sum::<f64>() * self.scale
        };
        let row = |z: &[f64]| (0..channels).map(|n| channel(z, n)).collect::<Vec<_>>();
        arrays[EMBEDDING].chunks_exact(size).map(|z| to_lanes(&row(z))).collect()
    }

    /// Adds the derivatives with respect to Z and W, from those with respect to ζ, `[element][channel]`.
    pub fn pull_back(&self, arrays: &WeightArrays, of_rows: &[Vec<f64>], of_arrays: &mut WeightArrays) {
        let (transform, embedding) = (&arrays[self.transform.as_str()], &arrays[EMBEDDING]);
        let size = transform.len() / self.channels;
        for (element, row) in of_rows.iter().enumerate() {
            let z = &embedding[element * size..][..size];
            for (k, z) in z.iter().enumerate() {
                let w = &transform[k * self.channels..][..self.channels];
                let along: f64 = w.iter().zip(row).map(|(w, x)| w * x).sum();
                of_arrays[EMBEDDING][element * size + k] += self.scale * along;
                let of_transform = &mut of_arrays[self.transform.as_str()][k * self.channels..];
                of_transform.iter_mut().zip(row).for_each(|(w, x)| *w += self.scale * z * x);
            }
        }
    }
}
