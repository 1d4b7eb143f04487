//! Kills and stops labellers, runners and programs.

use std::fs::{self, File, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::time::{Duration, SystemTime};

use store::{JobState, unix_milliseconds};

use super::fixture::*;
use crate::common::{label, protocol};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_calculation_of_a_killed_labeller_is_finished_once() {
    let fixture = Fixture::new(1, WITH_CHILDREN).await;
    for killed in 1..=3 {
        let labeller = fixture.labeller().await;
        until("it is not begun or found", async || {
            let attempts = fixture.attempts().await;
            fixture.begun() == 1 && attempts.len() == killed && attempts.last().unwrap().calculation.is_some()
        })
        .await;
        labeller.kill(&fixture).await;
    }
    fixture.release();
    fixture.work().await;
    let attempts = fixture.attempts().await;
    assert_eq!((fixture.begun(), fixture.labels().await.len()), (1, 1), "{attempts:?}");
    let lost = ("lost", None);
    assert_eq!(outcomes(&attempts), [lost, lost, lost, ("labelled", None)]);
    // The calculation counts once.
    let seconds: Vec<_> = attempts.iter().map(|attempt| attempt.core_seconds).collect();
    assert_eq!(seconds[..3], [Some(0.0); 3]);
    let (_, used) = fixture.store.budget(unix_milliseconds()).await.unwrap();
    assert!((used.core_hours * 3600.0 - seconds[3].unwrap()).abs() < 1e-3, "{used:?}");
    fixture.is_consistent().await;
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_calculation_that_ended_unattended_is_read_and_not_repeated() {
    let fixture = Fixture::new(1, WAITS).await;
    let labeller = fixture.labeller().await;
    fixture.wait_until_begun(1).await;
    labeller.kill(&fixture).await;
    fixture.release();
    until("it does not end", async || fixture.processes().is_empty()).await;
    fixture.work().await;
    assert_eq!((fixture.begun(), fixture.labels().await.len()), (1, 1));
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_calculation_without_a_runner_is_ended_and_started_again() {
    for labeller_lives in [true, false] {
        let fixture = Fixture::new(1, WITH_CHILDREN).await;
        let mut labeller = fixture.labeller().await;
        fixture.wait_until_begun(1).await;
        until("its children do not start", async || fixture.processes().len() >= 3).await;
        if labeller_lives {
            fixture.kill_runner().await;
        } else {
            labeller.kill(&fixture).await;
            fixture.kill_runner().await;
            labeller = fixture.labeller().await;
        }
        fixture.wait_until_begun(2).await;
        fixture.release();
        labeller.ended().await.unwrap();
        assert_eq!((fixture.begun(), fixture.labels().await.len()), (2, 1));
        let attempts = fixture.attempts().await;
        let class = labeller_lives.then_some("node_failure");
        assert_eq!(outcomes(&attempts), [("lost", class), ("labelled", None)]);
        assert_eq!(fixture.job().await.job.failures, 0);
        fixture.nothing_is_left();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_program_counts_as_a_failure_and_is_retried() {
    let fixture = Fixture::new(1, WITH_CHILDREN).await;
    let labeller = fixture.labeller().await;
    fixture.wait_until_begun(1).await;
    let begun = fs::read_to_string(fixture.home.path().join("begun")).unwrap();
    kill(begun.trim().parse().unwrap());
    fixture.wait_until_begun(2).await;
    fixture.release();
    labeller.ended().await.unwrap();
    let attempts = fixture.attempts().await;
    assert_eq!(outcomes(&attempts), [("failed", Some("crashed")), ("labelled", None)]);
    assert_eq!(fixture.labels().await.len(), 1);
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stopped_labeller_ends_the_calculation_after_the_grace_period_and_releases_the_job() {
    let fixture = Fixture::new(1, WITH_CHILDREN).await;
    let grace = Some(Duration::from_millis(300));
    let labeller = fixture.labeller_with(|settings| settings.timing.grace = grace).await;
    fixture.wait_until_begun(1).await;
    labeller.shutdown.stop.cancel();
    labeller.ended().await.unwrap();
    assert_eq!(outcomes(&fixture.attempts().await), [("released", None)]);
    fixture.nothing_is_left();
    // A calculation that may end does so.
    fixture.release();
    let labeller =
        fixture.labeller_with(|settings| settings.timing.grace = Some(Duration::from_secs(60))).await;
    fixture.wait_until_begun(2).await;
    labeller.shutdown.stop.cancel();
    labeller.ended().await.unwrap();
    assert_eq!((fixture.job().await.job.state, fixture.labels().await.len()), (JobState::Labelled, 1));
    fixture.nothing_is_left();
}

/// After the grace period the labeller ends the calculation, because no other labeller may take it over.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stopped_labeller_without_a_grace_period_leaves_the_calculation_to_the_next() {
    let fixture = Fixture::new(1, WITH_CHILDREN).await;
    let labeller = fixture.labeller().await;
    fixture.wait_until_begun(1).await;
    labeller.shutdown.stop.cancel();
    labeller.ended().await.unwrap();
    assert_eq!(outcomes(&fixture.attempts().await), [("released", None)]);
    assert!(!fixture.processes().is_empty());
    fixture.release();
    fixture.work().await;
    assert_eq!((fixture.begun(), fixture.labels().await.len()), (1, 1));
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stopped_labeller_ends_even_if_results_cannot_be_read() {
    for grace in [None, Some(Duration::from_secs(600))] {
        let fixture = Fixture::new(1, "echo -7.5 > energy").await;
        let slow = fixture.home.path().join("slow");
        fs::write(&slow, "").unwrap();
        let labeller = fixture.labeller_with(|settings| settings.timing.grace = grace).await;
        fixture.wait_until_begun(1).await;
        until("it does not end", async || fixture.processes().is_empty()).await;
        labeller.shutdown.stop.cancel();
        labeller.ended().await.unwrap();
        assert_eq!(outcomes(&fixture.attempts().await), [("released", None)]);
        // The next labeller reads the results.
        fs::remove_file(slow).unwrap();
        fixture.work().await;
        assert_eq!((fixture.begun(), fixture.labels().await.len()), (1, 1));
        fixture.nothing_is_left();
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_calculation_whose_result_is_not_needed_is_ended() {
    let fixture = Fixture::new(1, WITH_CHILDREN).await;
    let labeller = fixture.labeller().await;
    fixture.wait_until_begun(1).await;
    let now = unix_milliseconds();
    fixture.store.release_all(&labeller.id, now).await.unwrap();
    let other = fixture.store.lease(protocol("dft").hash, "other", now, 600).await.unwrap().unwrap();
    assert_eq!(other.earlier_calculations.len(), 1);
    fixture.store.complete(&other, &label(-1.0), now).await.unwrap();
    labeller.ended().await.unwrap();
    let labels = fixture.labels().await;
    assert_eq!((labels.len(), labels[0].label.energy), (1, -1.0));
    fixture.nothing_is_left();
}

/// Such as after its directory was given up on another host.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_calculation_whose_directory_is_removed_ends() {
    let fixture = Fixture::new(1, WITH_CHILDREN).await;
    let labeller = fixture.labeller().await;
    fixture.wait_until_begun(1).await;
    until("its children do not start", async || fixture.processes().len() >= 3).await;
    labeller.kill(&fixture).await;
    fixture.directories().iter().for_each(|directory| fs::remove_dir_all(directory).unwrap());
    until("its processes do not end", async || fixture.processes().is_empty()).await;
}

/// A labeller that is killed while it removes a directory leaves a part of it, under another name.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_left_of_a_removal_is_removed_by_the_next_labeller() {
    let fixture = Fixture::new(1, "echo -7.5 > energy").await;
    let campaign = fixture.store.campaign().await.unwrap().id;
    let root = fixture.running.scratch().join(format!("calmwalk-{campaign}-0"));
    let [left, unknown] = ["1-1-0-removed", "1-1-0"].map(|name| root.join(name));
    for directory in [&left, &unknown] {
        fs::create_dir_all(directory.join("work/deep")).unwrap();
        fs::write(directory.join("order.json"), "").unwrap();
        let long_ago = SystemTime::now() - Duration::from_secs(100);
        File::open(directory).unwrap().set_modified(long_ago).unwrap();
    }
    fs::set_permissions(&root, Permissions::from_mode(0o700)).unwrap();
    fixture.work().await;
    // The other one may be a copy's: this campaign knows of no such attempt yet.
    assert_eq!(fixture.directories(), [unknown]);
    assert_eq!(fixture.labels().await.len(), 1);
}
