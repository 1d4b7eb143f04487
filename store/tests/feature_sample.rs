//! Samples of collected structures for the map of feature space, and lists of candidates with their labels.

use store::{ExportFilter, Fate};
use wire::Origin;
use wire::messages::DeclineReason;

use crate::common::*;

/// Three walks take turns; every second candidate is accepted.
#[tokio::test]
async fn a_sample_is_even_over_decisions_and_walks() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let fate = |k| if k % 2 == 0 { Fate::Accepted } else { Fate::Declined(DeclineReason::Covered) };
    let found = (0..600_u32).map(|k| candidate(k % 3, u64::from(k), Origin::Biased, fate(k)));
    store.commit(&commit_of(found.collect())).await.unwrap();
    let every = 0..i64::MAX;

    let all = store.sampled_decisions(Origin::Biased, every.clone(), 300).await.unwrap();
    assert_eq!((all.total, all.decisions), (300, (1..600).step_by(2).collect()));
    let some = store.sampled_decisions(Origin::Biased, every.clone(), 100).await.unwrap();
    assert!(some.total == 300 && some.decisions.len().abs_diff(100) <= 5, "{some:?}");
    assert!(some.decisions.windows(2).all(|pair| (1..=10).contains(&(pair[1] - pair[0]))), "{some:?}");
    for walk in 0..3 {
        let of_walk = some.decisions.iter().filter(|decision| (**decision - 1) % 3 == walk).count();
        assert!(of_walk.abs_diff(33) <= 4, "walk {walk}: {of_walk}");
    }
    let fewer = store.sampled_decisions(Origin::Biased, every.clone(), 20).await.unwrap();
    assert!(fewer.decisions.len().abs_diff(20) <= 3, "{fewer:?}");
    assert!(
        fewer.decisions.iter().all(|decision| some.decisions.contains(decision)),
        "what is left out stays out"
    );

    let of_one = store.sampled_decisions(Origin::Biased, 1..2, 1000).await.unwrap();
    assert_eq!((of_one.total, of_one.decisions.len()), (100, 100));
    assert!(of_one.decisions.iter().all(|decision| (decision - 1) % 3 == 1));
    for (origin, walks) in [(Origin::Control, every), (Origin::Biased, 7..9)] {
        let none = store.sampled_decisions(origin, walks, 10).await.unwrap();
        assert_eq!((none.total, none.decisions.len()), (0, 0));
    }
}

#[tokio::test]
async fn listed_candidates_come_with_features_grades_and_labels() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let dft = protocol("dft").hash;
    let names = accept(&store, 70).await;
    let declined = candidate(0, 80, Origin::Biased, Fate::Declined(DeclineReason::Covered));
    let control = candidate(1, 80, Origin::Control, Fate::Accepted);
    store.commit(&commit_of(vec![declined, control])).await.unwrap();
    for step in 0..40 {
        let lease = store.lease(dft, "host/a", 0, 10).await.unwrap().unwrap();
        store.complete(&lease, &label(-1.0 - f64::from(step)), 1).await.unwrap();
    }
    // The label of a dropped structure is not used.
    store.drop_job(&names[60], 3).await.unwrap();
    store.import(dft, "old.extxyz", &[(0, structure(61e-6), label(-61.0))], 4).await.unwrap();

    let decisions: Vec<i64> = (1..=72).rev().collect();
    let mut found = store.collected_features(Some(dft), &decisions).await.unwrap();
    found.sort_by_key(|one| one.decision);
    assert!(found.iter().map(|one| one.decision).eq(1..=72), "each once, whatever the lists");
    for one in &found {
        assert_eq!(one.features, Some((0..3 * ATOMS).map(|k| (k as f64).sqrt()).collect()));
        assert_eq!((one.selector.gamma[0], one.original.gamma[0]), (1.3, 1.3 + 0.1));
        assert_eq!(one.label_forces.is_some(), one.decision <= 40, "decision {}", one.decision);
    }
    assert_eq!(found[2].label_forces, Some(label(-3.0).forces));
    assert_eq!(found[2].block.view().id().to_string(), names[2]);
    let without = store.collected_features(None, &[3, 999]).await.unwrap();
    assert!(without.len() == 1 && without[0].label_forces.is_none());
    assert!(store.collected_features(Some(dft), &[]).await.unwrap().is_empty());

    let filter = ExportFilter { protocol: dft, biased: true, control: true, imported: false };
    let expected = store.labelled(&filter, None, 100).await.unwrap();
    let mut listed = store.labelled_candidates(dft, &decisions).await.unwrap();
    listed.sort_by_key(|row| row.cursor);
    assert_eq!(listed.len(), 40);
    for (listed, expected) in listed.iter().zip(&expected) {
        assert_eq!((listed.cursor, &listed.label), (expected.cursor, &expected.label));
        assert_eq!(listed.structure, expected.structure);
    }
}
