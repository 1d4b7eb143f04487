//! Shared helpers.
use std::path::{Path, PathBuf};

use calm::Artifact;
use npyz::npz::NpzArchive;

pub fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

/// A file of the models in `configs/`.
pub fn model(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/data").join(name)
}

/// A file of the large reference data; prints a note and returns `None` if it is unavailable.
pub fn peer(name: &str) -> Option<PathBuf> {
    let Some(root) = std::env::var_os("CALMWALK_PEER_DATA") else {
        eprintln!("CALMWALK_PEER_DATA is not set: {name} is not tested");
        return None;
    };
    Some(Path::new(&root).join(name))
}

/// The numbers of an array of any type.
pub fn numbers(path: &Path, key: &str) -> Vec<f64> {
    optional(path, key).unwrap_or_else(|| panic!("{} has no {key}", path.display()))
}

pub fn optional(path: &Path, key: &str) -> Option<Vec<f64>> {
    let mut file = NpzArchive::open(path).unwrap();
    let kind = file.by_name(key).unwrap()?.dtype().descr();
    let array = file.by_name(key).unwrap()?;
    Some(match kind.trim_matches(['\'', '<', '|']) {
        "f8" => array.into_vec::<f64>().unwrap(),
        "f4" => array.into_vec::<f32>().unwrap().into_iter().map(f64::from).collect(),
        "i8" => array.into_vec::<i64>().unwrap().into_iter().map(|value| value as f64).collect(),
        "u8" => array.into_vec::<u64>().unwrap().into_iter().map(|value| value as f64).collect(),
        "i4" => array.into_vec::<i32>().unwrap().into_iter().map(f64::from).collect(),
        other => panic!("{key} has type {other}"),
    })
}

pub fn indices(path: &Path, key: &str) -> Vec<usize> {
    numbers(path, key).into_iter().map(|value| value as usize).collect()
}

/// Largest relative deviation of two lists of equal length.
pub fn deviation(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let relative = |(a, b): (&f64, &f64)| (a - b).abs() / b.abs().max(f64::MIN_POSITIVE);
    found.iter().zip(expected).map(relative).fold(0.0, |worst: f64, value| {
        assert!(!value.is_nan());
        worst.max(value)
    })
}

#[track_caller]
pub fn assert_close(what: &str, found: &[f64], expected: &[f64], tolerance: f64) {
    let deviation = deviation(found, expected);
    println!("{what}: largest relative deviation {deviation:.1e} (allowed {tolerance:.0e})");
    assert!(deviation <= tolerance, "{what}: relative deviation {deviation:e} above {tolerance:e}");
}

pub fn niobium() -> Artifact {
    Artifact::load(data("niobium_artifact.npz")).unwrap()
}

/// A reproducible generator of numbers in (−1, 1).
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    pub fn take(&mut self, count: usize) -> Vec<f64> {
        (0..count).map(|_| self.next()).collect()
    }
}
