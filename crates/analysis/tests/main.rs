//! Statistics against scipy and scikit-learn (`data/labelled_errors.py`).

use analysis::{Bootstrap, Exceedance, GradedRow, RankedErrors, filter_sweep, quantile, roc_auc, spearman};
use serde_json::Value as Json;

const TOLERANCE: f64 = 1e-12;

fn golden() -> Json {
    serde_json::from_str(include_str!("data/labelled_errors.json")).unwrap()
}

fn numbers(golden: &Json, key: &str) -> Vec<f64> {
    golden[key].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn assert_near(found: Option<f64>, expected: &Json) {
    let (found, expected) = (found.unwrap(), expected.as_f64().unwrap());
    assert!((found - expected).abs() < TOLERANCE, "{found} {expected}");
}

#[test]
fn ranks_are_those_of_scipy_and_scikit_learn() {
    let golden = golden();
    let [errors, scores, thresholds] = ["errors", "scores", "thresholds"].map(|key| numbers(&golden, key));
    let [units, multiplicities] = ["units", "multiplicities"]
        .map(|key| numbers(&golden, key).into_iter().map(|x| x as u32).collect::<Vec<_>>());
    let ranked = RankedErrors::new(&errors, &units, std::slice::from_ref(&scores));
    let whole = &ranked.statistics(&vec![1; multiplicities.len()], &thresholds)[0];
    let resampled = &ranked.statistics(&multiplicities, &thresholds)[0];
    assert_near(whole.spearman, &golden["spearman"]);
    assert_near(spearman(&scores, &errors), &golden["spearman"]);
    assert_near(resampled.spearman, &golden["resampled_spearman"]);
    for (k, threshold) in thresholds.into_iter().enumerate() {
        assert_near(whole.auc[k], &golden["auc"][k]);
        assert_near(roc_auc(&scores, &errors, threshold), &golden["auc"][k]);
        assert_near(resampled.auc[k], &golden["resampled_auc"][k]);
    }
}

#[test]
fn the_worst_decile_is_that_of_each_element() {
    let golden = golden();
    let [errors, scores, elements] = ["errors", "scores", "elements"].map(|key| numbers(&golden, key));
    for (element, expected) in golden["worst_decile"].as_array().unwrap().iter().enumerate() {
        let of = |values: &[f64]| -> Vec<f64> {
            values.iter().zip(&elements).filter(|(_, of)| **of == element as f64).map(|(x, _)| *x).collect()
        };
        let (errors, scores) = (of(&errors), of(&scores));
        let mut ascending = errors.clone();
        ascending.sort_by(f64::total_cmp);
        let threshold = quantile(&ascending, 0.9);
        assert_near(threshold, &expected["threshold"]);
        assert_near(roc_auc(&scores, &errors, threshold.unwrap()), &expected["auc"]);
    }
}

#[test]
fn contamination_and_percentiles_are_those_of_numpy() {
    let golden = golden();
    let [errors, scores, thresholds] = ["errors", "scores", "thresholds"].map(|key| numbers(&golden, key));
    let mut counts = Exceedance::new(&thresholds);
    let limit = golden["limit"].as_f64().unwrap();
    errors.iter().zip(&scores).for_each(|(error, score)| counts.add(*error, *score <= limit, 1));
    assert_near(counts.retention(), &golden["retention"]);
    for (k, found) in counts.contamination().into_iter().enumerate() {
        assert_near(found, &golden["contamination"][k]);
    }
    let bootstrap = Bootstrap { draws: 1, level: 0.9, seed: 0 };
    let (low, high) = bootstrap.interval(&errors.into_iter().map(Some).collect::<Vec<_>>()).unwrap();
    assert_near(Some(low), &golden["interval_90"][0]);
    assert_near(Some(high), &golden["interval_90"][1]);
}

#[test]
fn filtered_tables_have_the_quality_of_scikit_learn() {
    let golden = golden();
    let [grades, predicted, actual] = ["grades", "predicted", "true"].map(|key| numbers(&golden, key));
    let row = |k: usize| GradedRow {
        grade: grades[k],
        error: predicted[k] - actual[k],
        class: Some((predicted[k] <= 0.0, actual[k] <= 0.0)),
    };
    let rows: Vec<_> = (0..grades.len()).map(row).collect();
    let expected = golden["filtered"].as_array().unwrap();
    let thresholds: Vec<_> = expected.iter().map(|step| step["threshold"].as_f64().unwrap()).collect();
    for (step, expected) in filter_sweep(&rows, &thresholds, 3, 1).iter().zip(expected) {
        assert_eq!(step.kept as u64, expected["kept"].as_u64().unwrap());
        assert_near(step.quality.mean_error, &expected["mean_error"]);
        assert_near(step.quality.precision, &expected["precision"]);
        assert_near(step.quality.recall, &expected["recall"]);
        assert_near(step.quality.f1, &expected["f1"]);
    }
}
