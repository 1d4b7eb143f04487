//! Mixtures that training data cannot produce are detected; real ones are not.

use std::sync::Arc;

use calm::{Artifact, Component, Mixture, Statistics};

use crate::common::{model, niobium, peer};

/// Numbers of a component, to be corrupted.
#[derive(Clone)]
struct Parts {
    centroid: Vec<f64>,
    inverse: Vec<f64>,
    threshold: f64,
    statistics: Option<Statistics>,
}

fn parts(component: &Component) -> Parts {
    Parts {
        centroid: component.centroid().to_vec(),
        inverse: component.inverse().to_vec(),
        threshold: component.threshold(),
        statistics: component.statistics().cloned(),
    }
}

/// The artifact with each component changed.
fn changed(artifact: &Artifact, change: impl Fn(&mut Parts)) -> Artifact {
    let spoilt = |component: &Arc<Component>| {
        let mut parts = parts(component);
        change(&mut parts);
        let Parts { centroid, inverse, threshold, statistics } = parts;
        Arc::new(Component::new(centroid, inverse, threshold, statistics).unwrap())
    };
    let elements = (0..artifact.mixture.element_count())
        .map(|element| artifact.mixture.components(element).unwrap().iter().map(spoilt).collect());
    Artifact { mixture: Mixture::new(0, elements.collect()).unwrap(), ..artifact.clone() }
}

fn scaled(values: &mut [f64], factor: f64) {
    values.iter_mut().for_each(|value| *value *= factor);
}

fn faults(artifact: &Artifact) -> Vec<String> {
    artifact.unsound_components().iter().map(ToString::to_string).collect()
}

#[test]
fn an_element_without_data_is_distinguished() {
    for path in ["al_eam_1l/gmm_artifacts.npz", "al_eam_1l/kokkos.npz"] {
        let known = if path.ends_with("kokkos.npz") {
            Artifact::load_export(model(path))
        } else {
            Artifact::load(model(path))
        };
        let known = known.unwrap().mixture;
        let unknown = Arc::new(Component::unknown_element(known.dimension()));
        let elements = vec![known.components(0).unwrap().to_vec(), vec![unknown]];
        let mixture = Mixture::new(0, elements).unwrap();
        assert_eq!([0, 1, 2].map(|element| mixture.has_data_of(element)), [true, false, false], "{path}");
    }
}

#[test]
fn artifacts_of_real_builds_are_sound() {
    assert_eq!(faults(&niobium()), [""; 0]);
    for name in ["al_eam_1l", "si_sw_1l", "ni_al_h_eam_1l"] {
        assert_eq!(faults(&Artifact::load(model(&format!("{name}/gmm_artifacts.npz"))).unwrap()), [""; 0]);
        assert_eq!(faults(&Artifact::load_export(model(&format!("{name}/kokkos.npz"))).unwrap()), [""; 0]);
    }
    for name in [
        "grace/grace1l_tiny",
        "grace/grace1l_tiny_bondcut",
        "grace/grace1l_paper",
        "grace/grace2l_tiny",
        "grace/grace2l_small",
        "grace/grace3l_tiny",
        "models/al_eam_1l",
        "models/si_sw_1l",
    ] {
        let Some(folder) = peer(name) else { return };
        let export = Artifact::load_export(folder.join("kokkos.npz")).unwrap();
        assert_eq!(faults(&export), [""; 0], "{name}");
        let file = folder.join("gmm_artifacts.npz");
        if file.exists() {
            assert_eq!(faults(&Artifact::load(file).unwrap()), [""; 0], "{name}");
        }
    }
}

#[test]
fn what_an_update_makes_is_sound() {
    let artifact = Artifact::load(model("al_eam_1l/gmm_artifacts.npz")).unwrap();
    let component = artifact.mixture.component(0, 0).unwrap();
    let features: Vec<f64> = component.centroid().iter().map(|value| value + 0.01).collect();
    let batch = calm::Batch::new(&artifact.mixture, &[0], &features).unwrap();
    for update in [
        calm::CovarianceUpdate::Convex { alpha: 1.0 },
        calm::CovarianceUpdate::Convex { alpha: 0.1 },
        calm::CovarianceUpdate::Accumulate,
    ] {
        let changes = batch.updated(update).unwrap();
        let mixture = artifact.mixture.with_changes(&changes).unwrap();
        assert_eq!(faults(&Artifact { mixture, ..artifact.clone() }), [""; 0], "{update:?}");
    }
}

#[test]
fn nonsense_is_reported() {
    let artifact = Artifact::load(model("al_eam_1l/gmm_artifacts.npz")).unwrap();
    let silicon = Artifact::load(model("si_sw_1l/gmm_artifacts.npz")).unwrap();
    let silicon = parts(silicon.mixture.component(0, 0).unwrap()).statistics.unwrap();
    let told = |words: &str, change: &dyn Fn(&mut Parts)| {
        let found = faults(&changed(&artifact, change));
        assert!(found.len() == 1 && found[0].starts_with("component 0 of Al: "), "{words}: {found:?}");
        assert!(found[0].contains(words), "{words}: {found:?}");
    };
    let statistics = |parts: &mut Parts, change: &dyn Fn(&mut Statistics)| {
        parts.statistics.iter_mut().for_each(change);
    };
    told("eigenvalues from 0.000e0 to 0.000e0", &|p| p.inverse.fill(0.0));
    told("its inverse covariance has eigenvalues from -", &|p| scaled(&mut p.inverse, -1.0));
    told("expected at most 1e6", &|p| scaled(&mut p.inverse, 1e6));
    told("does not match its scatter and count", &|p| scaled(&mut p.inverse, 1e-6));
    told("does not match its scatter and count", &|p| scaled(&mut p.inverse, 0.8));
    told("mean eigenvalue", &|p| statistics(p, &|s| s.scatter.fill(0.0)));
    told("its scatter has a negative eigenvalue", &|p| statistics(p, &|s| scaled(&mut s.scatter, -1.0)));
    told("does not match", &|p| statistics(p, &|s| s.scatter.clone_from(&silicon.scatter)));
    told("does not match", &|p| statistics(p, &|s| s.effective_count = 1.0));
    told("5400 environments with a total weight of 0", &|p| statistics(p, &|s| s.effective_count = 0.0));
    told("0 environments with a total weight of 5400", &|p| statistics(p, &|s| s.count = 0.0));
    told("its threshold is 0.000e0; expected 1.0e-2 to", &|p| p.threshold = 0.0);
    told("its threshold is 1.412e7", &|p| p.threshold *= 1e6);
    told("its threshold is 1.412e-5", &|p| p.threshold *= 1e-6);
    told("its centroid is zero", &|p| p.centroid.fill(0.0));
    told("where the model's features are between", &|p| scaled(&mut p.centroid, 1e3));
}

#[test]
fn an_export_is_checked_without_statistics() {
    let export = Artifact::load_export(model("si_sw_1l/kokkos.npz")).unwrap();
    for (words, change) in [
        ("positive definite", &(|p: &mut Parts| p.inverse.fill(0.0)) as &dyn Fn(&mut Parts)),
        ("expected at most 1e6", &|p| scaled(&mut p.inverse, 1e6)),
        ("threshold", &|p| p.threshold = 0.0),
        ("threshold", &|p| p.threshold = 1e4),
        ("its centroid is zero", &|p| p.centroid.fill(0.0)),
    ] {
        let found = faults(&changed(&export, change));
        assert!(found.len() == 1 && found[0].contains(words), "{words}: {found:?}");
    }
}

/// A covariance of low rank is regularised, and so are all its directions without data.
#[test]
fn a_covariance_of_low_rank_is_sound() {
    let mut artifact = Artifact::load(model("al_eam_1l/gmm_artifacts.npz")).unwrap();
    let first = Arc::clone(artifact.mixture.component(0, 0).unwrap());
    let dimension = first.dimension();
    for size in [0.0, 1e-3, 1.0, 100.0] {
        let direction: Vec<f64> = (0..dimension).map(|k| size * (k as f64).sin()).collect();
        let covariance: Vec<f64> =
            direction.iter().flat_map(|a| direction.iter().map(move |b| a * b)).collect();
        let single = |value: &f64| f64::from(*value as f32);
        let inverse = calm::regularised_inverse(&covariance, dimension).unwrap();
        let scatter = covariance.iter().map(|value| single(&(200.0 * value))).collect();
        let statistics = Statistics { scatter, count: 200.0, effective_count: 200.0 };
        let component = Component::new(
            first.centroid().to_vec(),
            inverse.iter().map(single).collect(),
            1.0,
            Some(statistics),
        );
        let elements = vec![vec![Arc::new(component.unwrap())]];
        artifact.mixture = Mixture::new(0, elements).unwrap();
        assert_eq!(faults(&artifact), [""; 0], "{size}");
    }
}

#[test]
fn a_duplicate_centroid_is_reported() {
    let mut artifact = niobium();
    let components = artifact.mixture.components(1).unwrap();
    let mut twice = parts(&components[1]);
    twice.centroid = components[0].centroid().to_vec();
    let Parts { centroid, inverse, threshold, statistics } = twice;
    let component = Arc::new(Component::new(centroid, inverse, threshold, statistics).unwrap());
    let changed = [calm::ChangedComponent { element: 1, slot: 1, component }];
    artifact.mixture = artifact.mixture.with_changes(&changed).unwrap();
    assert_eq!(
        faults(&artifact),
        ["component 1 of Nb: it shares the centroid of component 0; expected a distinct one"]
    );
}
