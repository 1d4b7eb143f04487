//! Kills a process that commits, labels and registers versions of the potential in a loop, at random times: everything
//! that it reported as committed is stored, and everything else is stored completely or not at all.

use std::env;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

use store::{
    CampaignLock, Commit, CompleteOutcome, ComponentRecord, ExportFilter, Fate, JobState, Store, StoreError,
    VersionState,
};
use wire::Origin;
use wire::messages::DeclineReason;

use crate::common::*;
use crate::version_records::{version_files, version_record};

const KILLS: u64 = 20;
const DIRECTORY: &str = "STORE_CRASH_TEST_DIRECTORY";
const LIMIT: u32 = 3;

/// Commit `k`, from 1: three candidates, a component, a walk and a value that all contain `k`.
fn numbered_commit(k: u64) -> Commit {
    let mut commit = commit_of(vec![
        candidate(0, 3 * k, Origin::Biased, Fate::Accepted),
        candidate(0, 3 * k + 1, Origin::Biased, Fate::Declined(DeclineReason::Covered)),
        candidate(0, 3 * k + 2, Origin::Biased, Fate::Accepted),
    ]);
    commit.components = vec![ComponentRecord { element: 0, slot: 0, bytes: k.to_le_bytes().to_vec() }];
    commit.walks = vec![walk(0, k)];
    commit.values = vec![("commits".into(), k.to_string())];
    commit
}

async fn commits(store: &Store) -> u64 {
    let values = store.values().await.unwrap();
    values.iter().find(|(name, _)| name == "commits").map_or(0, |(_, value)| value.parse().unwrap())
}

/// The process to kill: restart is the same command as start.
async fn work(directory: &Path) {
    let _lock = CampaignLock::acquire(directory, "crash test").unwrap();
    let store = match Store::open(directory).await {
        Err(StoreError::Missing { .. }) => create(directory).await,
        opened => opened.unwrap(),
    };
    store.add_protocol(&protocol("dft"), 0).await.unwrap();
    store.release_leases_of_dead_processes(0).await.unwrap();
    let mut next = commits(&store).await + 1;
    let mut version = store.versions().await.unwrap().len() as u32 + 1;
    loop {
        store.commit(&numbered_commit(next)).await.unwrap();
        tell("committed", next);
        let record = version_record(version, version - 1, VersionState::Registered);
        store.add_version(&record, Some(&version_files(version))).await.unwrap();
        tell("registered", u64::from(version));
        version += 1;
        for _ in 0..2 {
            let lease = store.lease(protocol("dft").hash, "host/a", 0, 10).await.unwrap().unwrap();
            if lease.job % 5 == 0 {
                store.fail(&lease, "class", "log", LIMIT, 0).await.unwrap();
                continue;
            }
            let completed = store.complete(&lease, &label(-1.0), 0).await.unwrap();
            assert_eq!(completed, CompleteOutcome::Label);
            tell("labelled", lease.job as u64);
        }
        next += 1;
    }
}

fn tell(what: &str, number: u64) {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{what} {number}").unwrap();
    out.flush().unwrap();
}

fn start(directory: &Path) -> Child {
    Command::new(env::current_exe().unwrap())
        .args(["--exact", "crash::a_killed_process_leaves_complete_commits", "--nocapture"])
        .env(DIRECTORY, directory)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap()
}

/// What a killed process reported: its last commit, the jobs that it labelled, and the last version that it registered.
struct Reported {
    committed: u64,
    labelled: Vec<u64>,
    registered: u64,
}

/// Kills the process `delay` after its start, or after its first commit.
fn kill(mut child: Child, after_first_commit: bool, delay: Duration) -> Reported {
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map(Result::unwrap);
    let mut reported = Reported { committed: 0, labelled: Vec::new(), registered: 0 };
    let mut hear = |line: String| {
        // The test harness writes to the same stream, without a newline before our output.
        let number = |word: &str| line.rsplit_once(word).and_then(|(_, number)| number.trim().parse().ok());
        reported.committed = number("committed ").unwrap_or(reported.committed);
        reported.labelled.extend(number("labelled "));
        reported.registered = number("registered ").unwrap_or(reported.registered);
        reported.committed > 0
    };
    if after_first_commit {
        while !hear(lines.next().expect("it commits")) {}
    }
    thread::sleep(delay);
    child.kill().unwrap();
    assert!(!child.wait().unwrap().success());
    for line in lines {
        hear(line);
    }
    reported
}

async fn check(store: &Store, reported: &Reported) -> u64 {
    let Reported { committed, labelled, registered } = reported;
    let k = commits(store).await;
    assert!(k >= *committed, "commit {committed} was safe, {k} is the last");
    // Every commit is complete.
    let text = store.decision_log_text().await.unwrap();
    let mut expected = String::new();
    for (n, candidate) in (1..=k).flat_map(|k| numbered_commit(k).candidates).enumerate() {
        let id = name_of(&candidate);
        let stored = store.candidate(&id).await.unwrap().unwrap();
        assert_eq!((stored.decision, stored.fate), (n as i64 + 1, candidate.fate));
        expected += &format!("{} {id}\n", n + 1);
    }
    let short = text.lines().map(|line| {
        let line: serde_json::Value = serde_json::from_str(line).unwrap();
        format!("{} {}\n", line["sequence"], line["candidate"].as_str().unwrap())
    });
    assert_eq!(short.collect::<String>(), expected);
    if k > 0 {
        assert_eq!(store.load_components().await.unwrap(), numbered_commit(k).components);
        assert_eq!(store.load_walks().await.unwrap(), numbered_commit(k).walks);
    }

    // One job for every accepted candidate; labels exactly for the labelled ones.
    let mut jobs = store.queue_list(None, u32::MAX, 0).await.unwrap();
    jobs.sort_by_key(|job| job.job);
    let accepted = (1..=k).flat_map(|k| {
        let [first, _, second] = numbered_commit(k).candidates.try_into().unwrap();
        [name_of(&first), name_of(&second)]
    });
    assert_eq!(
        jobs.iter().map(|job| job.candidate.clone()).collect::<Vec<_>>(),
        accepted.collect::<Vec<_>>()
    );
    let mut done = 0;
    for job in &jobs {
        let details = store.queue_show(&job.candidate).await.unwrap();
        let under_way = details.attempts_made.iter().filter(|attempt| attempt.outcome.is_none()).count();
        assert_eq!(under_way, usize::from(job.state == JobState::Leased));
        assert_eq!(details.attempts_made.len() as u32, job.attempts);
        assert_eq!(details.energies.len(), usize::from(job.state == JobState::Labelled));
        done += details.energies.len();
    }
    let is_labelled = |job: &u64| jobs[*job as usize - 1].state == JobState::Labelled;
    assert!(labelled.iter().all(is_labelled));
    let versions = store.versions().await.unwrap();
    assert!(versions.len() as u64 >= *registered);
    for (record, number) in versions.iter().zip(1..) {
        assert_eq!(*record, version_record(number, number - 1, VersionState::Registered));
        assert_eq!(store.version_files(number).await.unwrap(), Some(version_files(number)));
    }
    let filter = ExportFilter { protocol: protocol("dft").hash, biased: true, control: true, imported: true };
    assert_eq!(store.labelled(&filter, None, u32::MAX).await.unwrap().len(), done);
    k
}

#[test]
fn a_killed_process_leaves_complete_commits() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    if let Some(directory) = env::var_os(DIRECTORY) {
        runtime.block_on(work(directory.as_ref()));
    }
    let directory = tempfile::tempdir().unwrap();
    let mut last = 0;
    for kill_number in 0..KILLS {
        // While it creates or opens the campaign and while it works, at times spread over 60 ms.
        let delay = Duration::from_millis(kill_number * 37 % 60);
        let reported = kill(start(directory.path()), kill_number % 2 == 1, delay);
        drop(CampaignLock::acquire(directory.path(), "check").expect("free, for its holder is dead"));
        let store = match runtime.block_on(Store::open(directory.path())) {
            Err(StoreError::Missing { .. }) if last == 0 && reported.committed == 0 => continue,
            opened => opened.unwrap(),
        };
        if runtime.block_on(store.protocols()).unwrap().is_empty() {
            continue;
        }
        let now = runtime.block_on(check(&store, &reported));
        assert!(now >= last);
        last = now;
        runtime.block_on(store.close());
    }
    assert!(last >= KILLS / 2, "every second process committed something: {last} commits");
    eprintln!("{KILLS} kills, {last} commits, all whole");
}
