//! Measures of forgetting.

use calm::forgetting::{ForgettingAlarm, GradeDistribution, grade_distribution};
use calm::{Artifact, Component, Grades};

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
    let alarm = ForgettingAlarm::default();
    assert!(!alarm.is_raised(&share(0.04), &share(0.2)) && alarm.is_raised(&share(0.04), &share(0.21)));
    assert!(!alarm.is_raised(&share(0.3), &share(0.3)) && alarm.is_raised(&share(0.3), &share(0.31)));
    let alarm: ForgettingAlarm = toml::from_str("share_above_one = 0.3").unwrap();
    assert!(!alarm.is_raised(&share(0.04), &share(0.25)));
    assert!(toml::from_str::<ForgettingAlarm>("share = 0.3").is_err());
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
    let distribution = grade_distribution(&mixture, &elements, &features).unwrap();
    // Components with few data have thresholds from others, so this small model leaves more atoms outside than
    // the paper's.
    assert!((0.02..0.1).contains(&distribution.share_above_one), "{distribution:?}");
}
