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

#[test]
fn labels_by_value_are_fitted_apart() {
    let mut state = CalibrationState::new(2);
    (0..30).for_each(|k| state.learn(&labelled(k, true, &[("Si", 9.0)])));
    // Without other labels, or with too few of them, these are all that is known.
    assert_eq!((state.bound(0.1, "Si"), state.structures()), (Some(90.0), 30));
    (0..5).for_each(|k| state.learn(&labelled(k, false, &[("Si", 1.0)])));
    assert_eq!((state.bound(0.1, "Si"), state.structures()), (Some(90.0), 35));
    assert!(state.expected_error(0.1).is_some() && state.coverage().is_some());
    assert_eq!(state.summary().in_use().structures, 30);
    (5..30).for_each(|k| state.learn(&labelled(k, false, &[("Si", 1.0)])));
    assert_eq!((state.bound(0.1, "Si"), state.structures()), (Some(10.0), 60));
    assert_eq!(state.expected_error(0.1), Some(5.5));
    let summary = state.summary();
    assert_eq!((summary.version, summary.in_use().structures), (2, 30));
    assert_eq!(summary.by_value.unwrap().bound(0.1, "Si"), Some(90.0));
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
            assert_eq!(summary.found.bound(grade, element), state.bound(grade, element), "{grade} {element}");
        }
    }
    assert!(summary.found.bound(0.6, "O").is_some() && summary.found.bound(6.0, "O").is_none());
    assert_eq!(summary.found.elements(), ["Al", "O", "Si"]);
    let coverage = state.coverage().unwrap();
    assert_eq!(
        summary.found.coverage.map(|found| (found.share, found.structures)),
        Some((coverage.share, 130))
    );
}
