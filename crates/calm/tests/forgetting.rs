//! Measures of forgetting.

use std::sync::Arc;

use calm::forgetting::{
    ForgettingAlarm, ForgettingError, GradeDistribution, forgetting_factors, grade_distribution,
};
use calm::{Artifact, Batch, Component, CovarianceUpdate, Grades, Mixture, Statistics};

use crate::common::{Random, assert_close, indices, model, niobium, numbers, peer};

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
    let alarm = ForgettingAlarm::default();
    assert!(!alarm.is_raised(&share(0.04), &share(0.2)) && alarm.is_raised(&share(0.04), &share(0.21)));
    assert!(!alarm.is_raised(&share(0.3), &share(0.3)) && alarm.is_raised(&share(0.3), &share(0.31)));
    let alarm: ForgettingAlarm = toml::from_str("share_above_one = 0.3").unwrap();
    assert!(!alarm.is_raised(&share(0.04), &share(0.25)));
    assert!(toml::from_str::<ForgettingAlarm>("share = 0.3").is_err());
}

/// Training atoms with a known second moment, and a batch far away along one direction.
fn trained() -> (Mixture, Vec<f64>) {
    let mut random = Random(3);
    let features: Vec<f64> =
        (0..500).flat_map(|_| [2.0, 1.0, 0.5].map(|width| width * random.next())).collect();
    let mut scatter = vec![0.0; 9];
    for z in features.chunks_exact(3) {
        (0..9).for_each(|index| scatter[index] += z[index / 3] * z[index % 3]);
    }
    let covariance: Vec<f64> = scatter.iter().map(|value| value / 500.0).collect();
    let inverse = calm::regularised_inverse(&covariance, 3).unwrap();
    let statistics = Statistics { scatter, count: 500.0, effective_count: 500.0 };
    let component = Component::new(vec![0.0; 3], inverse, 2.5, Some(statistics)).unwrap();
    (Mixture::new(0, vec![vec![Arc::new(component)]]).unwrap(), features)
}

#[test]
fn the_forgetting_factor_is_that_of_the_features() {
    let (original, features) = trained();
    let batch = Batch::new(&original, &[0; 2], &[9.0, 0.0, 0.0, 8.0, 0.1, 0.0]).unwrap();
    let mean_square = |mixture: &Mixture| {
        let mut grades = Grades::default();
        grades.evaluate(mixture, &[0; 500], &features, None).unwrap();
        grades.gamma.iter().map(|grade| grade * grade).sum::<f64>() / 500.0
    };
    for alpha in [0.1, 0.7, 1.0] {
        let live =
            original.with_changes(&batch.updated(CovarianceUpdate::Convex { alpha }).unwrap()).unwrap();
        let factor = forgetting_factors(&original, &live).unwrap()[0];
        assert_close("original", &[factor.original], &[mean_square(&original).sqrt()], 1e-6);
        assert_close("live", &[factor.live], &[mean_square(&live).sqrt()], 1e-6);
        assert_eq!(factor.factor, factor.live / factor.original);
        // The third direction is not visited and is forgotten. A small α widens the others by more, so the
        // average does not show it.
        assert_eq!(factor.factor > 1.0, alpha > 0.6);
        assert!(factor.worst_direction > 1.0 && factor.worst_direction < 1.001 / (1.0 - alpha).sqrt());

        let additive = batch.updated(CovarianceUpdate::Additive { alpha }).unwrap();
        let live = original.with_changes(&additive).unwrap();
        let factor = forgetting_factors(&original, &live).unwrap()[0];
        assert!(factor.factor < 1.0 && factor.worst_direction < 1.0 + 1e-9);
    }
    assert_eq!(forgetting_factors(&original, &original).unwrap()[0].factor, 1.0);
}

#[test]
fn the_worst_direction_is_found() {
    let mut scatter = vec![0.0; 9];
    [40.0, 10.0, 2.5].iter().enumerate().for_each(|(index, value)| scatter[4 * index] = *value);
    let mut inverse = vec![0.0; 9];
    [4.0, 1.0, 0.25].iter().enumerate().for_each(|(index, value)| inverse[4 * index] = 1.0 / (value + 1e-6));
    let statistics = Statistics { scatter, count: 10.0, effective_count: 10.0 };
    let component = Component::new(vec![0.0; 3], inverse, 1.0, Some(statistics)).unwrap();
    let original = Mixture::new(0, vec![vec![Arc::new(component)]]).unwrap();
    let batch = Batch::new(&original, &[0], &[2.0, 0.0, 0.0]).unwrap();
    for alpha in [0.1, 0.9, 1.0] {
        let live =
            original.with_changes(&batch.updated(CovarianceUpdate::Convex { alpha }).unwrap()).unwrap();
        let found = forgetting_factors(&original, &live).unwrap()[0].worst_direction;
        let expected = ((1.0 + 1e-6) / (1.0 - alpha + 1e-6_f64)).sqrt();
        assert_close("worst direction", &[found], &[expected], 1e-9);
    }
}

/// The stored histogram of σ comes from the training atoms; its bins are 1.2 % wide.
#[test]
fn the_root_mean_square_is_that_of_the_stored_histogram() {
    for name in ["al_eam_1l", "si_sw_1l"] {
        let path = model(&format!("{name}/gmm_artifacts.npz"));
        let mixture = Artifact::load(&path).unwrap().mixture;
        let factor = forgetting_factors(&mixture, &mixture).unwrap()[0];
        let (edges, counts) = (numbers(&path, "hist_bin_edges"), numbers(&path, "hist_0"));
        let squares = edges.windows(2).zip(&counts).map(|(edge, count)| edge[0] * edge[1] * count);
        let mean = squares.sum::<f64>() / counts.iter().sum::<f64>();
        let theta = mixture.component(0, 0).unwrap().threshold();
        assert_close(name, &[factor.original], &[mean.sqrt() / theta], 2e-3);
    }
    // Elements without data cannot be forgotten.
    let niobium = niobium().mixture;
    assert_eq!(forgetting_factors(&niobium, &niobium).unwrap().len(), 2);
}

#[test]
fn training_features_agree_with_the_statistics() {
    let Some(folder) = peer("grace") else { return };
    let file = folder.join("calm_build/features_uqtrain.npz");
    let (elements, features) = (indices(&file, "elements"), numbers(&file, "features"));
    let mixture = Artifact::load(folder.join("grace1l_tiny/gmm_artifacts.npz")).unwrap().mixture;
    let mut grades = Grades::default();
    grades.evaluate(&mixture, &elements, &features, None).unwrap();
    for factor in forgetting_factors(&mixture, &mixture).unwrap() {
        let chosen = elements.iter().zip(&grades.component).zip(&grades.gamma);
        let squares: Vec<f64> = chosen
            .filter(|((element, slot), _)| (**element, **slot) == (factor.element, factor.slot))
            .map(|(_, grade)| grade * grade)
            .collect();
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        // Scatter and inverse in the file are rounded to f32.
        assert_close("root mean square", &[factor.original], &[mean.sqrt()], 1e-3);
    }
    let distribution = grade_distribution(&mixture, &elements, &features).unwrap();
    // Components with few data have thresholds from others, so this small model leaves more atoms outside than
    // the paper's.
    assert!((0.02..0.1).contains(&distribution.share_above_one), "{distribution:?}");
}

#[test]
fn mixtures_that_cannot_be_compared() {
    let (original, _) = trained();
    let export = Artifact::load_export(model("al_eam_1l/kokkos.npz")).unwrap().mixture;
    let error = forgetting_factors(&export, &export).unwrap_err();
    assert_eq!(error, ForgettingError::NoStatistics { element: 0, slot: 0 });
    let error = forgetting_factors(&original, &export).unwrap_err();
    assert_eq!(error, ForgettingError::NotTheSame { element: 0, slot: 0 });
}
