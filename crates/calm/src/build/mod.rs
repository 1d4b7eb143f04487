//! Builds a mixture from training data in three passes (paper, Methods: Latent features and uncertainty models).
//!
//! The caller streams the features **z** of the atoms of each element, `[atoms × D]`, with weights w; it owns files and
//! threads. The data are divided into *shards* of shuffled structures ([`shuffled`]), each streamed in a fixed order. A pass makes
//! one partial result for each element and shard. Those of pass 1 are combined in the order of the shards, those of passes 2
//! and 3 by [`ExactSums`] in any order, so the mixture does not depend on who made them. All are serialisable, so that a build
//! continues with its finished shards.
//!
//! 1. [`ShardClustering`] finds clusters by mini-batch k-means for every candidate K. [`Partitioner`] chooses K by the
//!    [`elbow`] of the within-cluster sum of squares, and the centroids **μ**_k by weighted k-means of those of the shards.
//! 2. [`ScatterPass`] assigns each atom to its nearest centroid, k* = argmin_k |**z** − **μ**_k|², and sums n = Σ 1,
//!    n_eff = Σ w and S_k = Σ w **δδ**ᵀ with **δ** = **z** − **μ**_k. [`components`] merges components with fewer than D + 1
//!    atoms, and inverts C + εI with C = S_k / n_eff and ε = 10⁻⁶.
//! 3. [`CalibrationPass`] fills histograms of σ = √(**δ**ᵀ(C + εI)⁺**δ** + 10⁻⁸). [`ElementHistograms::thresholds`] has the
//!    thresholds θ = median(σ) + 3 · 1.4826 · MAD(σ).
//!
//! Batches of some hundred atoms are fastest, since they stay in the cache. Passes 2 and 3 keep up to 128 atoms of each
//! component until a product of that size is worthwhile.
//!
//! [`BuiltMixture`] then is an [`Artifact`](crate::Artifact), and writes its file. An element without atoms has no
//! centroids, takes no part in passes 2 and 3, and becomes
//! [`Component::unknown_element`](crate::Component::unknown_element).

mod artifact;
mod artifact_version;
mod calibration;
mod components;
mod distances;
mod elbow;
mod error;
mod exact;
mod export;
mod groups;
mod histogram;
mod kmeans;
mod mini_batch;
mod moments;
mod partition;
mod projection;
mod random;
mod recalibrate;
mod scatter;
mod settings;
mod sorter;
mod thresholds;

pub use artifact::{BuiltElement, BuiltMixture, read_histograms};
pub use artifact_version::{ArtifactVersion, ArtifactVersionError};
pub use calibration::CalibrationPass;
pub use components::{BuiltComponent, components};
pub use elbow::elbow;
pub use error::BuildError;
pub use exact::ExactSums;
pub use histogram::{BINS, BinEdges, ElementHistograms, SigmaHistogram};
pub use mini_batch::{CandidateClusters, ShardClustering, ShardClusters};
pub use moments::{ComponentSums, ElementSums};
pub use partition::{ElementPartition, Partitioner};
pub use projection::random_projection;
pub(crate) use random::random_key;
pub use random::shuffled;
pub use recalibrate::Recalibration;
pub use scatter::ScatterPass;
pub use settings::BuildSettings;
pub use thresholds::{ThresholdRule, Thresholds};

#[cfg(test)]
mod tests {
    //! Helpers of the unit tests.

    use serde_json::Value;

    /// Small cases of the reference implementation.
    pub fn unit_cases() -> Value {
        serde_json::from_str(include_str!("../../tests/data/unit_cases.json")).unwrap()
    }

    pub fn numbers(value: &Value) -> Vec<f64> {
        serde_json::from_value(value.clone()).unwrap()
    }

    pub fn rows(value: &Value) -> Vec<Vec<f64>> {
        serde_json::from_value(value.clone()).unwrap()
    }

    /// Numbers that deviate by at most `tolerance` of the largest.
    #[track_caller]
    pub fn assert_near(found: &[f64], expected: &[f64], tolerance: f64) {
        assert_eq!(found.len(), expected.len());
        let largest = expected.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() <= tolerance * largest, "{found} instead of {expected}");
        }
    }
}
