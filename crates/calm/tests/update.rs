//! Updates and α scans against gracemaker and against the definition.

use std::path::Path;
use std::sync::Arc;

use calm::grade::maximum;
use calm::search::inflate;
use calm::{
    AlphaScan, Artifact, Batch, ChangedComponent, Component, CovarianceUpdate, CovarianceUpdateKind, Grades,
    Mixture, Statistics, UpdateError, pseudo_inverse, regularised_inverse, update,
};

use crate::common;
use crate::common::{Random, assert_close, data, indices, niobium, numbers, peer};

/// Inverses come from eigendecompositions of matrices with condition numbers up to 10⁵ in both programs, so
/// their elements agree to about 10⁵ roundings.
const INVERSE: f64 = 1e-9;
/// Grades after an update have the same error, through small eigenvalues.
const GRADE: f64 = 1e-9;
/// The scan against direct inverses (see the scan's own error estimate).
const SCAN: f64 = 1e-8;

const CASES: [(&str, CovarianceUpdate); 5] = [
    ("convex_0.1", CovarianceUpdate::Convex { alpha: 0.1 }),
    ("convex_0.4", CovarianceUpdate::Convex { alpha: 0.4 }),
    ("convex_1.0", CovarianceUpdate::Convex { alpha: 1.0 }),
    ("additive_0.4", CovarianceUpdate::Additive { alpha: 0.4 }),
    ("accumulate", CovarianceUpdate::Accumulate),
];

fn statistics(changed: &ChangedComponent) -> &Statistics {
    changed.component.statistics().unwrap()
}

fn diagonal(matrix: &[f64], dimension: usize) -> Vec<f64> {
    matrix.iter().step_by(dimension + 1).copied().collect()
}

#[test]
fn niobium_updates_are_the_reference_ones() {
    let (mixture, reference) = (niobium().mixture, data("niobium_reference.npz"));
    let features = numbers(&reference, "batch_features");
    let elements = vec![1; features.len() / 130];
    let batch = Batch::new(&mixture, &elements, &features).unwrap();
    assert_close("gamma before", batch.gamma(), &numbers(&reference, "batch_gamma"), GRADE);
    for (case, combination) in CASES {
        let changed = batch.updated(combination).unwrap();
        let expected = |what: &str| numbers(&reference, &format!("{}_{what}", case.replace('.', "_")));
        let collect = |values: &dyn Fn(&ChangedComponent) -> Vec<f64>| -> Vec<f64> {
            changed.iter().flat_map(values).collect()
        };
        let inverse = collect(&|changed| diagonal(changed.component.inverse(), 130));
        let scatter = collect(&|changed| diagonal(&statistics(changed).scatter, 130));
        let counts = collect(&|changed| vec![statistics(changed).effective_count]);
        assert_close(&format!("{case} inverse"), &inverse, &expected("inverse_diagonal"), INVERSE);
        assert_close(&format!("{case} scatter"), &scatter, &expected("scatter_diagonal"), 1e-12);
        assert_eq!(counts, expected("effective_count"));
        assert_close(case, &batch.gamma_under(&changed), &expected("gamma"), GRADE);
    }
}

#[test]
fn every_reference_update_is_reproduced() {
    let Some(folder) = peer("grace") else { return };
    let (file, mixture) = (folder.join("calm_build/update_cases.npz"), peer_mixture(&folder));
    let (elements, features) = (indices(&file, "batch_elements"), numbers(&file, "batch_features"));
    let batch = Batch::new(&mixture, &elements, &features).unwrap();
    assert_close("gamma before", batch.gamma(), &numbers(&file, "gamma_before"), GRADE);
    for (case, combination) in CASES {
        let changed = batch.updated(combination).unwrap();
        let places: Vec<usize> = changed.iter().flat_map(|changed| [changed.element, changed.slot]).collect();
        assert_eq!(places, indices(&file, "touched"));
        let expected = |what: &str| numbers(&file, &format!("{case}/{what}"));
        let inverses: Vec<f64> =
            changed.iter().flat_map(|changed| changed.component.inverse().to_vec()).collect();
        check_inverses(case, &inverses, &expected("inv_cov"));
        let counts: Vec<f64> = changed.iter().map(|changed| statistics(changed).count).collect();
        assert_eq!(counts, expected("counts"));
        assert_close(case, &batch.gamma_under(&changed), &expected("gamma_after"), GRADE);
        // The updated mixture gives the same grades through the normal path.
        let mut grades = Grades::default();
        grades.evaluate(&mixture.with_changes(&changed).unwrap(), &elements, &features, None).unwrap();
        assert_eq!(grades.gamma, batch.gamma_under(&changed));
    }
}

/// Relative to the largest element, because small elements are differences of large ones. The additive case
/// stores diagonals.
fn check_inverses(case: &str, found: &[f64], expected: &[f64]) {
    let found = match found.len() == expected.len() {
        true => found.to_vec(),
        false => found.chunks_exact(130 * 130).flat_map(|inverse| diagonal(inverse, 130)).collect(),
    };
    let largest = expected.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
    let worst = found.iter().zip(expected).fold(0.0_f64, |worst, (a, b)| worst.max((a - b).abs())) / largest;
    println!("{case} inverse: {worst:.1e} of the largest element");
    assert!(found.len() == expected.len() && worst < INVERSE);
}

fn peer_mixture(folder: &Path) -> Mixture {
    Artifact::load(folder.join("grace1l_tiny/gmm_artifacts.npz")).unwrap().mixture
}

#[test]
fn the_reference_search_is_reproduced() {
    let Some(folder) = peer("grace") else { return };
    let (file, mixture) = (folder.join("calm_build/update_cases.npz"), peer_mixture(&folder));
    let (elements, features) = (indices(&file, "batch_elements"), numbers(&file, "batch_features"));
    for combination in ["convex", "additive"] {
        let settings = |target: f64| {
            let text = format!(
                "covariance_update = '{combination}'\nalpha_values = [0.05, 0.1, 0.2, 0.4, 0.7, 1.0]\n\
                 stop = {{ rule = 'maximum_grade', target = {target:?} }}"
            );
            toml::from_str(&text).unwrap()
        };
        // With a target below all trials it tries all six.
        let outcome = update(&mixture, &elements, &features, &settings(0.2)).unwrap();
        let trials: Vec<f64> = outcome.trials.iter().map(|trial| trial.gamma_max).collect();
        let key = |name: &str| numbers(&file, &format!("{name}_{combination}"));
        assert_close("trial gammas", &trials, &key("trial_gamma"), SCAN);
        let outcome = update(&mixture, &elements, &features, &settings(1.25)).unwrap();
        let reference = key("alpha_search");
        assert_eq!(outcome.alpha, reference[0]);
        assert_eq!(outcome.trials.len(), 2);
        let gammas = numbers(&file, &format!("alpha_search_{combination}_gamma"));
        assert_close("alpha search", &outcome.gamma_after, &gammas, GRADE);

        // The reference inflates the result of this search towards an unreachable target.
        let inflation = numbers(&file, &format!("inflate_{combination}_target0.2"));
        let batch = Batch::new(&mixture, &elements, &features).unwrap();
        let (changed, factors) = inflate(&batch, outcome.changed, 0.2).unwrap();
        let gamma_max = maximum(&batch.gamma_under(&changed));
        assert_eq!(factors.len() as f64, inflation[0]);
        assert_close("after inflation", &[gamma_max], &inflation[1..2], GRADE);
        assert_close("factors", &factors, &inflation[2..], GRADE);
    }
}

/// The largest relative deviation between scanned and direct grades of a batch over all α that the scan
/// accepts.
fn scan_deviation(batch: &Batch, combination: CovarianceUpdateKind) -> (f64, usize) {
    let ladder = AlphaScan::new(batch, combination);
    let (mut worst, mut trusted) = (0.0_f64, 0);
    for alpha in Vec::from(combination.default_alphas()) {
        let update = match combination {
            CovarianceUpdateKind::Convex => CovarianceUpdate::Convex { alpha },
            CovarianceUpdateKind::Additive => CovarianceUpdate::Additive { alpha },
        };
        let direct = batch.gamma_under(&batch.updated(update).unwrap());
        if let Some(fast) = ladder.gamma(alpha) {
            let deviation = common::deviation(&fast, &direct);
            println!("{combination:?} α = {alpha}: {deviation:.1e}");
            (worst, trusted) = (worst.max(deviation), trusted + 1);
        } else {
            println!("{combination:?} α = {alpha}: left to the direct inverse");
        }
    }
    (worst, trusted)
}

#[test]
fn the_ladder_gives_the_direct_grades() {
    let mixture = niobium().mixture;
    let features = numbers(&data("niobium_reference.npz"), "features");
    let elements = vec![1; features.len() / 130];
    let batch = Batch::new(&mixture, &elements, &features).unwrap();
    let (convex, trusted) = scan_deviation(&batch, CovarianceUpdateKind::Convex);
    assert!(convex < SCAN && trusted >= 5, "{convex:e}, {trusted} of 6");
    let (additive, trusted) = scan_deviation(&batch, CovarianceUpdateKind::Additive);
    assert!(additive < SCAN && trusted == 11, "{additive:e}, {trusted} of 11");
}

#[test]
fn the_ladder_gives_the_direct_grades_far_outside() {
    for (model, scale) in [("al_eam_1l", 0.01), ("al_eam_1l", 0.3), ("si_sw_1l", 0.05), ("si_sw_1l", 3.0)] {
        let mixture = Artifact::load(common::model(&format!("{model}/gmm_artifacts.npz"))).unwrap().mixture;
        let centroid = mixture.component(0, 0).unwrap().centroid().to_vec();
        let mut random = Random(7);
        let features: Vec<f64> = (0..108)
            .flat_map(|_| centroid.iter().map(|z| z + scale * random.next()).collect::<Vec<_>>())
            .collect();
        let batch = Batch::new(&mixture, &[0; 108], &features).unwrap();
        println!("{model}, γ_max before {:.1}", maximum(batch.gamma()));
        for combination in [CovarianceUpdateKind::Convex, CovarianceUpdateKind::Additive] {
            let (worst, trusted) = scan_deviation(&batch, combination);
            assert!(worst < SCAN && trusted >= 5, "{model} {scale} {combination:?}: {worst:e}, {trusted}");
        }
    }
}

/// D = 4 with diagonal covariance: everything has a closed form.
fn analytic() -> Mixture {
    let variances = [4.0, 1.0, 0.25, 0.0];
    let (mut scatter, mut inverse) = (vec![0.0; 16], vec![0.0; 16]);
    for (index, variance) in variances.iter().enumerate() {
        scatter[5 * index] = 10.0 * variance;
        inverse[5 * index] = 1.0 / (variance + 1e-6);
    }
    let statistics = Statistics { scatter, count: 8.0, effective_count: 10.0 };
    let component = Component::new(vec![1.0, 0.0, -1.0, 0.0], inverse, 2.0, Some(statistics)).unwrap();
    Mixture::new(0, vec![vec![Arc::new(component)]]).unwrap()
}

#[test]
fn a_single_atom_updates_as_written_down() {
    // δ = (2, 0, 0, 0): C_batch has the single element 4, and every convex α keeps C there.
    let batch = Batch::new(&analytic(), &[0], &[3.0, 0.0, -1.0, 0.0]).unwrap();
    let grade = |variance: f64| ((4.0 / (variance + 1e-6) + 1e-8_f64).sqrt()) / 2.0;
    assert_close("before", batch.gamma(), &[grade(4.0)], 1e-14);
    for alpha in [0.05, 0.3, 1.0] {
        for (update, first, second) in [
            (CovarianceUpdate::Convex { alpha }, 4.0, 1.0 - alpha),
            (CovarianceUpdate::Additive { alpha }, 4.0 + 4.0 * alpha, 1.0),
            (CovarianceUpdate::Accumulate, 4.0, 10.0 / 11.0),
        ] {
            let changed = batch.updated(update).unwrap();
            assert_close("after", &batch.gamma_under(&changed), &[grade(first)], 1e-12);
            let statistics = statistics(&changed[0]);
            assert_eq!((statistics.count, statistics.effective_count), (9.0, 11.0));
            assert_close(
                "scatter",
                &statistics.scatter[..6],
                &[11.0 * first, 0.0, 0.0, 0.0, 0.0, 11.0 * second],
                1e-14,
            );
            let inverse = changed[0].component.inverse()[5];
            assert_close("inverse", &[inverse], &[1.0 / (second + 1e-6)], 1e-12);
        }
    }
    let doubled = batch.inflated(&batch.updated(CovarianceUpdate::Accumulate).unwrap(), 2.0).unwrap();
    assert_close("inflated", &batch.gamma_under(&doubled), &[grade(8.0)], 1e-12);
    assert_eq!(statistics(&doubled[0]).effective_count, 11.0);
}

#[test]
fn only_touched_components_change() {
    let mixture = niobium().mixture;
    let features = numbers(&data("niobium_reference.npz"), "batch_features");
    let mut grades = Grades::default();
    grades.evaluate(&mixture, &[1], &features[..130], None).unwrap();
    let batch = Batch::new(&mixture, &[1], &features[..130]).unwrap();
    let next =
        mixture.with_changes(&batch.updated(CovarianceUpdate::Convex { alpha: 0.1 }).unwrap()).unwrap();
    assert_eq!(next.version(), mixture.version() + 1);
    for ((element, slot, before), (_, _, after)) in mixture.iter().zip(next.iter()) {
        assert_eq!(Arc::ptr_eq(before, after), (element, slot) != (1, grades.component[0]));
    }
}

#[test]
fn an_absent_element_can_be_learnt() {
    let mixture = niobium().mixture;
    let features = &numbers(&data("niobium_reference.npz"), "features")[..12 * 130];
    let settings = toml::from_str("stop = { rule = 'maximum_grade' }").unwrap();
    let outcome = update(&mixture, &[0; 12], features, &settings).unwrap();
    assert!(outcome.gamma_before.iter().all(|&grade| grade > 1000.0));
    let next = mixture.with_changes(&outcome.changed).unwrap();
    let mut grades = Grades::default();
    grades.evaluate(&next, &[0; 12], features, None).unwrap();
    assert_eq!(grades.gamma, outcome.gamma_after);
    assert!(grades.maximum() < 10.0, "{}", grades.maximum());
}

#[test]
fn what_cannot_be_updated_is_an_error() {
    let export = Artifact::load_export(common::model("al_eam_1l/kokkos.npz")).unwrap();
    let centroid = export.mixture.component(0, 0).unwrap().centroid().to_vec();
    let error = Batch::new(&export.mixture, &[0], &centroid).unwrap_err();
    assert_eq!(error, UpdateError::NoStatistics { element: 0, slot: 0 });
    assert_eq!(Batch::new(&export.mixture, &[], &[]).unwrap_err(), UpdateError::Empty);
    assert!(
        pseudo_inverse(&[1.0, f64::NAN, 0.0, 1.0], 2).unwrap_err().to_string().contains("row 0, column 1")
    );
    assert!(pseudo_inverse(&[1.0; 3], 2).is_err());
}

#[test]
fn small_reference_cases() {
    let text = std::fs::read_to_string(data("unit_cases.json")).unwrap();
    let cases: serde_json::Value = serde_json::from_str(&text).unwrap();
    let flat = |value: &serde_json::Value| -> Vec<f64> {
        fn collect(value: &serde_json::Value, out: &mut Vec<f64>) {
            match value.as_array() {
                Some(values) => values.iter().for_each(|value| collect(value, out)),
                None => out.push(value.as_f64().unwrap()),
            }
        }
        let mut out = Vec::new();
        collect(value, &mut out);
        out
    };
    let deficient = &cases["safe_invert_rank2"];
    let inverse = pseudo_inverse(&flat(&deficient["cov"]), 4).unwrap();
    assert_close("rank 2 of 4", &inverse, &flat(&deficient["inv"]), 1e-12);

    // The merged scatter of slots 0, 2 and 3 becomes components 0, 1 and 2.
    let (merged, finalised) = (&cases["merge_step2"], &cases["finalize"]["0"]);
    for (component, slot) in [(0, 0), (1, 2), (2, 3)] {
        let count = merged["out_counts"][slot].as_f64().unwrap();
        let scatter = flat(&merged["out_scatter"][slot]);
        let covariance: Vec<f64> = scatter.iter().map(|value| value / count).collect();
        let inverse = regularised_inverse(&covariance, 4).unwrap();
        assert_close("inverse", &inverse, &flat(&finalised["inv_cov"][component]), 1e-12);
    }

    let components = |element: &str| -> Vec<Arc<Component>> {
        let part = &cases["finalize"][element];
        let component = |slot: usize| {
            Component::new(flat(&part["centroids"][slot]), flat(&part["inv_cov"][slot]), 1.0, None).unwrap()
        };
        (0..3).map(component).map(Arc::new).collect()
    };
    let missing = vec![Arc::new(Component::unknown_element(4))];
    let mixture = Mixture::new(0, vec![components("0"), components("1"), missing]).unwrap();
    let case = &cases["missing_element"];
    let elements: Vec<usize> = flat(&case["elements"]).into_iter().map(|value| value as usize).collect();
    let mut grades = Grades::default();
    grades.evaluate(&mixture, &elements, &flat(&case["features"]), None).unwrap();
    let found: Vec<f64> = grades.component.iter().map(|&slot| slot as f64).collect();
    assert_eq!(found, flat(&case["cluster"]));
    assert_close("missing element", &grades.sigma, &flat(&case["sigma"]), 1e-12);
}
