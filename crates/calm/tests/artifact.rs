//! Loading artifacts and exports, and the errors of broken ones.

use std::path::Path;

use calm::{Artifact, ArtifactError};
use npyz::WriterBuilder;
use npyz::npz::NpzWriter;

use crate::common::{data, model, niobium};

#[test]
fn artifact_and_export_of_a_model_agree() {
    for name in ["al_eam_1l", "si_sw_1l"] {
        let artifact = Artifact::load(model(&format!("{name}/gmm_artifacts.npz"))).unwrap();
        let export = Artifact::load_export(model(&format!("{name}/kokkos.npz"))).unwrap();
        artifact.check_belongs_to(&export.symbols, &export.projection).unwrap();
        assert_eq!(artifact.projection.to_bytes(), export.projection.to_bytes());
        assert_eq!((artifact.mixture.dimension(), artifact.projection.columns), (130, 128));
        assert!(artifact.mixture.can_be_updated() && !export.mixture.can_be_updated());
        let (here, there) =
            (artifact.mixture.component(0, 0).unwrap(), export.mixture.component(0, 0).unwrap());
        assert_eq!((here.centroid(), here.inverse()), (there.centroid(), there.inverse()));
        assert_eq!(here.threshold(), there.threshold());
        let statistics = here.statistics().unwrap();
        assert!(statistics.count > 1000.0 && statistics.effective_count == statistics.count);
    }
}

#[test]
fn an_artifact_does_not_belong_to_another_model() {
    let aluminium = Artifact::load(model("al_eam_1l/gmm_artifacts.npz")).unwrap();
    let silicon = Artifact::load_export(model("si_sw_1l/kokkos.npz")).unwrap();
    let message = |artifact: &Artifact, model: &Artifact| {
        artifact.check_belongs_to(&model.symbols, &model.projection).unwrap_err().to_string()
    };
    assert!(message(&aluminium, &silicon).contains("list of elements is Al, the model's is Si"));
    let mut other = aluminium.clone();
    other.projection.matrix[77] += 1.0;
    assert!(message(&aluminium, &other).contains("projection matrix"));
    assert_ne!(aluminium.projection.to_bytes(), other.projection.to_bytes());
    let mut other = aluminium.clone();
    other.projection.asinh = true;
    assert!(message(&aluminium, &other).contains("asinh"));
}

#[test]
fn sentinels_are_left_out_and_absent_elements_are_there() {
    let artifact = niobium();
    assert_eq!(artifact.symbols, ["Mo", "Nb", "Ta", "W"]);
    let components = |element| artifact.mixture.components(element).unwrap();
    assert_eq!([0, 1, 2, 3].map(|element| components(element).len()), [1, 2, 1, 1]);
    assert_eq!(components(0)[0].inverse()[131], 1e6);
    assert_eq!(components(0)[0].threshold(), 1.0);
}

#[test]
fn broken_files_say_what_is_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("broken.npz");
    let message = |result: Result<Artifact, ArtifactError>| result.unwrap_err().to_string();

    assert!(message(Artifact::load(&path)).contains("broken.npz"));
    std::fs::write(&path, "no archive").unwrap();
    assert!(message(Artifact::load(&path)).contains("expected a NumPy .npz archive"));
    assert!(message(Artifact::load(data("niobium_reference.npz"))).contains("'__schema_version__'"));
    assert!(
        message(Artifact::load_export(model("al_eam_1l/gmm_artifacts.npz"))).contains("'uq_schema_version'")
    );

    write(&path, &[("__schema_version__", &[5.0], &[1])]);
    assert!(message(Artifact::load(&path)).contains("found schema version 5, expected version 3, 4 or 6"));
    write(&path, &[("__schema_version__", &[6.5], &[1])]);
    assert!(message(Artifact::load(&path)).contains("found 6.5, expected a whole number, 0 or more"));
    write(&path, &[("__schema_version__", &[6.0, 6.0], &[2])]);
    assert!(message(Artifact::load(&path)).contains("found shape [2], expected a single number"));
}

#[test]
fn a_broken_array_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("broken.npz");
    let text = |message: &str| {
        let found = Artifact::load_export(&path).unwrap_err().to_string();
        assert!(found.contains(message), "{found}");
    };
    write_export(&path, &[]);
    assert_eq!(Artifact::load_export(&path).unwrap().mixture.dimension(), 2);
    write_export(&path, &[("uq_centroids", &[0.0; 3], &[1, 1, 3])]);
    text("'uq_centroids': found shape [1, 1, 3], expected shape [1, 1, 2]");
    write_export(&path, &[("uq_inv_cov", &[1.0, 0.0, f64::NAN, 1.0], &[1, 1, 2, 2])]);
    text("component 0 of element 0: inverse covariance: found NaN, expected a finite number");
    write_export(&path, &[("uq_inv_cov", &[1.0, 0.5, 0.0, 1.0], &[1, 1, 2, 2])]);
    text("'uq_inv_cov': found 0e0 and 5e-1 on both sides of the diagonal of matrix 0, expected symmetric");
    write_export(&path, &[("uq_interp_thresholds", &[-1.0], &[1, 1])]);
    text("threshold: found -1, expected a finite number that is not negative");
    write_export(&path, &[("uq_rp_dim", &[3.0], &[1])]);
    text("'uq_rp_dim': found 3, expected 2");
    write_export(&path, &[("uq_rp_add_density_channel", &[1.0], &[1])]);
    text("found 2 columns for 2 features");
    write_export(&path, &[("uq_max_clusters", &[4e9], &[1])]);
    text("expected shape [1, 4000000000, 2]");
    write_export(&path, &[("uq_n_elements", &[2.0], &[1])]);
    text("'uq_n_elements': found 2, expected 1");
}

/// Truncating a file anywhere gives an error, never a panic.
#[test]
fn truncated_files_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.npz");
    let whole = std::fs::read(data("niobium_artifact.npz")).unwrap();
    for part in 0..40 {
        std::fs::write(&path, &whole[..whole.len() * part / 40]).unwrap();
        assert!(Artifact::load(&path).is_err());
    }
    // Corruption inside: every error names the file.
    for start in (0..whole.len() - 64).step_by(whole.len() / 60) {
        let mut damaged = whole.clone();
        damaged[start..start + 64].iter_mut().for_each(|byte| *byte ^= 0x5a);
        std::fs::write(&path, &damaged).unwrap();
        if let Err(error) = Artifact::load(&path) {
            assert!(error.to_string().contains("cut.npz"), "{error}");
        }
    }
}

type Entry<'a> = (&'a str, &'a [f64], &'a [u64]);

/// A minimal export with one element "Al" and D = 2, with some arrays replaced.
fn write_export(path: &Path, changed: &[Entry<'_>]) {
    let valid: [Entry<'_>; 11] = [
        ("uq_schema_version", &[3.0], &[1]),
        ("uq_n_elements", &[1.0], &[1]),
        ("uq_max_clusters", &[1.0], &[1]),
        ("uq_feature_dim", &[2.0], &[1]),
        ("uq_centroids", &[0.0, 1.0], &[1, 1, 2]),
        ("uq_inv_cov", &[1.0, 0.0, 0.0, 1.0], &[1, 1, 2, 2]),
        ("uq_interp_thresholds", &[2.0], &[1, 1]),
        ("uq_rp_matrix", &[1.0, 0.0, 0.0, 1.0, 1.0, 1.0], &[3, 2]),
        ("uq_rp_dim", &[2.0], &[1]),
        ("uq_rp_normalize", &[0.0], &[1]),
        ("uq_rp_add_density_channel", &[0.0], &[1]),
    ];
    let replaced = valid.map(|entry| *changed.iter().find(|change| change.0 == entry.0).unwrap_or(&entry));
    write(path, &replaced);
}

fn write(path: &Path, entries: &[Entry<'_>]) {
    let mut archive = NpzWriter::create(path).unwrap();
    for (key, values, shape) in entries {
        let mut array =
            archive.array(key, Default::default()).unwrap().default_dtype().shape(shape).begin_nd().unwrap();
        array.extend(values.iter().copied()).unwrap();
        array.finish().unwrap();
    }
    let kind = npyz::DType::Plain("|S2".parse().unwrap());
    let mut names = archive
        .array("element_names", Default::default())
        .unwrap()
        .dtype(kind)
        .shape(&[1])
        .begin_nd()
        .unwrap();
    names.push(b"Al".as_slice()).unwrap();
    names.finish().unwrap();
}
