//! Measures of forgetting.

use calm::forgetting::{ElementForgetting, ForgettingAlarm, GradeDistribution, mean_square_growth};
use calm::{Artifact, Batch, ChangedComponent, Component, CovarianceUpdate, Grades};

use crate::common::{assert_close, indices, model, numbers, peer};

#[test]
fn the_distribution_is_made_of_order_statistics() {
    let grades: Vec<f64> = (0..=20).rev().map(|index| 0.1 * f64::from(index)).collect();
    let found = GradeDistribution::from_grades(&grades);
    assert_close("quantiles", &[found.median, found.percentile_95, found.maximum], &[1.0, 1.9, 2.0], 1e-14);
    assert_eq!((found.atoms, found.share_above_one), (21, 10.0 / 21.0));
    let none = GradeDistribution::from_grades(&[]);
    assert_eq!((none.atoms, none.median, none.share_above_one), (0, 0.0, 0.0));
}

#[test]
fn the_alarm_compares_live_with_original() {
    let share =
        |share_above_one| GradeDistribution { share_above_one, ..GradeDistribution::from_grades(&[0.5]) };
    let is_raised =
        |alarm: ForgettingAlarm, before, live| alarm.level_of_share(share(before), share(live)) > 1.0;
    let alarm = ForgettingAlarm::default();
    assert!(!is_raised(alarm, 0.04, 0.2) && is_raised(alarm, 0.04, 0.21));
    assert!(!is_raised(alarm, 0.3, 0.3) && is_raised(alarm, 0.3, 0.31));
    let alarm: ForgettingAlarm = toml::from_str("share_above_one = 0.3").unwrap();
    assert!(!is_raised(alarm, 0.04, 0.25));
    assert!(toml::from_str::<ForgettingAlarm>("share = 0.3").is_err());
}

/// An element with a sample by its share, another by its covariances.
#[test]
fn the_alarm_looks_at_each_element() {
    let element = |mean_square_growth, share_above_one| ElementForgetting {
        element: "H".to_owned(),
        mean_square_growth,
        share_above_one,
        components: Vec::new(),
    };
    let alarm = ForgettingAlarm::default();
    let level = |growth, share, before| alarm.level_of(&element(growth, share), before);
    assert!((level(9.0, Some(0.3), Some(0.05)) - 1.5).abs() < 1e-12);
    assert_eq!(level(9.0, Some(0.3), Some(0.25)), 0.0, "many were rare from the start");
    assert_eq!((level(9.0, None, None), level(2.0, None, None)), (2.25, 0.5));
}

/// The mean σ² of the training atoms after an update, from the covariances alone.
#[test]
fn the_growth_of_the_mean_square_is_that_of_the_training_atoms() {
    let Some(folder) = peer("grace") else { return };
    let file = folder.join("calm_build/features_uqtrain.npz");
    let (elements, features) = (indices(&file, "elements"), numbers(&file, "features"));
    let original = Artifact::load(folder.join("grace1l_tiny/gmm_artifacts.npz")).unwrap().mixture;
    let dimension = original.dimension();
    let mut grades = Grades::default();
    grades.evaluate(&original, &elements, &features, None).unwrap();
    // Twenty training atoms, pushed out along one direction of feature space.
    let far: Vec<f64> = features[..20 * dimension]
        .iter()
        .enumerate()
        .map(|(k, z)| if k % dimension == 0 { z + 5.0 } else { *z })
        .collect();
    let batch = Batch::new(&original, &elements[..20], &far).unwrap();
    let changed = batch.updated(CovarianceUpdate::Convex { alpha: 0.4 }).unwrap();
    assert!(!changed.is_empty());
    for ChangedComponent { element, slot, component } in changed {
        let before = original.component(element, slot).unwrap();
        let own: Vec<usize> = (0..elements.len())
            .filter(|atom| (elements[*atom], grades.component[*atom]) == (element, slot))
            .collect();
        let mean = |component: &Component| {
            let square = |atom: &usize| {
                let delta: Vec<f64> = features[atom * dimension..][..dimension]
                    .iter()
                    .zip(component.centroid())
                    .map(|(z, centre)| z - centre)
                    .collect();
                let row = |k: usize| &component.inverse()[k * dimension..][..dimension];
                let product = |k| row(k).iter().zip(&delta).map(|(s, d)| s * d).sum::<f64>();
                (0..dimension).map(|k| delta[k] * product(k)).sum::<f64>()
            };
            own.iter().map(square).sum::<f64>() / own.len() as f64
        };
        let growth = mean_square_growth(before, &component).unwrap();
        // Scatter and inverse in the file are rounded to f32.
        assert_close("growth", &[growth], &[mean(&component) / mean(before)], 2e-3);
        assert!(growth > 1.1, "{growth}");
    }
}

/// √⟨σ²⟩/θ of the training atoms of a component, from its statistics alone: ⟨σ²⟩ = tr(S C).
fn root_mean_square(component: &Component) -> f64 {
    let covariance = component.statistics().unwrap().covariance();
    let trace: f64 = component.inverse().iter().zip(&covariance).map(|(s, c)| s * c).sum();
    trace.sqrt() / component.threshold()
}

/// The stored histogram of σ comes from the training atoms; its bins are 1.2 % wide.
#[test]
fn the_root_mean_square_is_that_of_the_stored_histogram() {
    for name in ["al_eam_1l", "si_sw_1l"] {
        let path = model(&format!("{name}/gmm_artifacts.npz"));
        let mixture = Artifact::load(&path).unwrap().mixture;
        let (edges, counts) = (numbers(&path, "hist_bin_edges"), numbers(&path, "hist_0"));
        let squares = edges.windows(2).zip(&counts).map(|(edge, count)| edge[0] * edge[1] * count);
        let mean = squares.sum::<f64>() / counts.iter().sum::<f64>();
        let component = mixture.component(0, 0).unwrap();
        assert_close(name, &[root_mean_square(component)], &[mean.sqrt() / component.threshold()], 2e-3);
    }
}

#[test]
fn training_features_agree_with_the_statistics() {
    let Some(folder) = peer("grace") else { return };
    let file = folder.join("calm_build/features_uqtrain.npz");
    let (elements, features) = (indices(&file, "elements"), numbers(&file, "features"));
    let mixture = Artifact::load(folder.join("grace1l_tiny/gmm_artifacts.npz")).unwrap().mixture;
    let mut grades = Grades::default();
    grades.evaluate(&mixture, &elements, &features, None).unwrap();
    let has_data = |component: &Component| component.statistics().unwrap().effective_count > 0.0;
    for (element, slot, component) in mixture.iter().filter(|(_, _, component)| has_data(component)) {
        let chosen = elements.iter().zip(&grades.component).zip(&grades.gamma);
        let squares: Vec<f64> = chosen
            .filter(|((atom_element, atom_slot), _)| (**atom_element, **atom_slot) == (element, slot))
            .map(|(_, grade)| grade * grade)
            .collect();
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        // Scatter and inverse in the file are rounded to f32.
        assert_close("root mean square", &[root_mean_square(component)], &[mean.sqrt()], 1e-3);
    }
    let distribution = GradeDistribution::from_grades(&grades.gamma);
    // Components with few data have thresholds from others, so this small model leaves more atoms outside than
    // the paper's.
    assert!((0.02..0.1).contains(&distribution.share_above_one), "{distribution:?}");
}
