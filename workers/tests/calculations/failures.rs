//! Failures: retries with adjustments, limits, programs that cannot be started.

use std::fs;

use store::JobState;
use workers::labeller::LabellerSettings;

use super::fixture::*;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_failure_gets_its_remedies_with_a_complete_record() {
    let script = "cat remedies; grep -q other_algorithm remedies || exit 3; echo -7.5 > energy";
    let fixture = Fixture::new(1, script).await;
    fixture.work().await;
    let attempts = fixture.attempts().await;
    let failed = ("failed", Some("not_converged"));
    assert_eq!(outcomes(&attempts), [failed, failed, ("labelled", None)]);
    let remedies: Vec<_> = attempts.iter().map(|attempt| attempt.made.remedies.as_deref()).collect();
    assert_eq!(
        remedies,
        [None, Some("more_steps,slower_mixing"), Some("more_steps,slower_mixing,other_algorithm")]
    );
    assert_eq!(
        attempts[1].made.difference.as_deref(),
        Some("remedies: - \nremedies: + more_steps slower_mixing")
    );
    let log = said(attempts[1].log.as_deref());
    assert_eq!(log, "not converged: the script says so\nstdout:\nfirst\nmore_steps slower_mixing");
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_without_a_remedy_fails_and_others_continue() {
    let fixture = Fixture::new(2, "[ $(cat $HERE/begun | wc -l) -gt 4 ] || exit 3; echo -7.5 > energy").await;
    let attempts = |settings: &mut LabellerSettings| settings.attempts = 100;
    fixture.labeller_with(attempts).await.ended().await.unwrap();
    // Three adjustments after the first try.
    let job = fixture.job().await;
    assert_eq!((job.job.state, job.job.attempts), (JobState::Failed, 4));
    let other = fixture.store.queue_show(&fixture.candidates[1]).await.unwrap();
    assert_eq!((other.job.state, other.job.attempts), (JobState::Labelled, 1));
    // Requeued by hand, it starts from the first adjustment.
    fixture.store.retry_job(&fixture.candidates[0], 0).await.unwrap();
    fixture.work().await;
    let job = fixture.job().await;
    assert_eq!((job.job.state, job.job.overruled), (JobState::Labelled, true));
    assert_eq!(job.attempts_made[4].made.remedies, None);
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_time_limit_ends_all_processes_and_is_doubled_once() {
    let mut fixture = Fixture::new(1, "sleep 1000 & setsid sleep 1000 & sleep 1000").await;
    fixture.running.time_limit = 0.4;
    fixture.work().await;
    let attempts = fixture.attempts().await;
    let failed = ("failed", Some("time_limit"));
    assert_eq!(outcomes(&attempts), [failed, failed]);
    assert_eq!(attempts[1].made.remedies.as_deref(), Some("more_time"));
    let seconds: Vec<_> = attempts.iter().map(|attempt| attempt.core_seconds.unwrap() / 3.0).collect();
    assert!(seconds[0] >= 0.4 && seconds[1] >= 0.8, "{seconds:?}");
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn processes_are_asked_to_end_before_they_are_killed() {
    let script = "trap 'echo asked >> $HERE/asked' TERM; while true; do sleep 1000; done";
    let mut fixture = Fixture::new(1, script).await;
    fixture.running.time_limit = 0.4;
    fixture.work().await;
    assert_eq!(outcomes(&fixture.attempts().await), [("failed", Some("time_limit")); 2]);
    assert_eq!(fs::read_to_string(fixture.home.path().join("asked")).unwrap(), "asked\nasked\n");
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_memory_limit_applies_to_all_processes_together() {
    // `tail` buffers a line that never ends; two of them need twice as much memory.
    let hungry = "head -c 60000000 /dev/zero | tail -n 1 | { sleep 2; cat > /dev/null; }";
    let mut fixture = Fixture::new(1, &format!("({hungry}) & ({hungry}) & wait; echo -7.5 > energy")).await;
    fixture.running.memory = Some(0.09);
    fixture.work().await;
    let attempts = fixture.attempts().await;
    assert_eq!(outcomes(&attempts), [("failed", Some("out_of_memory")), ("labelled", None)]);
    assert_eq!(attempts[1].made.remedies.as_deref(), Some("more_memory"));
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_program_that_cannot_be_started_fails_the_labeller_not_the_job() {
    let mut fixture = Fixture::new(1, "").await;
    fixture.script = "no-such-program at all".to_owned();
    let error = fixture.labeller().await.ended().await.unwrap_err();
    assert!(error.to_string().contains("cannot use no-such-program"), "{error}");
    let job = fixture.job().await;
    assert_eq!((job.job.state, job.job.failures), (JobState::Queued, 0));
    fixture.script = "echo -7.5 > energy".to_owned();
    fixture.work().await;
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn another_version_of_a_program_fails_the_labeller_not_the_job() {
    let mut fixture = Fixture::new(1, "exit 4").await;
    let error = fixture.labeller().await.ended().await.unwrap_err();
    assert_eq!(error.to_string(), "cannot use sh (calculated by script 2, and not 1)");
    let job = fixture.job().await;
    assert_eq!((job.job.state, job.job.failures), (JobState::Queued, 0));
    fixture.script = "echo -7.5 > energy".to_owned();
    fixture.work().await;
    fixture.nothing_is_left();
}
