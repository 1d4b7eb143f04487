//! What is learned from labels of both orders, and that the summary says the same.

use analysis::GradedError;
use wire::ContentHash;

use super::learning::ArrivedLabel;
use super::*;

fn labelled(number: u32, ordered_by_value: bool, elements: &[(&'static str, f64)]) -> ArrivedLabel {
    let atom = |(place, (group, factor)): (usize, &(&'static str, f64))| GradedError {
        grade: 0.1 + 0.3 * place as f64,
        error: factor * (1.0 + f64::from(number % 10)),
        group: *group,
    };
    let atoms = elements.iter().enumerate().map(atom).collect();
    ArrivedLabel { content: ContentHash([number as u8; 32]), ordered_by_value, atoms }
}

/// The bound at a grade, by the state and by its summary.
fn bound(state: &CalibrationState, grade: f64) -> Option<f64> {
    let bound = state.bound(grade, "Si");
    assert_eq!(state.summary().bound(grade, "Si"), bound);
    bound
}

#[test]
fn labels_by_value_are_fitted_apart() {
    let mut state = CalibrationState::new(2);
    (0..30).for_each(|k| state.learn(&labelled(k, true, &[("Si", 9.0)])));
    // Without other labels, or with too few of them, these are all that is known.
    assert_eq!((bound(&state, 0.1), state.structures()), (Some(90.0), 30));
    (0..5).for_each(|k| state.learn(&labelled(k, false, &[("Si", 1.0)])));
    assert_eq!((bound(&state, 0.1), state.structures()), (Some(90.0), 35));
    assert_eq!(state.summary().pooled().iter().map(|(_, by_value)| *by_value).collect::<Vec<_>>(), [true]);
    (5..30).for_each(|k| state.learn(&labelled(k, false, &[("Si", 1.0)])));
    assert_eq!((bound(&state, 0.1), state.structures()), (Some(10.0), 60));
    assert_eq!(state.expected_error(0.1), Some(5.5));
    let summary = state.summary();
    assert_eq!((summary.version, summary.map(false).structures, summary.map(true).structures), (2, 30, 30));
    assert_eq!(summary.pooled().iter().map(|(_, by_value)| *by_value).collect::<Vec<_>>(), [false]);
}

/// A campaign that begins in the order found, and goes on by value: the first labels do not count for ever.
#[test]
fn old_labels_give_way_to_many_newer_ones_by_value() {
    let mut state = CalibrationState::new(0);
    (0..25).for_each(|k| state.learn(&labelled(k, false, &[("Si", 1.0)])));
    let by_value = |state: &mut CalibrationState, number: std::ops::Range<u32>| {
        number.for_each(|k| state.learn(&labelled(k, true, &[("Si", 9.0), ("Si", 9.0), ("Si", 9.0)])));
    };
    by_value(&mut state, 0..49);
    // Only labels by value have atoms in the second bin.
    assert!(bound(&state, 0.1) <= Some(10.0) && bound(&state, 0.7) > Some(50.0));
    by_value(&mut state, 49..50);
    assert!(bound(&state, 0.1) > Some(50.0) && state.expected_error(0.1) == Some(49.5));
    // As soon as half of the others are as new as these, they count again.
    (0..25).for_each(|k| state.learn(&labelled(k, false, &[("Si", 2.0)])));
    assert!(bound(&state, 0.1).unwrap() <= 20.0);
}

#[test]
fn large_grades_have_at_least_the_error_of_the_nearest_bin_that_is_known() {
    let mut state = CalibrationState::new(0);
    let mut one = labelled(0, false, &[("Si", 1.0), ("Si", 1.0)]);
    (one.atoms[0].grade, one.atoms[1].grade) = (0.6, 1.7);
    (one.atoms[0].error, one.atoms[1].error) = (0.1, 0.9);
    (0..30).for_each(|_| state.learn(&one));
    let expected = [0.2, 0.6, 0.9, 1.7, 8.0].map(|grade| state.expected_error(grade));
    let near = |found: Option<f64>, value: f64| (found.unwrap() - value).abs() < 1e-12;
    assert!(expected.into_iter().zip([0.1, 0.1, 0.1, 0.9, 0.9]).all(|(a, b)| near(a, b)), "{expected:?}");
    assert_eq!((state.expected_error(f64::NAN), bound(&state, 8.0)), (None, None));
    assert_eq!(CalibrationState::new(0).expected_error(1.0), None);
}

#[test]
fn the_summary_has_the_bounds_of_the_state_also_as_json() {
    let mut state = CalibrationState::new(0);
    for number in 0..150 {
        let rare: &[_] =
            if number < 25 { &[("Al", 1.0), ("Si", 2.0), ("O", 3.0), ("O", 1.0)] } else { &[("Al", 1.0)] };
        state.learn(&labelled(number, false, rare));
    }
    let json = serde_json::to_string(&state.summary()).unwrap();
    let summary: CalibrationSummary = serde_json::from_str(&json).unwrap();
    assert_eq!((&summary, &summary.by_value), (&state.summary(), &None));
    for grade in [0.0, 0.1, 0.5, 0.6, 0.75, 1.0, 1.1, 6.0, f64::NAN] {
        for element in ["Al", "Si", "O", "Cu"] {
            assert_eq!(summary.bound(grade, element), state.bound(grade, element), "{grade} {element}");
        }
    }
    assert!(summary.bound(0.6, "O").is_some() && summary.bound(6.0, "O").is_none());
    assert_eq!(summary.found.elements(), ["Al", "O", "Si"]);
    let coverage = summary.found.coverage.unwrap();
    let outcomes = state.outcomes();
    assert_eq!((coverage.structures, outcomes.len()), (130, 130));
    assert!((coverage.share - outcomes.iter().sum::<f64>() / 130.0).abs() < 1e-12);
    assert_eq!(coverage.unbounded, 0.0);
}
