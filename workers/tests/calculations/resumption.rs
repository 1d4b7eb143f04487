//! Labellers, keepers and programs are killed or stopped.

use std::fs;
use std::time::Duration;

use store::{JobState, unix_milliseconds};

use super::fixture::*;
use crate::common::{label, protocol};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_killed_labeller_began_is_finished_once() {
    let place = Fixture::new(1, WITH_CHILDREN).await;
    for killed in 1..=3 {
        let labeller = place.labeller().await;
        until("it is not begun or found", async || {
            let attempts = place.attempts().await;
            place.begun() == 1 && attempts.len() == killed && attempts.last().unwrap().calculation.is_some()
        })
        .await;
        labeller.kill(&place).await;
    }
    place.go();
    place.work().await;
    let attempts = place.attempts().await;
    assert_eq!((place.begun(), place.labels().await.len()), (1, 1), "{attempts:?}");
    let lost = ("lost", None);
    assert_eq!(outcomes(&attempts), [lost, lost, lost, ("labelled", None)]);
    // The calculation counts once.
    let seconds: Vec<_> = attempts.iter().map(|attempt| attempt.core_seconds).collect();
    assert_eq!(seconds[..3], [Some(0.0); 3]);
    let (_, used) = place.store.budget(unix_milliseconds()).await.unwrap();
    assert!((used.core_hours * 3600.0 - seconds[3].unwrap()).abs() < 1e-3, "{used:?}");
    place.is_consistent().await;
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_ended_while_nobody_waited_is_read_and_not_repeated() {
    let place = Fixture::new(1, WAITS).await;
    let labeller = place.labeller().await;
    place.wait_until_begun(1).await;
    labeller.kill(&place).await;
    place.go();
    until("it does not end", async || place.processes().is_empty()).await;
    place.work().await;
    assert_eq!((place.begun(), place.labels().await.len()), (1, 1));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_left_of_a_calculation_without_a_keeper_is_ended_and_it_begins_again() {
    for labeller_lives in [true, false] {
        let place = Fixture::new(1, WITH_CHILDREN).await;
        let mut labeller = place.labeller().await;
        place.wait_until_begun(1).await;
        until("its children do not start", async || place.processes().len() >= 3).await;
        if labeller_lives {
            place.kill_keeper().await;
        } else {
            labeller.kill(&place).await;
            place.kill_keeper().await;
            labeller = place.labeller().await;
        }
        place.wait_until_begun(2).await;
        place.go();
        labeller.ended().await.unwrap();
        assert_eq!((place.begun(), place.labels().await.len()), (2, 1));
        let attempts = place.attempts().await;
        let class = labeller_lives.then_some("lost_node");
        assert_eq!(outcomes(&attempts), [("lost", class), ("labelled", None)]);
        assert_eq!(place.job().await.job.failures, 0);
        place.nothing_is_left();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_program_is_a_failure_and_tried_again() {
    let place = Fixture::new(1, WITH_CHILDREN).await;
    let labeller = place.labeller().await;
    place.wait_until_begun(1).await;
    let begun = fs::read_to_string(place.home.path().join("begun")).unwrap();
    kill(begun.trim().parse().unwrap());
    place.wait_until_begun(2).await;
    place.go();
    labeller.ended().await.unwrap();
    let attempts = place.attempts().await;
    assert_eq!(outcomes(&attempts), [("failed", Some("crashed")), ("labelled", None)]);
    assert_eq!(place.labels().await.len(), 1);
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_is_stopped_ends_the_calculation_after_the_grace_and_gives_the_label_back() {
    let place = Fixture::new(1, WITH_CHILDREN).await;
    let grace = Some(Duration::from_millis(300));
    let labeller = place.labeller_with(|settings| settings.timing.grace = grace).await;
    place.wait_until_begun(1).await;
    labeller.shutdown.stop();
    labeller.ended().await.unwrap();
    assert_eq!(outcomes(&place.attempts().await), [("released", None)]);
    place.nothing_is_left();
    // One that may end does so.
    place.go();
    let labeller =
        place.labeller_with(|settings| settings.timing.grace = Some(Duration::from_secs(60))).await;
    place.wait_until_begun(2).await;
    labeller.shutdown.stop();
    labeller.ended().await.unwrap();
    assert_eq!((place.job().await.job.state, place.labels().await.len()), (JobState::Labelled, 1));
    place.nothing_is_left();
}

/// Who has a time of grace ends the calculation after it, since nobody may come to take it over.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_is_stopped_without_a_time_of_grace_leaves_the_calculation_to_the_next() {
    let place = Fixture::new(1, WITH_CHILDREN).await;
    let labeller = place.labeller().await;
    place.wait_until_begun(1).await;
    labeller.shutdown.stop();
    labeller.ended().await.unwrap();
    assert_eq!(outcomes(&place.attempts().await), [("released", None)]);
    assert!(!place.processes().is_empty());
    place.go();
    place.work().await;
    assert_eq!((place.begun(), place.labels().await.len()), (1, 1));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_is_stopped_while_results_cannot_be_read_ends_all_the_same() {
    for grace in [None, Some(Duration::from_secs(600))] {
        let place = Fixture::new(1, "echo -7.5 > energy").await;
        let slow = place.home.path().join("slow");
        fs::write(&slow, "").unwrap();
        let labeller = place.labeller_with(|settings| settings.timing.grace = grace).await;
        place.wait_until_begun(1).await;
        until("it does not end", async || place.processes().is_empty()).await;
        labeller.shutdown.stop();
        labeller.ended().await.unwrap();
        assert_eq!(outcomes(&place.attempts().await), [("released", None)]);
        // The next one reads what is there.
        fs::remove_file(slow).unwrap();
        place.work().await;
        assert_eq!((place.begun(), place.labels().await.len()), (1, 1));
        place.nothing_is_left();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_calculation_that_nobody_waits_for_any_more_is_ended() {
    let place = Fixture::new(1, WITH_CHILDREN).await;
    let labeller = place.labeller().await;
    place.wait_until_begun(1).await;
    let now = unix_milliseconds();
    place.store.release_all(&labeller.id, now).await.unwrap();
    let other = place.store.lease(protocol("dft").hash, "other", now, 600).await.unwrap().unwrap();
    assert_eq!(other.earlier_calculations.len(), 1);
    place.store.complete(&other, &label(-1.0), now).await.unwrap();
    labeller.ended().await.unwrap();
    let labels = place.labels().await;
    assert_eq!((labels.len(), labels[0].label.energy), (1, -1.0));
    place.nothing_is_left();
}
