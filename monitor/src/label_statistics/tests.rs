//! What counts once, and what is said of the rest.

use store::{LabelValue, WalkRecord};
use wire::WalkId;

use super::*;
use crate::tests::{FoundStructure, PROTOCOL, begin, biased, find, finish};

/// Walk 0 is biased, walk 1 its control. Both find structure 0, whose label fails, and structures 1 and 2 at step 2. Walk 0 goes back,
/// and finds structure 3 at that step as well. Structure 4 has no partner, and was chosen by value; structure 5 waits.
#[tokio::test]
async fn structures_count_once_and_pairs_have_their_own_atoms() {
    let directory = tempfile::tempdir().unwrap();
    let control = WalkRecord { origin: Origin::Control, partner: Some(WalkId(0)), ..biased(1) };
    let store = begin(directory.path(), vec![biased(0), control]).await;
    let by_control =
        |number: u64| FoundStructure { walk: 1, origin: Origin::Control, ..FoundStructure::new(number) };
    find(&store, FoundStructure::new(0)).await;
    find(&store, by_control(0)).await;
    finish(&store, false).await;
    for found in [
        FoundStructure { step: 2, ..FoundStructure::new(1) },
        FoundStructure { step: 2, ..by_control(2) },
        FoundStructure { step: 2, segment: 1, ..FoundStructure::new(3) },
    ] {
        find(&store, found).await;
        finish(&store, true).await;
    }
    find(&store, FoundStructure::new(4)).await;
    let job = store.queue_list(None, 9, 0).await.unwrap().iter().map(|job| job.job).max().unwrap();
    let value = LabelValue { job, value: 1.0, factors: serde_json::json!({}) };
    assert_eq!(store.set_label_values(&[value]).await.unwrap(), 1);
    finish(&store, true).await;
    find(&store, FoundStructure::new(5)).await;

    let statistics = read(&store, PROTOCOL, None).await.unwrap();
    let without_label = |of: &ErrorsByGrade| of.gamma.bins().iter().map(|bin| bin.unlabelled).sum::<u64>();
    let of_kinds = [&statistics.all, &statistics.biased, &statistics.control].map(without_label);
    assert_eq!(of_kinds, [1, 0, 0], "the structure of both is one of all, and of neither");
    for completion in [&statistics.by_gamma, &statistics.by_expansion] {
        let bins = completion.bins();
        assert_eq!(bins.iter().map(|bin| bin.failed.len()).sum::<usize>(), 1);
        assert_eq!(bins.iter().map(|bin| bin.labelled).sum::<u64>(), 4);
    }
    let compared = statistics.comparison();
    assert_eq!((compared.structures, compared.chosen_by_value, compared.unfinished), (4, 1, 1));
    assert_eq!((compared.pairs.counts.pairs, compared.pairs.counts.same_structure), (1, 1));
    let (matched, pooled) = (&compared.matched.biased, &compared.pooled.biased);
    assert_eq!((matched.structures, matched.sampled_atoms), (1, 1), "the structure found later has no pair");
    assert_eq!((pooled.structures, pooled.sampled_atoms, compared.pooled.all.failed), (3, 3, 1));
    // The stress of the model is 0; of the six components of the labels three are 0.002 eV/Å³.
    let stress = pooled.median_stress.value.unwrap();
    assert!((stress - 0.002 * 0.5_f64.sqrt()).abs() < 1e-12, "{stress}");
    assert!(pooled.median_energy.value.unwrap() < 1e-12 && pooled.median_energy.interval.is_none());
}
