//! The file of a built mixture.

use std::io::Cursor;

use calm::Artifact;
use calm::build::{BuiltMixture, Recalibration, ThresholdRule, read_histograms};

use super::{Blobs, built, projection, settings, weights};
use crate::common::{numbers, optional};

pub(super) fn mixture(asinh: bool, normalised: bool) -> BuiltMixture {
    let dimension = 5;
    let element = |seed, centres| {
        let blobs = Blobs::new(seed, dimension, centres, 600, 30.0);
        built(dimension, &blobs.centres.concat(), &blobs.features, &weights(seed, 600))
    };
    let elements = vec![Some(element(1, 3)), None, Some(element(2, 1))];
    let symbols = ["Al", "Si", "O"].map(str::to_owned).to_vec();
    let projection = calm::Projection { asinh, normalised, ..projection(dimension) };
    BuiltMixture::new(symbols, projection, Some(7), settings(dimension, &[1, 2, 4]), elements).unwrap()
}

#[test]
fn a_written_artifact_is_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("gmm_artifacts.npz");
    for (asinh, normalised, schema) in
        [(false, true, 6.0), (true, true, 6.0), (true, false, 4.0), (false, false, 3.0)]
    {
        let built = mixture(asinh, normalised);
        let bytes = built.write(Cursor::new(Vec::new())).unwrap().into_inner();
        assert_eq!(bytes, built.write(Cursor::new(Vec::new())).unwrap().into_inner());
        std::fs::write(&path, &bytes).unwrap();
        let artifact = Artifact::load(&path).unwrap();
        assert_eq!(artifact, built.artifact().unwrap());
        assert_eq!(artifact.unsound_components(), []);
        assert_eq!(numbers(&path, "__schema_version__"), [schema]);
    }
    // Provenance, and arrays that are only information.
    assert_eq!(numbers(&path, "uq_rp_seed"), [7.0]);
    assert_eq!(numbers(&path, "build_seed"), [42.0]);
    assert_eq!(numbers(&path, "build_candidates"), [1.0, 2.0, 4.0]);
    assert_eq!(numbers(&path, "build_shard_size"), [100.0]);
    assert_eq!(numbers(&path, "elements"), [0.0, 2.0]);
    assert_eq!(numbers(&path, "effective_rank_2"), [5.0, 0.0, 0.0]);
    assert_eq!(numbers(&path, "cond_number_2")[1..], [1.0, 1.0]);
    assert_eq!(numbers(&path, "centroids_2")[5..], [1e10_f32 as f64; 10]);
    assert_eq!(numbers(&path, "inv_cov_2")[25..31], [1e6, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert!(optional(&path, "centroids_1").is_none());
}

#[test]
fn stored_histograms_give_the_thresholds_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("gmm_artifacts.npz");
    let built = mixture(false, true);
    std::fs::write(&path, built.write(Cursor::new(Vec::new())).unwrap().into_inner()).unwrap();
    let elements = read_histograms(&path).unwrap();
    assert!(elements[1].is_none());
    let single = |values: &[f64]| values.iter().map(|&v| f64::from(v as f32)).collect::<Vec<_>>();
    for (key, weighted) in [("interp_thresholds", false), ("eff_interp_thresholds", true)] {
        let stored = numbers(&path, key);
        assert_eq!(stored[3..6], [1.0; 3]);
        for element in [0, 2] {
            let found = elements[element].as_ref().unwrap().thresholds(ThresholdRule::Robust, 5);
            let found = if weighted { found.weighted } else { found.raw };
            assert_eq!(single(&found), stored[3 * element..][..3]);
        }
    }
    // Weights shift the quantiles.
    assert_ne!(numbers(&path, "interp_thresholds"), numbers(&path, "eff_interp_thresholds"));
    let message = read_histograms(crate::common::model("al_eam_1l/kokkos.npz")).unwrap_err().to_string();
    assert!(message.contains("no array 'hist_bin_edges'"), "{message}");
}

/// An export of a model with an old mixture of one component.
pub(super) fn export() -> Cursor<Vec<u8>> {
    let mut model = npz::Writer::new(Cursor::new(Vec::new()));
    model.array("weights", &[2], [1.5, -2.0]).unwrap();
    model.strings("element_names", &[3], &["Al", "Si", "O"]).unwrap();
    for (key, value) in [
        ("uq_schema_version", 6_i64),
        ("uq_n_elements", 3),
        ("uq_max_clusters", 1),
        ("uq_feature_dim", 5),
        ("uq_rp_dim", 5),
        ("uq_rp_normalize", 1),
    ] {
        model.array(key, &[1], [value]).unwrap();
    }
    model.array("uq_centroids", &[3, 1, 5], [0.0_f32; 15]).unwrap();
    model.array("uq_rp_matrix", &[3, 5], projection(5).matrix).unwrap();
    model.finish().unwrap()
}

#[test]
fn an_export_with_the_mixture_is_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let (path, built) = (folder.path().join("kokkos.npz"), mixture(false, true));
    let written = built.write_export(export(), Cursor::new(Vec::new())).unwrap();
    std::fs::write(&path, written.into_inner()).unwrap();

    let (found, expected) = (Artifact::load_export(&path).unwrap(), built.artifact().unwrap());
    assert_eq!((&found.symbols, &found.projection), (&expected.symbols, &expected.projection));
    for element in 0..3 {
        let [found, expected] = [&found, &expected].map(|of| of.mixture.components(element).unwrap());
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(expected) {
            assert_eq!(found.centroid(), expected.centroid());
            assert_eq!(found.inverse(), expected.inverse());
            assert_eq!(found.threshold(), expected.threshold());
            assert!(found.statistics().is_none());
        }
    }
    assert_eq!(numbers(&path, "weights"), [1.5, -2.0]);
    assert_eq!(numbers(&path, "uq_n_clusters"), [3.0; 3]);
    assert_eq!(numbers(&path, "uq_missing_elem_inv_cov_diag"), [1e6]);
    assert_eq!(numbers(&path, "uq_centroids")[15..30], [0.0; 15]);
    assert_eq!(numbers(&path, "uq_centroids")[35..], [1e10_f32 as f64; 10]);
}

#[test]
fn thresholds_are_set_anew_without_the_data() {
    let folder = tempfile::tempdir().unwrap();
    let (path, other) = (folder.path().join("gmm_artifacts.npz"), folder.path().join("other.npz"));
    let bytes = mixture(false, true).write(Cursor::new(Vec::new())).unwrap().into_inner();
    std::fs::write(&path, &bytes).unwrap();
    let histograms = read_histograms(&path).unwrap();
    let write = |rule| {
        let found = Recalibration::new(rule, 5, &histograms);
        let written = found.write_artifact(Cursor::new(&bytes), Cursor::new(Vec::new())).unwrap();
        std::fs::write(&other, written.into_inner()).unwrap();
        Artifact::load(&other).unwrap()
    };
    // The rule of the build gives its thresholds.
    assert_eq!(write(ThresholdRule::Robust), Artifact::load(&path).unwrap());

    let found = write(ThresholdRule::Percentile(90.0));
    assert_eq!(numbers(&other, "scatter_2"), numbers(&path, "scatter_2"));
    assert_eq!(npz::NpzFile::open(&other).unwrap().strings("threshold_mode").unwrap(), ["percentile_90"]);
    let raw = numbers(&other, "interp_thresholds");
    for (element, slot, component) in found.mixture.iter().filter(|(element, ..)| *element != 1) {
        let histogram = &histograms[element].as_ref().unwrap().components[slot];
        // The mixture has the weighted quantile.
        assert_eq!(component.threshold(), numbers(&other, "eff_interp_thresholds")[3 * element + slot]);
        let above = histogram.count_above(raw[3 * element + slot]) / histogram.count() as f64;
        assert!((above - 0.1).abs() < 1e-5, "{above}");
    }
    assert_eq!(found.mixture.component(1, 0).unwrap().threshold(), 1.0);
}
