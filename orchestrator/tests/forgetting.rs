//! The selector notices when updates forget the training data.

use calm::UpdateRule;
use calm::forgetting::ForgettingAlarm;
use calm::rules::MaximumGradeUpdate;
use orchestrator::selector::{OnForgetting, Selector, SelectorSettings, SelectorSnapshot, TrainingFrames};
use store::records::Commit;

use crate::common::{kinds, mixture, positive, try_restore, value};
use crate::decisions::{live, next_candidate};

/// Training frames along one direction.
fn training_frames() -> TrainingFrames {
    let features: Vec<f64> = (0..60).flat_map(|k| [0.0, 0.0, 0.015 * f64::from(k) + 0.09]).collect();
    TrainingFrames::new(&[0; 60], &features, &mixture()).unwrap()
}

/// Settings under which every candidate of [`offer_far_ones`] is accepted.
fn patient() -> SelectorSettings {
    let mut patient = SelectorSettings { max_per_walk: 50, ..live() };
    patient.search.stop = UpdateRule::MaximumGrade(MaximumGradeUpdate { target: positive(2.9) });
    patient
}

/// Offers candidates along another direction than the training frames, each farther than the one before.
fn offer_far_ones(settings: &SelectorSettings, training: Option<TrainingFrames>) -> (Selector, Vec<Commit>) {
    let mut selector = try_restore(settings, 1, training, SelectorSnapshot::default()).unwrap();
    selector.start_walks();
    let far = |number| [0.0, 1.5 * 2_f64.powi(number as i32), 0.0];
    let commits = (1..=8).map(|number| next_candidate(&mut selector, number, number, far(number))).collect();
    (selector, commits)
}

#[test]
fn forgetting_is_recorded_and_raises_an_alarm() {
    assert_eq!(training_frames().original().share_above_one, 0.0);
    let (selector, commits) = offer_far_ones(&patient(), Some(training_frames()));
    let mut alarms = Vec::new();
    for commit in &commits {
        assert_eq!(kinds(commit), ["accepted"]);
        let detail = &commit.decisions[0].detail;
        let alarm = detail["forgetting_alarm"].as_bool().unwrap();
        let watched: serde_json::Value = serde_json::from_str(value(commit, "training_frames")).unwrap();
        assert_eq!(watched["alarm"], alarm);
        let live = &detail["training_frames"];
        for key in ["atoms", "median", "percentile_95", "maximum", "share_above_one"] {
            assert_eq!(live[key], watched[key]);
        }
        let [element] = watched["elements"].as_array().unwrap().as_slice() else { panic!("{watched}") };
        assert_eq!(
            (&element["element"], &element["share_above_one"]),
            (&"Al".into(), &live["share_above_one"])
        );
        assert_eq!(alarm, live["share_above_one"].as_f64().unwrap() > 0.2);
        assert_eq!(
            (&watched["level_of_share"], &watched["level_of_growth"]),
            (&watched["level"], &0.0_f64.into())
        );
        alarms.push(alarm);
    }
    assert!(!alarms[0] && alarms[7], "{alarms:?}");
    assert!(selector.forgetting_level() > 1.0);
}

/// The covariances alone suffice to detect forgetting.
#[test]
fn forgetting_raises_an_alarm_without_training_frames() {
    let limit = ForgettingAlarm { mean_square_growth: positive(1.5), ..ForgettingAlarm::default() };
    let (selector, commits) =
        offer_far_ones(&SelectorSettings { forgetting_alarm: limit, ..patient() }, None);
    let growth: Vec<f64> = commits
        .iter()
        .map(|commit| {
            let detail = &commit.decisions[0].detail;
            assert!(detail["forgetting"]["elements"][0]["share_above_one"].is_null());
            let growth = detail["forgetting"]["elements"][0]["mean_square_growth"].as_f64().unwrap();
            assert_eq!(detail["forgetting_alarm"], growth > 1.5);
            let watched: serde_json::Value = serde_json::from_str(value(commit, "training_frames")).unwrap();
            assert_eq!(
                (&watched["level_of_share"], &watched["level_of_growth"]),
                (&0.0_f64.into(), &watched["level"])
            );
            growth
        })
        .collect();
    assert!(growth[2..].is_sorted() && growth[0] < 1.1 && growth[7] > 2.0, "{growth:?}");
    assert!(selector.forgetting_level() > 1.0);
}

#[test]
fn updates_become_additive_when_the_campaign_asks_for_it() {
    let settings = SelectorSettings { on_forgetting: OnForgetting::Additive, ..patient() };
    let (selector, commits) = offer_far_ones(&settings, Some(training_frames()));
    let switch = commits.iter().position(|commit| kinds(commit).len() > 1).unwrap();
    assert_eq!(kinds(&commits[switch]), ["accepted", "forgetting"]);
    assert_eq!(commits[switch].decisions[0].detail["forgetting_alarm"], true);
    let share =
        |commit: &Commit| commit.decisions[0].detail["training_frames"]["share_above_one"].as_f64().unwrap();
    for (number, commit) in commits.iter().enumerate() {
        // Additive updates take smaller values of α, and nothing shrinks.
        if number > switch {
            assert!(share(commit) <= share(&commits[switch]), "{number}");
            assert_eq!(
                (kinds(commit), value(commit, "additive_updates")),
                (vec!["accepted".to_owned()], "1")
            );
        }
    }
    let (convex, _) = offer_far_ones(&patient(), Some(training_frames()));
    assert!(switch < 7 && selector.forgetting_level() < convex.forgetting_level());
}
