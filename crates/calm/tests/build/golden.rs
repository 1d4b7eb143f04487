//! The reference's build, reproduced from its features and the centroids of its first pass.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use calm::Artifact;
use calm::build::{BuildSettings, BuiltElement, BuiltMixture, ThresholdRule, read_histograms};
use npyz::npz::NpzArchive;

use super::{calibrate, scatter};
use crate::common::{assert_close, indices, numbers, optional, peer};

const DIMENSION: usize = 130;

struct Reference {
    steps: PathBuf,
    artifact: PathBuf,
    elements: Vec<usize>,
    features: Vec<f64>,
}

impl Reference {
    fn open() -> Option<Self> {
        let data = peer("grace/calm_build/features_uqtrain.npz")?;
        let (elements, features) = (indices(&data, "elements"), numbers(&data, "features"));
        let (steps, artifact) =
            (peer("grace/calm_build/steps_fp64.npz")?, peer("grace/grace1l_tiny/gmm_artifacts.npz")?);
        Some(Self { steps, artifact, elements, features })
    }

    /// The features of the atoms of an element.
    fn features_of(&self, element: usize) -> Vec<f64> {
        let rows = self.features.chunks_exact(DIMENSION).zip(&self.elements);
        rows.filter(|(_, own)| **own == element).flat_map(|(row, _)| row.to_vec()).collect()
    }

    /// Pass 2 over an element in one shard, pass 3 in several.
    fn build(&self, element: usize) -> BuiltElement {
        let slots = numbers(&self.steps, &format!("step1_centroids_{element}"));
        let real: Vec<f64> = slots.into_iter().filter(|value| *value < 1e9).collect();
        let features = self.features_of(element);
        let weights = |features: &[f64]| vec![1.0; features.len() / DIMENSION];
        let mut sums = scatter(DIMENSION, &real, &features, &weights(&features), &[77]);
        // The reference's sums pass through single precision.
        for component in &mut sums.components {
            component.scatter.iter_mut().for_each(|value| *value = f64::from(*value as f32));
        }
        let components = calm::build::components(&real, &sums).unwrap();
        let shards = features.chunks(900 * DIMENSION);
        let passes = shards.map(|shard| calibrate(&components, shard, &weights(shard), &[500, 1]));
        let histograms = passes.reduce(|mut all, next| {
            all.merge(&next).unwrap();
            all
        });
        BuiltElement { histograms: histograms.unwrap(), components }
    }
}

/// Largest deviation, relative to the largest number.
fn near(what: &str, found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let largest = expected.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
    let worst = found.iter().zip(expected).fold(0.0_f64, |worst, (a, b)| worst.max((a - b).abs()));
    println!(
        "{what}: largest deviation {:.1e} of the largest number (allowed {tolerance:.0e})",
        worst / largest
    );
    assert!(worst <= tolerance * largest, "{what}: {worst:e} of {largest:e}");
}

#[test]
fn passes_two_and_three_reproduce_the_reference() {
    let Some(reference) = Reference::open() else { return };
    for element in 0..4 {
        let BuiltElement { components, histograms } = reference.build(element);
        let key = |name: &str| format!("{name}_{element}");
        let count = components.len();
        let used = |numbers: Vec<f64>| numbers[..count].to_vec();
        let counts: Vec<f64> = components.iter().map(|c| c.count).collect();
        let stored = numbers(&reference.artifact, &key("counts"));
        assert_eq!(counts, stored[..count]);
        assert!(stored[count..].iter().all(|count| *count == 0.0));
        let effective: Vec<f64> = components.iter().map(|c| c.effective_count).collect();
        assert_eq!(effective, used(numbers(&reference.artifact, &key("effective_count"))));
        let centroids: Vec<f64> = components.iter().flat_map(|c| c.centroid.clone()).collect();
        assert_eq!(centroids, numbers(&reference.steps, &key("step2_centroids"))[..centroids.len()]);
        let ranks: Vec<f64> = components.iter().map(|c| c.effective_rank as f64).collect();
        assert_eq!(ranks, used(numbers(&reference.artifact, &key("effective_rank"))));
        assert!(components.iter().all(|component| component.truncated == 0));
        let conditions: Vec<f64> = components.iter().map(|c| c.condition_number).collect();
        let expected = used(numbers(&reference.artifact, &key("cond_number")));
        assert_close("condition numbers", &conditions, &expected, 1e-7);

        let square = DIMENSION * DIMENSION;
        for (name, tolerance) in [("scatter", 1e-7), ("inv_cov", 1e-7)] {
            let file = optional(&reference.steps, &key(&format!("step2_{name}")));
            let expected = file.unwrap_or_else(|| numbers(&reference.artifact, &key(name)));
            for (component, expected) in components.iter().zip(expected.chunks_exact(square)) {
                let found = if name == "scatter" { &component.scatter } else { &component.inverse };
                near(&key(name), found, expected, tolerance);
            }
        }
        let raw: Vec<f64> = histograms.components.iter().flat_map(|h| &h.raw).map(|&n| n as f64).collect();
        let expected = numbers(&reference.artifact, &key("hist"));
        let differences: f64 = raw.iter().zip(&expected).map(|(a, b)| (a - b).abs()).sum();
        println!("histograms of element {element}: {} atoms in another bin", differences / 2.0);
        assert_eq!(raw, expected[..raw.len()]);
    }
}

/// Type and shape of each array.
fn kinds(path: &Path) -> BTreeMap<String, (String, Vec<u64>)> {
    let mut file = NpzArchive::open(path).unwrap();
    let names: Vec<String> = file.array_names().map(str::to_owned).collect();
    let kind = |name: String| {
        let array = file.by_name(&name).unwrap().unwrap();
        let kind = (array.dtype().descr(), array.shape().to_vec());
        (name, kind)
    };
    names.into_iter().map(kind).collect()
}

#[test]
fn the_artifact_is_that_of_the_reference() {
    let Some(reference) = Reference::open() else { return };
    let expected = Artifact::load(&reference.artifact).unwrap();
    let settings =
        BuildSettings { dimension: DIMENSION, seed: 42, candidates: vec![1, 2, 4], shard_size: 900 };
    let elements = (0..4).map(|element| Some(reference.build(element))).collect();
    let symbols = expected.symbols.clone();
    let built =
        BuiltMixture::new(symbols, expected.projection.clone(), Some(42), settings, elements).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("gmm_artifacts.npz");
    std::fs::write(&path, built.write(Cursor::new(Vec::new())).unwrap().into_inner()).unwrap();
    let found = Artifact::load(&path).unwrap();
    assert_eq!(found, built.artifact().unwrap());
    for (key, kind) in kinds(&reference.artifact) {
        assert_eq!(kinds(&path).get(&key), Some(&kind), "{key}");
    }
    found.check_belongs_to(&expected.symbols, &expected.projection).unwrap();
    assert_eq!(found.unsound_components(), []);
    assert_eq!(found.mixture.iter().count(), expected.mixture.iter().count());
    for ((.., found), (element, slot, expected)) in found.mixture.iter().zip(expected.mixture.iter()) {
        assert_eq!(found.centroid(), expected.centroid());
        assert_eq!(found.threshold(), expected.threshold());
        let what = format!("component {slot} of element {element}");
        near(&format!("inverse of {what}"), found.inverse(), expected.inverse(), 1e-7);
        let (a, b) = (found.statistics().unwrap(), expected.statistics().unwrap());
        near(&format!("scatter of {what}"), &a.scatter, &b.scatter, 2e-7);
        assert_eq!((a.count, a.effective_count), (b.count, b.effective_count));
    }
}

#[test]
fn stored_histograms_give_the_stored_thresholds() {
    let Some(reference) = Reference::open() else { return };
    let elements = read_histograms(&reference.artifact).unwrap();
    let found = elements.iter().flatten().map(|element| element.thresholds(ThresholdRule::Robust, DIMENSION));
    let (raw, weighted): (Vec<_>, Vec<_>) = found.map(|found| (found.raw, found.weighted)).unzip();
    let single =
        |values: Vec<Vec<f64>>| values.concat().into_iter().map(|v| f64::from(v as f32)).collect::<Vec<_>>();
    assert_eq!(single(raw), numbers(&reference.artifact, "interp_thresholds"));
    assert_eq!(single(weighted), numbers(&reference.artifact, "eff_interp_thresholds"));
}
