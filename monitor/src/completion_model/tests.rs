use store::WalkRecord;
use wire::WalkConditions;

use super::*;
use crate::tests::{self, FoundStructure, PROTOCOL, biased};

fn predictors(gamma_max: f64, relative_volume: f64) -> CompletionPredictors {
    CompletionPredictors { gamma_max, relative_volume, shortest_bond: 0.9, fractions: vec![(13, 1.0)] }
}

/// The random number of a place, between 0 and 1 (Steele, Lea and Flood's SplitMix64).
fn uniform(place: usize) -> f64 {
    let mut z = (place as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

/// Structures whose labels fail more often the larger their volume.
fn expanded(number: usize) -> Vec<CompletionExample> {
    let example = |place: usize| {
        let volume = 0.8 + 0.8 * uniform(3 * place);
        let probability = 1.0 / (1.0 + (12.0 * (volume - 1.3)).exp());
        let completed = uniform(3 * place + 1) < probability;
        CompletionExample {
            predictors: predictors(1.0 + uniform(3 * place + 2), volume),
            completed,
            seed_structure: place as u32 % 7,
            walk: place as u32,
        }
    };
    (0..number).map(example).collect()
}

#[test]
fn the_share_holds_until_there_is_enough_to_learn_from() {
    assert_eq!(CompletionModel::fit(&[]), None);
    let examples = expanded(400);
    let (labelled, failed): (Vec<_>, Vec<_>) = examples.into_iter().partition(|example| example.completed);
    let of = |labels: usize, failures: usize| {
        let all: Vec<_> = labelled[..labels].iter().chain(&failed[..failures]).cloned().collect();
        CompletionModel::fit(&all).unwrap()
    };
    for (labels, failures) in [(16, 3), (18, 2), (2, 30)] {
        let model = of(labels, failures);
        let share = labels as f64 / (labels + failures) as f64;
        assert!(model.coefficients.is_constant(), "{labels} {failures}");
        assert!((model.probability(&predictors(1.0, 1.6)) - share).abs() < 1e-12);
    }
    assert_eq!(of(5, 0).probability(&predictors(1.0, 1.0)), 1.0);
    assert!(!of(17, 3).coefficients.is_constant());
}

#[test]
fn it_learns_what_makes_labels_fail_and_is_judged_on_others() {
    let examples = expanded(600);
    let model = CompletionModel::fit(&examples).unwrap();
    let at = |volume: f64| model.probability(&predictors(1.5, volume));
    assert!(at(1.0) > 0.9 && (at(1.3) - 0.5).abs() < 0.12 && at(1.55) < 0.15, "{model:?}");
    let diagram = reliability(&examples);
    assert_eq!(diagram.number(), 600);
    assert!(diagram.brier_score().unwrap() < 0.6 * diagram.brier_score_of_share().unwrap());
    for bin in diagram.bins().iter().filter(|bin| bin.number >= 40) {
        assert!((bin.predicted.unwrap() - bin.observed.unwrap()).abs() < 0.1, "{bin:?}");
    }
    assert_eq!(named(&model.coefficients).len(), 5, "one element has no coefficient");
}

/// Eight walks of one seed structure with ten alike frames each, which all complete or all fail. Frames of a walk say all of each other,
/// and nothing of other walks: elements of their own stand for whatever distinguishes them.
#[test]
fn frames_of_a_walk_do_not_predict_each_other() {
    let frame = |place: u32| {
        let walk = place % 8;
        let fractions = vec![(1 + walk as u8, 1.0)];
        let predictors = CompletionPredictors { fractions, ..predictors(2.0, 1.1) };
        CompletionExample { predictors, completed: walk.is_multiple_of(2), seed_structure: 0, walk }
    };
    let examples: Vec<_> = (0..80).map(frame).collect();
    let diagram = reliability(&examples);
    let (model, share) = (diagram.brier_score().unwrap(), diagram.brier_score_of_share().unwrap());
    assert!(diagram.number() == 80 && model > 0.95 * share, "{model} {share}");
    // Seed structures are the units if there are enough of them.
    let of_seeds = |example: &CompletionExample| CompletionExample {
        seed_structure: example.walk,
        walk: 100 + example.walk % 2,
        ..example.clone()
    };
    let of_seeds: Vec<_> = examples.iter().map(of_seeds).collect();
    assert_eq!(reliability(&of_seeds).brier_score(), diagram.brier_score());
    let one_walk: Vec<_> = examples.iter().map(|of| CompletionExample { walk: 3, ..of.clone() }).collect();
    assert_eq!(reliability(&one_walk).number(), 0);
}

/// A new version of the potential has no finished labels, but what made others fail still does. Its grades are others.
#[tokio::test]
async fn a_new_version_learns_from_the_others_until_it_has_enough_labels() {
    let directory = tempfile::tempdir().unwrap();
    let walks = vec![
        biased(0),
        WalkRecord { conditions: WalkConditions { version: 1, ..WalkConditions::default() }, ..biased(1) },
    ];
    let store = tests::begin(directory.path(), walks).await;
    let finish = async |walk: u32, number: u64, (gamma, relative_volume): (f64, f64), completes: bool| {
        let found =
            FoundStructure { walk, step: number, gamma, relative_volume, ..FoundStructure::new(number) };
        tests::find(&store, found).await;
        tests::finish(&store, completes).await;
    };
    for number in 0..30 {
        let expanded = number % 3 == 0;
        let (gamma, volume) = if expanded { (9.0, 1.3) } else { (1.0, 1.0) };
        finish(0, number, (gamma, volume + 0.001 * number as f64), !expanded).await;
    }
    let model = async |version: u32| {
        let found = examples(&store, PROTOCOL, version).await.unwrap();
        (CompletionModel::fit(&found.examples).unwrap(), found.of_all_versions)
    };
    let (own, of_all) = model(0).await;
    assert!(!of_all && own.coefficients.weights[0] < -0.1, "γ counts within a version: {own:?}");
    for number in 30..45 {
        finish(1, number, (2.0, 1.0 + 0.001 * number as f64), true).await;
    }
    let (new, of_all) = model(1).await;
    assert!(of_all && new.finished == 45 && new.coefficients.weights[0] == 0.0, "{new:?}");
    let at = |volume: f64| [1.0, 50.0].map(|gamma| new.probability(&predictors(gamma, volume)));
    assert!(at(1.0)[0] > 0.8 && at(1.3)[0] < 0.3 && at(1.3)[0] == at(1.3)[1], "{new:?}");
    let report = CompletionReport::read(&store, PROTOCOL, 1).await.unwrap().unwrap();
    assert!(report.of_all_versions && report.is_regression && report.finished == 45);
    for number in 45..50 {
        finish(1, number, (2.0, 1.3 + 0.001 * number as f64), false).await;
    }
    let (own, of_all) = model(1).await;
    assert_eq!((own.finished, of_all), (20, false));
}
