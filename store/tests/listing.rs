//! Pages of the candidates of one walk, and of those with one state of their label job.

use serde_json::json;
use store::{
    CandidateRecord, Fate, JobState, ListCursor, ListLimits, ListOrder, ListedCandidate, NewProtocol,
    RelabelRequest, Store, StoreError,
};
use wire::messages::DeclineReason;
use wire::{Candidate, CandidateBlock, CandidateId, ContentHash, Origin, WalkId};

use crate::common::*;

/// Decisions on candidates of a walk, read in pages of `limit`.
async fn decisions(store: &Store, walk: u32, descending: bool, limit: u32) -> Vec<i64> {
    let mut found: Vec<ListedCandidate> = Vec::new();
    loop {
        let after = found.last().map(|last| last.decision);
        let page = store.list_decided_of_walk(walk, descending, after, limit).await.unwrap();
        assert!(page.len() <= limit as usize && page.iter().all(|row| row.walk == walk));
        if page.is_empty() {
            return found.into_iter().map(|row| row.decision).collect();
        }
        found.extend(page);
    }
}

/// Names and decisions have different orders, and the name of walk 1 begins as that of walk 11.
#[tokio::test]
async fn candidates_of_a_walk_come_in_decision_order() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let declined = Fate::Declined(DeclineReason::Covered);
    for step in [90, 200, 1000] {
        let records = [1, 11, 2].map(|walk| {
            let fate = if walk == 1 && step == 200 { declined } else { Fate::Accepted };
            candidate(walk, step, Origin::Biased, fate)
        });
        store.commit(&commit_of(records.to_vec())).await.unwrap();
    }
    for limit in [1, 2, 10] {
        assert_eq!(decisions(&store, 1, false, limit).await, [1, 4, 7]);
        assert_eq!(decisions(&store, 11, true, limit).await, [8, 5, 2]);
        assert!(decisions(&store, 5, true, limit).await.is_empty());
    }
    let all = store.list_decided_of_walk(1, true, None, 9).await.unwrap();
    let fates: Vec<_> =
        all.iter().map(|row| (row.step, row.fate.as_str(), row.job_state.as_deref())).collect();
    assert_eq!(
        fates,
        [(1000, "accepted", Some("queued")), (200, "covered", None), (90, "accepted", Some("queued"))]
    );
}

/// The same structure, found by the control walk 9.
fn found_again(found: &CandidateRecord) -> CandidateRecord {
    let first = found.block.view().to_candidate();
    let id = CandidateId { walk: WalkId(9), ..first.id };
    let block = CandidateBlock::encode(&Candidate { id, origin: Origin::Control, ..first });
    CandidateRecord { block, priority: 0, ..found.clone() }
}

/// Label jobs in all states. Every second structure has two candidates, some have jobs of two protocols, and some grades are equal.
async fn in_all_states(store: &Store) {
    let mut names = Vec::new();
    for step in 1..=16 {
        let mut found = candidate(0, step, Origin::Biased, Fate::Accepted);
        found.original.gamma[0] = 1.0 + 0.1 * (7 * step % 5) as f64;
        names.push(name_of(&found));
        let declined = candidate(1, step, Origin::Biased, Fate::Declined(DeclineReason::Covered));
        let again = (step % 2 == 0).then(|| found_again(&found));
        let records = [found, declined].into_iter().chain(again).collect();
        store.commit(&commit_of(records)).await.unwrap();
    }
    for step in 1..=4 {
        let lease = store.lease(protocol("dft").hash, "host/a", 0, 10).await.unwrap().unwrap();
        store.complete(&lease, &label(-f64::from(step)), 1).await.unwrap();
    }
    let again = [1, 2].map(|step| ContentHash::from_structure(&structure(1e-6 * f64::from(step))));
    let (fine, changes) = (protocol("fine"), [json!({ "key": "label.protocol" })]);
    let new = NewProtocol { protocol: &fine, configuration: "{}", changes: &changes, notes: &[] };
    let order =
        RelabelRequest { structures: &again, include_current: false, reason: "cutoff", protocol: Some(new) };
    store.relabel(&order, 2).await.unwrap();
    for attempt in 0..8 {
        let lease = store.lease(fine.hash, "host/a", 3, 10).await.unwrap().unwrap();
        match attempt {
            0..3 => drop(store.complete(&lease, &label(-9.0), 4).await.unwrap()),
            3..6 => drop(store.fail(&lease, "timeout", "", 1, 4).await.unwrap()),
            _ => {}
        }
    }
    for name in &names[12..14] {
        store.drop_job(name, 5).await.unwrap();
    }
}

/// Decisions on all candidates of an order, read by `page` from a cursor on.
async fn in_pages(
    order: ListOrder,
    page: impl AsyncFn(Option<ListCursor>) -> Result<Vec<ListedCandidate>, StoreError>,
) -> Vec<i64> {
    let (mut found, mut after) = (Vec::new(), None);
    loop {
        let page = page(after).await.unwrap();
        let Some(last) = page.last() else { return found };
        let value = match order {
            ListOrder::Decision => None,
            ListOrder::Gamma => last.gamma,
            ListOrder::Volume => last.relative_volume,
        };
        after = Some(ListCursor { priority: 0, value: value.unwrap_or_default(), decision: last.decision });
        found.extend(page.iter().map(|row| row.decision));
    }
}

/// Decisions on the candidates of a state, read in pages of `limit`.
async fn of_state(
    store: &Store,
    state: JobState,
    origin: Option<&str>,
    order: (ListOrder, bool),
    limit: u32,
) -> Vec<i64> {
    in_pages(order.0, async |after| store.list_state(state, origin, order, after, limit).await).await
}

#[tokio::test]
async fn candidates_of_a_state_are_those_of_all_with_that_state() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    in_all_states(&store).await;
    let mut numbers = Vec::new();
    for order in [ListOrder::Decision, ListOrder::Gamma, ListOrder::Volume] {
        for order in [(order, true), (order, false)] {
            let all = store.list_candidates(order.0, order.1, None, 99).await.unwrap();
            for (state, origin) in
                JobState::ALL.into_iter().flat_map(|state| [None, Some("control")].map(|one| (state, one)))
            {
                let has = |row: &&ListedCandidate| {
                    row.job_state.as_deref() == Some(state.name())
                        && origin.is_none_or(|wanted| row.origin == wanted)
                };
                let expected: Vec<_> = all.iter().filter(has).map(|row| row.decision).collect();
                for limit in [1, 3, 99] {
                    let found = of_state(&store, state, origin, order, limit).await;
                    assert_eq!(found, expected, "{state:?} {origin:?} {order:?} by {limit}");
                }
                numbers.push(expected.len());
            }
        }
    }
    // Queued, leased, labelled, failed, dropped, superseded; each of both origins, then of control walks.
    assert_eq!(numbers[..12], [6, 2, 3, 1, 7, 2, 5, 2, 3, 1, 0, 0]);
    assert!(store.has_more_jobs(JobState::Failed, 2).await.unwrap());
    assert!(!store.has_more_jobs(JobState::Failed, 3).await.unwrap());
}

#[tokio::test]
async fn candidates_within_limits_are_those_of_all_within_them() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    in_all_states(&store).await;
    let mut numbers = Vec::new();
    for (gamma, relative_volume) in [
        ([Some(1.2), None], [None; 2]),
        ([None, Some(1.2)], [None; 2]),
        ([Some(1.1), Some(1.3)], [Some(1.01), None]),
        ([None; 2], [None, Some(1.0)]),
    ] {
        let is_within = |value: Option<f64>, [low, high]: [Option<f64>; 2]| {
            value.is_some_and(|value| {
                low.is_none_or(|low| value >= low) && high.is_none_or(|high| value <= high)
            })
        };
        for (fate, descending) in [None, Some(("control", None)), Some(("biased", Some("covered")))]
            .into_iter()
            .flat_map(|fate| [(fate, true), (fate, false)])
        {
            let all = store.list_candidates(ListOrder::Decision, descending, None, 99).await.unwrap();
            assert_eq!(store.newest_candidate().await.unwrap(), all.len() as i64);
            let has = |row: &&ListedCandidate| {
                (5..30).contains(&row.decision)
                    && is_within(row.gamma, gamma)
                    && is_within(row.relative_volume, relative_volume)
                    && fate.is_none_or(|(origin, reason)| {
                        row.origin == origin && row.fate == reason.unwrap_or("accepted")
                    })
            };
            let expected: Vec<_> = all.iter().filter(has).map(|row| row.decision).take(6).collect();
            let limits = ListLimits { gamma, relative_volume };
            let found = store.list_within(5..30, limits, fate, descending, 6).await.unwrap();
            let found: Vec<_> = found.iter().map(|row| row.decision).collect();
            assert_eq!(found, expected, "{limits:?} {fate:?} {descending}");
            numbers.push(found.len());
        }
    }
    assert!(numbers[..18].iter().filter(|number| **number > 0).count() > 12, "{numbers:?}");
    assert!(numbers[18..].iter().all(|number| *number == 0), "{numbers:?}");
}

/// Thousands of candidates with jobs, and then as many without.
#[tokio::test]
async fn candidates_of_a_state_with_many_jobs_are_found_near_and_far() {
    let database = TestDatabase::new();
    let store = database.create().await.with_caller_clock();
    for (walk, fate) in [(0, Fate::Accepted), (1, Fate::Declined(DeclineReason::Covered))] {
        let records = (1..=4100).map(|step| {
            let mut found = candidate(walk, step, Origin::Biased, fate);
            found.original.gamma[0] = 1.0 + 0.001 * (7 * step % 1000) as f64;
            found
        });
        store.commit(&commit_of(records.collect())).await.unwrap();
    }
    assert!(store.has_more_jobs(JobState::Queued, 4000).await.unwrap());
    for order in [ListOrder::Decision, ListOrder::Gamma, ListOrder::Volume] {
        for order in [(order, true), (order, false)] {
            let all = store.list_candidates(order.0, order.1, None, 9999).await.unwrap();
            for start in [0, 999, 2500, 4000] {
                let after = all[..start].last().map(|row| ListCursor {
                    priority: 0,
                    value: if order.0 == ListOrder::Gamma { row.gamma } else { row.relative_volume }.unwrap(),
                    decision: row.decision,
                });
                let queued = all[start..].iter().filter(|row| row.job_state.is_some()).take(200);
                let found = store.list_state(JobState::Queued, None, order, after, 200).await.unwrap();
                assert!(found.iter().eq(queued), "{order:?} from {start}");
            }
        }
    }
}

/// γ₀_max and V/V₀ of candidates by step: not known, not finite, and equal ones.
const VALUES: [(Option<f64>, Option<f64>); 12] = [
    (Some(1.5), Some(1.1)),
    (None, Some(1.2)),
    (Some(1.5), None),
    (Some(2.0), Some(0.9)),
    (None, None),
    (Some(f64::INFINITY), Some(1.1)),
    (Some(0.5), Some(f64::INFINITY)),
    (Some(1.5), Some(1.1)),
    (None, Some(1.0)),
    (Some(2.5), Some(1.2)),
    (Some(1.0), None),
    (Some(2.0), Some(1.3)),
];

/// Candidates with these values, of which every second has a job.
async fn with_missing_values(store: &Store) {
    for (step, (gamma, volume)) in (1..).zip(VALUES) {
        let declined = Fate::Declined(DeclineReason::Covered);
        let fate = if step % 2 == 1 { Fate::Accepted } else { declined };
        let mut found = candidate(0, step, Origin::Biased, fate);
        found.original.gamma = match gamma {
            Some(gamma) => vec![gamma, 0.1],
            // Without grades, or with unknown ones.
            None if step == 2 => Vec::new(),
            None => vec![f64::NAN; ATOMS],
        };
        found.original.gamma_nbr.truncate(found.original.gamma.len());
        let block = found.block.view().to_candidate();
        let relative_volume = volume.unwrap_or(f64::NAN);
        found.block = CandidateBlock::encode(&Candidate { relative_volume, ..block });
        store.commit(&commit_of(vec![found])).await.unwrap();
    }
}

/// An order has those with a finite value, in both directions; pages may begin and end anywhere, also between equal values.
#[tokio::test]
async fn orders_leave_out_candidates_without_a_value() {
    let database = TestDatabase::new();
    let store = database.create().await;
    with_missing_values(&store).await;
    for (order, value) in [
        (ListOrder::Gamma, VALUES.map(|(gamma, _)| gamma)),
        (ListOrder::Volume, VALUES.map(|(_, volume)| volume)),
    ] {
        let known =
            (1_i64..).zip(value).filter_map(|(place, value)| Some((value.filter(|x| x.is_finite())?, place)));
        let mut sorted: Vec<_> = known.collect();
        sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for descending in [false, true] {
            let expected: Vec<i64> = match descending {
                true => sorted.iter().rev().map(|(_, place)| *place).collect(),
                false => sorted.iter().map(|(_, place)| *place).collect(),
            };
            let queued: Vec<_> = expected.iter().copied().filter(|place| place % 2 == 1).collect();
            assert!(expected.len() == 8 && !queued.is_empty());
            for limit in [1, 2, 3, 8, 99] {
                let read = async |after| store.list_candidates(order, descending, after, limit).await;
                assert_eq!(in_pages(order, read).await, expected, "{order:?} {descending} by {limit}");
                let found = of_state(&store, JobState::Queued, None, (order, descending), limit).await;
                assert_eq!(found, queued, "{order:?} {descending} by {limit}");
            }
        }
    }
    // Decisions have all.
    let read = async |after| store.list_candidates(ListOrder::Decision, true, after, 5).await;
    assert_eq!(in_pages(ListOrder::Decision, read).await, (1..=12).rev().collect::<Vec<_>>());
}

/// Candidates without a value are outside of its limits, and limits of the other value do not concern them.
#[tokio::test]
async fn candidates_without_a_value_are_outside_of_its_limits() {
    let database = TestDatabase::new();
    let store = database.create().await;
    with_missing_values(&store).await;
    for (gamma, relative_volume, expected) in [
        ([Some(0.0), None], [None; 2], &[1, 3, 4, 6, 7, 8, 10, 11, 12][..]),
        ([None, Some(1.5)], [None; 2], &[1, 3, 7, 8, 11]),
        ([None; 2], [Some(1.1), Some(1.2)], &[1, 2, 6, 8, 10]),
        ([None; 2], [Some(0.0), None], &[1, 2, 4, 6, 7, 8, 9, 10, 12]),
        ([Some(1.5), Some(1.5)], [Some(1.0), None], &[1, 8]),
    ] {
        let limits = ListLimits { gamma, relative_volume };
        for fate in [None, Some(("biased", None)), Some(("biased", Some("covered"))), Some(("control", None))]
        {
            let of_fate = |place: &i64| match fate {
                None => true,
                Some(("biased", None)) => place % 2 == 1,
                Some((origin, _)) => origin == "biased" && place % 2 == 0,
            };
            let expected: Vec<_> = expected.iter().copied().filter(of_fate).collect();
            let number = store.candidates_of_fate("biased", Some("covered")).await.unwrap();
            assert_eq!(number, Some(6));
            for limit in [1, 2, 99] {
                let upwards = async |after: Option<ListCursor>| {
                    let begin = after.map_or(1, |place| place.decision + 1);
                    store.list_within(begin..13, limits, fate, false, limit).await
                };
                let found = in_pages(ListOrder::Decision, upwards).await;
                assert_eq!(found, expected, "{limits:?} {fate:?} by {limit}");
                let downwards = async |after: Option<ListCursor>| {
                    let end = after.map_or(13, |place| place.decision);
                    store.list_within(1..end, limits, fate, true, limit).await
                };
                let mut found = in_pages(ListOrder::Decision, downwards).await;
                found.reverse();
                assert_eq!(found, expected, "{limits:?} {fate:?} by {limit}, downwards");
            }
        }
    }
}
