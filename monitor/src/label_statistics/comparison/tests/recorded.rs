//! A recorded campaign in aluminium against NumPy, SciPy and scikit-learn (`monitor/tests/data/biased_against_control.py`).

use serde_json::Value as Json;

use super::*;

fn number(json: &Json) -> f64 {
    json.as_f64().unwrap()
}

fn numbers(json: &Json) -> Vec<f64> {
    json.as_array().unwrap().iter().map(number).collect()
}

/// The structures of the recording.
fn frames(recording: &Json) -> ComparedFrames {
    let rows = recording["frames"].as_array().unwrap();
    let found_by = |row: &Json, origin: &str| {
        rows.iter().any(|other| other["content"] == row["content"] && other["origin"] == origin)
    };
    let mut frames = ComparedFrames::new(BTreeMap::new());
    for row in rows {
        let integer = |key: &str| row[key].as_u64().unwrap();
        let origin = if row["origin"] == "biased" { Origin::Biased } else { Origin::Control };
        let (seed_structure, walk) = (integer("seed_structure") as u32, integer("walk") as u32);
        let place = FramePlace { seed_structure, walk, origin };
        let (at, is_shared) = ((0, integer("step")), found_by(row, "biased") && found_by(row, "control"));
        if !(is_shared && origin == Origin::Control) {
            let [gamma, gamma_nbr, errors] = ["gamma", "gamma_nbr", "errors"].map(|key| numbers(&row[key]));
            for ((gamma, gamma_nbr), error) in gamma.into_iter().zip(gamma_nbr).zip(errors) {
                let species = "Al".parse().unwrap();
                frames.atoms.add(ComparedAtom { place, at, is_shared, species, gamma, gamma_nbr, error });
            }
        }
        let (force_mae, stress) = (row["force_mae"].as_f64(), row["stress"].as_f64());
        frames.add_labelled(ComparedFrame {
            place,
            at,
            content: content(integer("content")),
            is_shared,
            by_value: false,
            errors: FrameErrors { force_mae, mean_force_error: None, energy: None, stress },
            temperature: 700.0,
            relative_volume: 1.0,
        });
    }
    frames
}

fn check_group(found: &ComparedGroup, thresholds: &[f64], expected: &Json) {
    assert_eq!(Some(found.structures), expected["structures"].as_u64());
    near(found.median_force_mae.value, number(&expected["median_force_mae"]));
    near(found.median_stress.value, number(&expected["median_stress"]));
    near(found.median_error.value, number(&expected["median_error"]));
    for (ranking, key) in [(&found.gamma, "gamma"), (&found.gamma_nbr, "gamma_nbr")] {
        near(ranking.spearman.value, number(&expected[key]["spearman"]));
        for (threshold, area) in thresholds.iter().zip(numbers(&expected[key]["roc_auc"])) {
            near(ranking.area_above(*threshold).value, area);
        }
    }
}

#[test]
fn statistics_of_a_recorded_campaign_are_those_of_scipy_and_scikit_learn() {
    let text = include_str!("../../../../tests/data/biased_against_control.json");
    let recording: Json = serde_json::from_str(text).unwrap();
    let (expected, thresholds) = (&recording["expected"], numbers(&recording["thresholds"]));
    let found = WalkComparison::new(&frames(&recording), FEW_DRAWS);
    assert_eq!(Some(found.pairs.counts.pairs), expected["pairs"].as_u64());
    assert_eq!(Some(found.pairs.units.seed_structures as u64), expected["seed_structures"].as_u64());
    for (found, key) in [(&found.pairs.force_mae, "force_mae"), (&found.pairs.stress, "stress")] {
        let expected = &expected[key];
        assert_eq!(Some(found.pairs), expected["pairs"].as_u64());
        near(found.biased.value, number(&expected["biased"]));
        near(found.control.value, number(&expected["control"]));
        near(found.median_difference.value, number(&expected["median_difference"]));
        for (found, key) in [(&found.tests, "tests"), (&found.tests_by_unit, "tests_by_unit")] {
            assert_eq!(Some(found.biased_larger), expected[key]["biased_larger"].as_u64());
            near(found.wilcoxon_p, number(&expected[key]["wilcoxon_p"]));
            near(found.sign_p, number(&expected[key]["sign_p"]));
        }
    }
    check_group(&found.matched.biased, &thresholds, &expected["matched"]["biased"]);
    check_group(&found.matched.control, &thresholds, &expected["matched"]["control"]);
    check_group(&found.pooled.all, &thresholds, &expected["pooled"]["all"]);
}
