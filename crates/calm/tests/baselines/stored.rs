//! Files of baselines: a round trip preserves them, and hostile files are errors.

use std::io::Cursor;
use std::sync::Arc;

use calm::baselines::{Baseline, BaselineFile, BaselineKind, BaselineSettings, FeatureOrigin};
use calm::{Component, Mixture};
use npz::{NpzFile, Writer};
use proptest::prelude::*;

use super::{built, frames, joined, mixture};

fn stored() -> BaselineFile {
    let (dimension, elements) = (4, 2);
    let (frames, mixture) = (frames(3, dimension, elements, 40), mixture(3, dimension, elements));
    let settings = BaselineSettings { sample: 30, ..BaselineSettings::default() };
    let build = |kind| built(kind, &settings, &frames, dimension, &mixture);
    let origin = FeatureOrigin {
        model: "0123456789abcdef".into(),
        variant: "normalised".into(),
        symbols: vec!["Mo".into(), "W".into()],
        dimension,
    };
    BaselineFile { origin, baselines: BaselineKind::ALL.map(build).to_vec(), settings }
}

fn bytes(file: &BaselineFile) -> Vec<u8> {
    file.write(Cursor::new(Vec::new())).unwrap().into_inner()
}

fn read(bytes: &[u8]) -> Result<BaselineFile, String> {
    let archive = NpzFile::from_bytes("b.npz", bytes).map_err(|error| error.to_string())?;
    BaselineFile::read(&archive).map_err(|error| error.to_string())
}

#[test]
fn what_was_written_scores_the_same() {
    let file = stored();
    let found = read(&bytes(&file)).unwrap();
    assert_eq!(bytes(&found), bytes(&file));
    assert_eq!((&found.origin, &found.settings), (&file.origin, &file.settings));
    let (elements, features) = joined(&frames(4, 4, 2, 10));
    for (found, baseline) in found.baselines.iter().zip(&file.baselines) {
        assert_eq!(found.kind(), baseline.kind());
        assert_eq!(
            found.score(&elements, &features),
            baseline.score(&elements, &features),
            "{}",
            found.kind()
        );
        assert_eq!(found.score_forces(&features[..12]), baseline.score_forces(&features[..12]));
    }
}

#[test]
fn an_element_without_atoms_is_infinitely_far_away_but_for_llpr() {
    let (dimension, frames) = (4, frames(3, 4, 1, 40));
    let known = mixture(3, dimension, 1).components(0).unwrap().to_vec();
    let unknown = vec![Arc::new(Component::unknown_element(dimension))];
    let mixture = Mixture::new(0, vec![known, unknown]).unwrap();
    let settings = BaselineSettings::default();
    let build = |kind| built(kind, &settings, &frames, dimension, &mixture);
    let file = BaselineFile { baselines: BaselineKind::ALL.map(build).to_vec(), ..stored() };
    let found = read(&bytes(&file)).unwrap();
    for baseline in file.baselines.iter().chain(&found.baselines) {
        let (kind, scores) = (baseline.kind(), baseline.score(&[0, 1], &[0.9; 8]).unwrap());
        let is_llpr = matches!(baseline, Baseline::Llpr(_));
        assert!(scores[0].is_finite() && scores[1].is_finite() == is_llpr, "{kind} {scores:?}");
        assert!(is_llpr || scores[1] == f64::INFINITY, "{kind} {scores:?}");
    }
}

#[test]
fn another_model_is_refused() {
    let own = stored().origin;
    assert_eq!(own.check_same(&own), Ok(()));
    let other = FeatureOrigin { model: "fedc".into(), ..own.clone() };
    let message = own.check_same(&other).unwrap_err().to_string();
    assert_eq!(
        message,
        "the baselines belong to another model: their hash of weights and projection is 0123456789abcdef, the model's is fedc"
    );
    let linear = FeatureOrigin { variant: "linear".into(), ..own.clone() };
    assert!(own.check_same(&linear).unwrap_err().to_string().contains("feature variant is normalised"));
    let tungsten = FeatureOrigin { symbols: vec!["W".into()], ..own.clone() };
    assert!(own.check_same(&tungsten).unwrap_err().to_string().contains("list of elements is Mo W"));
}

type Write = dyn Fn(&mut Writer<Cursor<Vec<u8>>>);

/// The file with one array replaced, or left out.
fn with(key: &str, write: Option<&Write>) -> Result<BaselineFile, String> {
    let mut out = Writer::new(Cursor::new(Vec::new()));
    out.copy(Cursor::new(bytes(&stored())), |name| name == key).unwrap();
    if let Some(write) = write {
        write(&mut out);
    }
    read(&out.finish().unwrap().into_inner())
}

#[test]
fn every_array_is_needed() {
    let all = bytes(&stored());
    let names: Vec<String> = NpzFile::from_bytes("b", &all).unwrap().names().map(str::to_owned).collect();
    assert!(names.len() > 40);
    for name in names {
        let message = with(&name, None).unwrap_err();
        let expected = match name.as_str() {
            "baseline_schema" => {
                "b.npz: array 'baseline_schema': found no such array, expected a file that `calmwalk calm baseline` wrote"
            }
            _ => &format!("b.npz: no array '{name}'"),
        };
        assert_eq!(message, expected);
    }
}

#[test]
fn arrays_that_contradict_each_other_are_errors() {
    let numbers = |key: &'static str, shape: &'static [usize], of: fn(usize) -> f64| {
        let count = shape.iter().product::<usize>();
        with(key, Some(&move |out| out.array(key, shape, (0..count).map(of)).unwrap())).unwrap_err()
    };
    let counts = |key: &'static str, counts: &'static [i64]| {
        with(key, Some(&move |out| out.array(key, &[counts.len()], counts.iter().copied()).unwrap()))
            .unwrap_err()
    };
    assert!(numbers("3_gram", &[4, 4], |_| f64::NAN).contains("'3_gram'"));
    assert!(numbers("3_gram", &[4, 4], |k| k as f64).contains("expected a symmetric matrix"));
    assert!(numbers("3_gram", &[4, 4], |_| 0.0).contains("positive trace"));
    assert!(numbers("3_gram", &[4, 5], |_| 0.0).contains("shape [4, 5]"));
    assert!(numbers("3_regularisation", &[], |_| -1.0).contains("above 0"));
    assert!(numbers("1_centroids", &[4, 4], |_| 1e200).contains("numbers up to"));
    assert!(counts("0_ranks", &[4, 4, 4]).contains("expected a list of 2"));
    assert!(counts("0_ranks", &[4, 5]).contains("expected indices from 0 to 4"));
    assert!(counts("0_centroid_counts", &[0, 4]).contains("expected no centroids"));
    assert!(counts("1_centroid_counts", &[1, 4]).contains("'1_centroids'"));
    assert!(counts("7_counts", &[i64::MAX, i64::MAX]).contains("7_"));
    assert!(counts("8_counts", &[2, -1]).contains("8_counts"));
    let kinds = with("kinds", Some(&|out| out.strings("kinds", &[1], &["euclid"]).unwrap())).unwrap_err();
    assert!(kinds.contains("found 'euclid', expected one of d-optimality-element"), "{kinds}");
    let schema = with("baseline_schema", Some(&|out| out.scalar("baseline_schema", 2_i64).unwrap()));
    assert!(schema.unwrap_err().contains("found 2, expected 1"));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn damaged_files_do_not_panic(place in any::<prop::sample::Index>(), value in any::<u8>(), cut in any::<bool>()) {
        static FILE: std::sync::LazyLock<Vec<u8>> = std::sync::LazyLock::new(|| bytes(&stored()));
        let mut bytes = FILE.clone();
        let place = place.index(bytes.len());
        if cut { bytes.truncate(place) } else { bytes[place] = value }
        if let Ok(file) = read(&bytes) {
            for baseline in file.baselines {
                let _ = baseline.score(&[0, 1], &vec![0.1; 2 * file.origin.dimension]);
            }
        }
    }
}
