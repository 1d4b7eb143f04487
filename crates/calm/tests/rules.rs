//! Collection rules, stop rules, and their configuration.

use std::num::NonZeroUsize;
use std::sync::Arc;

use calm::rules::{AlphaValues, AtomCount, AtomCountUpdate, Fraction, MaximumGrade, Positive};
use calm::{
    CollectionRule, Component, CovarianceUpdateKind, Mixture, Statistics, UpdateEnd, UpdateRule,
    UpdateSettings, update,
};

use crate::common;
use crate::common::assert_close;

fn collection(text: &str) -> CollectionRule {
    toml::from_str(text).unwrap()
}

#[test]
fn the_papers_values_are_the_defaults() {
    let positive = |value: f64| Positive::try_from(value).unwrap();
    let (fraction, min_atoms) = (Fraction::try_from(0.15).unwrap(), NonZeroUsize::new(3).unwrap());
    let threshold = positive(1.5);
    assert_eq!(
        collection("rule = 'maximum_grade'"),
        CollectionRule::MaximumGrade(MaximumGrade { threshold })
    );
    let threshold = positive(1.3);
    let rule = CollectionRule::AtomCount(AtomCount { threshold, fraction, min_atoms });
    assert_eq!(collection("rule = 'atom_count'"), rule);
    let settings: UpdateSettings = toml::from_str("stop = { rule = 'atom_count' }").unwrap();
    let stop =
        UpdateRule::AtomCount(AtomCountUpdate { threshold, fraction, min_atoms, target: positive(1.25) });
    assert_eq!(
        settings,
        UpdateSettings { covariance_update: CovarianceUpdateKind::Convex, alpha_values: None, stop }
    );
    assert_eq!(settings.alphas(), [0.05, 0.1, 0.2, 0.4, 0.7, 1.0]);
    for combination in [CovarianceUpdateKind::Convex, CovarianceUpdateKind::Additive] {
        let ladder = combination.default_alphas();
        assert_eq!(AlphaValues::try_from(ladder.values().to_vec()).unwrap(), ladder);
    }
}

#[test]
fn configurations_survive_a_round_trip() {
    for text in
        ["rule = 'maximum_grade'\nthreshold = 2.0", "rule = 'atom_count'\nfraction = 1.0\nmin_atoms = 7"]
    {
        let rule = collection(text);
        assert_eq!(collection(&toml::to_string(&rule).unwrap()), rule);
    }
    let text = "covariance_update = 'additive'\nalpha_values = [0.01, 1.0]\nstop = { rule = 'maximum_grade', target = 1.1 }";
    let settings: UpdateSettings = toml::from_str(text).unwrap();
    assert_eq!(toml::from_str::<UpdateSettings>(&toml::to_string(&settings).unwrap()).unwrap(), settings);
}

#[test]
fn nonsense_is_refused() {
    for (text, message) in [
        ("rule = 'maximum_grade'\nthreshold = 0.0", "above 0"),
        ("rule = 'maximum_grade'\nthreshold = inf", "finite"),
        ("rule = 'maximum_grade'\nthreshold = nan", "finite"),
        ("rule = 'maximum_grade'\nfraction = 0.5", "unknown field `fraction`"),
        ("rule = 'atom_count'\nfraction = 1.5", "not above 1"),
        ("rule = 'atom_count'\nmin_atoms = 0", "nonzero"),
        ("rule = 'most'", "unknown variant"),
    ] {
        let error = toml::from_str::<CollectionRule>(text).unwrap_err().to_string();
        assert!(error.contains(message), "{error}");
    }
    for values in ["[]", "[0.2, 0.1]", "[0.1, 0.1]", "[0.0, 1.0]", "[1.5]", "[nan]"] {
        let text = format!("alpha_values = {values}\nstop = {{ rule = 'maximum_grade' }}");
        assert!(toml::from_str::<UpdateSettings>(&text).unwrap_err().to_string().contains("ascending"));
    }
    assert!(toml::from_str::<UpdateSettings>("stop = { rule = 'atom_count' }\nalpha = 1").is_err());
}

#[test]
fn a_structure_is_collected_when_the_rule_says_so() {
    let maximum = collection("rule = 'maximum_grade'");
    assert!(!maximum.is_met(&[0.2, 1.5]) && maximum.is_met(&[1.5000001, 0.2]) && !maximum.is_met(&[]));
    let count = collection("rule = 'atom_count'");
    let graded = |above: usize, atoms: usize| [vec![1.31; above], vec![1.3; atoms - above]].concat();
    for (atoms, limit) in [(1, 3), (20, 3), (21, 4), (40, 6), (108, 17), (340, 51)] {
        if limit <= atoms {
            assert!(count.is_met(&graded(limit, atoms)), "{atoms} atoms");
            assert!(!count.is_met(&graded(limit - 1, atoms)), "{atoms} atoms");
        } else {
            assert!(!count.is_met(&graded(atoms, atoms)), "{atoms} atoms");
        }
    }
}

#[test]
fn rules_describe_themselves() {
    let (maximum, count) = (collection("rule = 'maximum_grade'"), collection("rule = 'atom_count'"));
    assert_eq!(maximum.description(), "the largest γ of its atoms is above 1.5");
    assert_eq!(count.description(), "at least max(3, ⌈0.15 N⌉) of its N atoms have γ above 1.3");
    assert_eq!(maximum.condition(108), "maximum_grade: γ_max > 1.5");
    assert_eq!(
        count.condition(108),
        "atom_count: at least 17 atoms with γ > 1.3 (the larger of 3 and 15 % of 108)"
    );
    assert_eq!(
        [maximum.too_small(1), count.too_small(3), count.too_small(2)],
        [None, None, Some((3, "min_atoms"))]
    );
    let update = |text: &str| toml::from_str::<UpdateRule>(text).unwrap().condition(108);
    assert_eq!(update("rule = 'maximum_grade'"), "maximum_grade: γ_max below 1.25");
    assert_eq!(
        update("rule = 'atom_count'"),
        "atom_count: fewer than 17 atoms with γ > 1.3, else γ_max below 1.25"
    );
}

/// D = 2, unit covariance, θ = 1: an atom at distance r has γ = r before.
fn round() -> Mixture {
    let identity = vec![1.0, 0.0, 0.0, 1.0];
    let scatter = identity.iter().map(|value| 10.0 * value).collect();
    let statistics = Statistics { scatter, count: 10.0, effective_count: 10.0 };
    let component = Component::new(vec![0.0, 0.0], identity, 1.0, Some(statistics)).unwrap();
    Mixture::new(3, vec![vec![Arc::new(component)]]).unwrap()
}

fn settings(text: &str) -> UpdateSettings {
    toml::from_str(text).unwrap()
}

#[test]
fn the_smallest_alpha_below_the_target_is_taken() {
    // One atom at r: convex γ² = r² / (1 − α + α r²); r = 3 needs α > 0.595 for 1.25.
    let outcome =
        update(&round(), &[0], &[3.0, 0.0], &settings("stop = { rule = 'maximum_grade' }")).unwrap();
    assert_eq!((outcome.end, outcome.alpha), (UpdateEnd::MaximumBelowTarget, 0.7));
    assert_eq!((outcome.base_version, outcome.trials.len()), (3, 5));
    for trial in &outcome.trials {
        let exact = 3.0 / (1.0 + 8.0 * trial.alpha).sqrt();
        assert_close("trial", &[trial.gamma_max], &[exact], 1e-6);
        assert_eq!(trial.above, usize::from(exact >= 1.25));
    }
    assert_close("after", &outcome.gamma_after, &[3.0 / 6.6_f64.sqrt()], 1e-6);
    assert_close("before", &outcome.gamma_before, &[3.0], 1e-6);
    assert!(outcome.inflations.is_empty());
}

#[test]
fn inflation_follows_the_last_alpha() {
    // 100 atoms at the centroid and one at r: C_batch = r²/101, so α = 1 leaves γ = √101 whatever r.
    let features = [vec![0.0; 200], vec![50.0, 0.0]].concat();
    let target = |target: f64| settings(&format!("stop = {{ rule = 'maximum_grade', target = {target:?} }}"));
    let outcome = update(&round(), &[0; 101], &features, &target(1.5)).unwrap();
    // √101 → half → half: 2.51, then the factor (2.51 / 0.95·1.5)² = 3.11 reaches 1.425.
    assert_eq!((outcome.end, outcome.alpha, outcome.trials.len()), (UpdateEnd::Inflated, 1.0, 6));
    let last = 101.0 / 16.0 / (0.95_f64 * 1.5).powi(2);
    assert_close("factors", &outcome.inflations, &[4.0, 4.0, last], 1e-6);
    assert_close("after", &[outcome.gamma_after[100]], &[0.95 * 1.5], 1e-6);

    let outcome = update(&round(), &[0; 101], &features, &target(1.25)).unwrap();
    assert_eq!((outcome.end, outcome.inflations), (UpdateEnd::InflationExhausted, vec![4.0, 4.0, 4.0]));
    assert_close("after", &[outcome.gamma_after[100]], &[101.0_f64.sqrt() / 8.0], 1e-6);
}

#[test]
fn the_count_rule_falls_back_twice() {
    // Three atoms at r in one direction: γ² = r² / (1 − α + α r²), as for a single one.
    let features = |radius: f64| [[radius, 0.0]; 3].concat();
    let run = |radius: f64, text: &str| {
        let text = format!("alpha_values = [0.05, 0.4, 1.0]\nstop = {{ rule = 'atom_count', {text} }}");
        update(&round(), &[0; 3], &features(radius), &settings(&text)).unwrap()
    };
    // 2 / √(1 + 3·0.4) = 1.35; 1 at α = 1.
    let outcome = run(2.0, "threshold = 1.3");
    assert_eq!((outcome.end, outcome.alpha, outcome.trials[1].above), (UpdateEnd::CountBelowLimit, 1.0, 3));
    // No α brings them below 0.9; the middle one brings them below 1.5.
    let outcome = run(2.0, "threshold = 0.9, target = 1.5");
    assert_eq!((outcome.end, outcome.alpha), (UpdateEnd::FallbackMaximum, 0.4));
    assert_close("after", &outcome.gamma_after, &[2.0 / 2.2_f64.sqrt(); 3], 1e-6);
    let outcome = run(2.0, "threshold = 0.9, target = 0.95");
    assert_eq!((outcome.end, outcome.alpha, outcome.trials.len()), (UpdateEnd::FallbackLast, 1.0, 3));
    assert!(outcome.inflations.is_empty());
}

#[test]
fn outcomes_are_the_same_bits_every_time() {
    let mixture = common::niobium().mixture;
    let features = common::numbers(&common::data("niobium_reference.npz"), "features");
    let elements = vec![1; features.len() / 130];
    let run =
        || update(&mixture, &elements, &features, &settings("stop = { rule = 'maximum_grade' }")).unwrap();
    let (first, second) = (run(), run());
    assert_eq!(first, second);
    let bytes = |outcome: &calm::UpdateOutcome| -> Vec<Vec<u8>> {
        outcome.changed.iter().map(|changed| changed.component.to_bytes()).collect()
    };
    assert_eq!(bytes(&first), bytes(&second));
}

/// Otherwise a walk would offer the structure again after its update.
#[test]
fn an_update_ends_what_made_a_structure_a_candidate() {
    let collection = |text: &str| toml::from_str::<CollectionRule>(text).unwrap();
    let update = |text: &str| toml::from_str::<UpdateRule>(text).unwrap();
    let (largest, count) = ("rule = 'maximum_grade'\n", "rule = 'atom_count'\n");
    for (criterion, target, atoms, expected) in [
        (largest.to_owned(), largest.to_owned(), 54, true),
        (format!("{largest}threshold = 1.2"), largest.to_owned(), 54, false),
        (count.to_owned(), count.to_owned(), 54, true),
        (count.to_owned(), largest.to_owned(), 54, true),
        // One atom above the threshold is a candidate, and two of three may stay there.
        (largest.to_owned(), count.to_owned(), 54, false),
        (count.to_owned(), format!("{count}threshold = 1.4"), 54, false),
        (count.to_owned(), format!("{count}min_atoms = 4"), 8, false),
        (count.to_owned(), format!("{count}min_atoms = 4"), 54, true),
        (count.to_owned(), format!("{count}fraction = 0.2"), 54, false),
    ] {
        let found = update(&target).ends_candidacy(&collection(&criterion), atoms);
        assert_eq!(found, expected, "{criterion} {target} {atoms}");
    }
}
