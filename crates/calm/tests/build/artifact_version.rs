//! The files of a mixture that was updated after its build.

use std::io::{Cursor, Read};
use std::path::Path;

use calm::build::{ArtifactVersion, read_histograms};
use calm::{Artifact, Batch, CovarianceUpdate, Mixture};
use npyz::npz::NpzArchive;

use super::stored::{export, mixture};
use crate::common::{Random, numbers, optional};

/// The mixture after an additive update by four atoms near a component.
fn updated(mixture: &Mixture, element: usize, slot: usize) -> Mixture {
    let mut random = Random(9);
    let centroid = mixture.component(element, slot).unwrap().centroid();
    let features: Vec<f64> =
        (0..4).flat_map(|_| centroid.iter().map(|at| at + 8.0 * random.next()).collect::<Vec<_>>()).collect();
    let batch = Batch::new(mixture, &[element; 4], &features).unwrap();
    let changed = batch.updated(CovarianceUpdate::Additive { alpha: 0.4 }).unwrap();
    assert_eq!(
        changed.iter().map(|change| (change.element, change.slot)).collect::<Vec<_>>(),
        [(element, slot)]
    );
    mixture.with_changes(&changed).unwrap()
}

fn write(path: &Path, original: &Mixture, mixture: &Mixture, to: &Path) -> Artifact {
    let updated = ArtifactVersion::new(path, original, mixture).unwrap();
    let source = Cursor::new(std::fs::read(path).unwrap());
    let written = updated.write_artifact(source, Cursor::new(Vec::new()), "c-1").unwrap();
    std::fs::write(to, written.into_inner()).unwrap();
    Artifact::load(to).unwrap()
}

/// An array as stored.
fn bytes(path: &Path, name: &str) -> Vec<u8> {
    let mut archive = NpzArchive::open(path).unwrap();
    let mut bytes = Vec::new();
    archive.zip_archive().by_name(&format!("{name}.npy")).unwrap().read_to_end(&mut bytes).unwrap();
    bytes
}

fn single(values: &[f64]) -> Vec<f64> {
    values.iter().map(|&value| f64::from(value as f32)).collect()
}

/// What was read is what was in memory, rounded to single precision.
fn check(found: &Mixture, expected: &Mixture) {
    assert_eq!(found.iter().count(), expected.iter().count());
    for ((.., found), (.., expected)) in found.iter().zip(expected.iter()) {
        assert_eq!(found.centroid(), expected.centroid());
        assert_eq!(found.inverse(), single(expected.inverse()));
        assert_eq!(found.threshold(), expected.threshold());
        let [found, expected] = [found, expected].map(|component| component.statistics().unwrap());
        assert_eq!(found.scatter, single(&expected.scatter));
        assert_eq!((found.count, found.effective_count), (expected.count, expected.effective_count));
    }
}

#[test]
fn an_updated_mixture_is_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let [path, later, model] = ["built.npz", "later.npz", "model.npz"].map(|name| folder.path().join(name));
    let built = mixture(false, true);
    std::fs::write(&path, built.write(Cursor::new(Vec::new())).unwrap().into_inner()).unwrap();
    let original = Artifact::load(&path).unwrap().mixture;

    // Without an update, every array is that of the artifact.
    write(&path, &original, &original, &later);
    let archive = npz::NpzFile::open(&path).unwrap();
    for name in archive.names() {
        assert!(bytes(&later, name) == bytes(&path, name), "{name}");
    }
    assert_eq!(npz::NpzFile::open(&later).unwrap().strings("campaign").unwrap(), ["c-1"]);

    let twice = updated(&updated(&original, 0, 1), 0, 1);
    let found = write(&path, &original, &twice, &later);
    check(&found.mixture, &twice);
    assert_eq!(found.unsound_components(), []);
    assert_eq!(numbers(&later, "mixture_version"), [2.0]);
    assert_eq!(numbers(&later, "inv_cov_2"), numbers(&path, "inv_cov_2"));
    assert_eq!(read_histograms(&later).unwrap(), read_histograms(&path).unwrap());
    // The numbers for information, about the covariance by faer's eigenvalues.
    let covariance = twice.component(0, 1).unwrap().statistics().unwrap().covariance();
    let covariance = faer::MatRef::from_row_major_slice(&covariance, 5, 5);
    let values = covariance.self_adjoint_eigenvalues(faer::Side::Lower).unwrap();
    let condition = (values[4] + 1e-6) / (values[0] + 1e-6);
    assert!((numbers(&later, "cond_number_0")[1] / condition - 1.0).abs() < 1e-6);
    assert_eq!(numbers(&later, "effective_rank_0")[1], 5.0);
    for name in ["cond_number_0", "counts_0"] {
        let (before, after) = (numbers(&path, name), numbers(&later, name));
        assert_eq!((before[0], before[2]), (after[0], after[2]));
        assert_ne!(before[1], after[1]);
    }

    // In the model, the same numbers.
    let files = ArtifactVersion::new(&path, &original, &twice).unwrap();
    let written = files.write_export(export(), Cursor::new(Vec::new())).unwrap();
    std::fs::write(&model, written.into_inner()).unwrap();
    let embedded = Artifact::load_export(&model).unwrap().mixture;
    assert_eq!(embedded.iter().count(), found.mixture.iter().count());
    for ((.., embedded), (.., found)) in embedded.iter().zip(found.mixture.iter()) {
        assert_eq!(embedded.view().inverse, found.view().inverse);
        assert_eq!(embedded.view().centroid, found.view().centroid);
        assert_eq!(embedded.threshold(), found.threshold());
    }
    assert_eq!(numbers(&model, "weights"), [1.5, -2.0]);

    // The export of an export.
    let again = write(&later, &found.mixture, &found.mixture, &path);
    assert_eq!(again, found);
}

#[test]
fn an_element_that_only_updates_know_is_added() {
    let folder = tempfile::tempdir().unwrap();
    let [path, later, model] = ["built.npz", "later.npz", "model.npz"].map(|name| folder.path().join(name));
    std::fs::write(&path, mixture(false, true).write(Cursor::new(Vec::new())).unwrap().into_inner()).unwrap();
    let original = Artifact::load(&path).unwrap().mixture;
    assert!(optional(&path, "centroids_1").is_none());
    let mixture = updated(&original, 1, 0);
    let found = write(&path, &original, &mixture, &later);
    check(&found.mixture, &mixture);
    assert_eq!(numbers(&later, "elements"), [0.0, 1.0, 2.0]);
    assert_eq!(numbers(&later, "counts_1"), [4.0, 0.0, 0.0]);
    assert_eq!(numbers(&later, "centroids_1")[5..], [1e10_f32 as f64; 10]);
    assert_eq!(numbers(&later, "eff_interp_thresholds")[3..6], [1.0; 3]);
    assert_eq!(numbers(&later, "eff_interp_thresholds"), numbers(&path, "eff_interp_thresholds"));
    assert_eq!(numbers(&later, "interp_thresholds"), numbers(&path, "interp_thresholds"));
    let histograms = read_histograms(&later).unwrap();
    assert_eq!(histograms[1].as_ref().unwrap().components.iter().map(|one| one.count()).sum::<u64>(), 0);

    let files = ArtifactVersion::new(&path, &original, &mixture).unwrap();
    let written = files.write_export(export(), Cursor::new(Vec::new())).unwrap();
    std::fs::write(&model, written.into_inner()).unwrap();
    let embedded = Artifact::load_export(&model).unwrap().mixture;
    let [embedded, found] = [&embedded, &found.mixture].map(|of| of.component(1, 0).unwrap());
    assert_eq!((embedded.inverse(), embedded.threshold()), (found.inverse(), 1.0));
}
