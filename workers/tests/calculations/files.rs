//! Directories of calculations and their input files.

use std::fs;

use dft::PinnedFile;
use store::JobState;
use workers::labeller::{KeepDirectories, LabelBounds, label_structure};

use super::fixture::*;
use crate::common::structure;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn directories_of_failures_are_archived() {
    let script =
        "mkdir deep; echo x > deep/file; head -c 20000000 /dev/zero > large; echo Zr > POTCAR; exit 3";
    for (keep, archives) in
        [(KeepDirectories::Nothing, 0), (KeepDirectories::Failed, 4), (KeepDirectories::All, 4)]
    {
        let mut fixture = Fixture::new(1, script).await;
        fixture.running.keep = keep;
        fixture.work().await;
        let job = fixture.job().await.job.job;
        let kept = fixture.store.archives(job).await.unwrap();
        assert_eq!(kept.len(), archives);
        fixture.nothing_is_left();
        let Some(archive) = kept.first() else { continue };
        let left_out = "work/POTCAR (3 bytes)\nwork/large (20000000 bytes)\n";
        assert_eq!((archive.attempt, archive.left_out.as_str()), (1, left_out));
        let mut unpacked = tar::Archive::new(zstd::Decoder::new(&archive.bytes[..]).unwrap());
        let paths = unpacked.entries().unwrap().map(|entry| entry.unwrap().path().unwrap().into_owned());
        let names: Vec<_> = paths.map(|path| path.display().to_string()).collect();
        assert!(
            names.contains(&"work/deep/file".to_owned()) && names.contains(&"end.json".to_owned()),
            "{names:?}"
        );
        fixture.is_consistent().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_that_is_replaced_between_two_labels_ends_the_labeller() {
    let script = "cat ../data/setup > energy; echo -8.5 > $HERE/new; mv $HERE/new $HERE/setup";
    let fixture = Fixture::with_setup(2, script, "-7.5\n").await;
    let error = fixture.labeller().await.ended().await.unwrap_err().to_string();
    let path = fixture.setup_path().display().to_string();
    let (new, _) = PinnedFile::open(fixture.setup_path()).unwrap();
    let [found, expected] = [&new, fixture.setup.as_ref().unwrap()].map(|original| &original.hash()[..12]);
    let begin = format!(
        "cannot use {path} (its content has changed: BLAKE3 {found}…, where the protocol of the labels has {expected}…;"
    );
    assert!(error.starts_with(&begin), "{error}");
    assert_eq!((fixture.begun(), fixture.labels().await[0].label.energy), (1, -7.5));
    let second = async || fixture.store.queue_show(&fixture.candidates[1]).await.unwrap();
    let job = second().await;
    assert_eq!((job.job.state, job.job.failures), (JobState::Queued, 0));
    assert_eq!(job.attempts_made[0].calculation, None);
    fixture.nothing_is_left();
    let once = label_structure(&fixture.method(), &structure(0.0), &LabelBounds::default())
        .await
        .map(drop)
        .unwrap_err();
    assert_eq!(once.to_string(), error);
    // The protocol's file is restored.
    fs::write(fixture.setup_path(), "-7.5\n").unwrap();
    fixture.work().await;
    assert_eq!((fixture.begun(), second().await.job.state), (2, JobState::Labelled));
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_running_calculation_has_its_own_copy() {
    let script = "while [ ! -e $HERE/go ]; do sleep 0.01; done; cat ../data/setup > energy";
    let fixture = Fixture::with_setup(1, script, "-7.5\n").await;
    let labeller = fixture.labeller().await;
    fixture.wait_until_begun(1).await;
    labeller.kill(&fixture).await;
    fs::write(fixture.setup_path(), "-8.5\n").unwrap();
    fixture.release();
    // The next labeller finds it and copies nothing.
    fixture.work().await;
    assert_eq!((fixture.begun(), fixture.labels().await[0].label.energy), (1, -7.5));
    fixture.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn copies_of_files_are_not_archived() {
    let mut fixture = Fixture::with_setup(1, "cat ../data/setup > energy", "-7.5\n").await;
    fixture.running.keep = KeepDirectories::All;
    fixture.work().await;
    let kept = fixture.store.archives(fixture.job().await.job.job).await.unwrap();
    assert_eq!(kept[0].left_out, "data/setup (5 bytes)\n");
    let mut unpacked = tar::Archive::new(zstd::Decoder::new(&kept[0].bytes[..]).unwrap());
    let names = unpacked.entries().unwrap().map(|entry| entry.unwrap().path().unwrap().display().to_string());
    let names: Vec<_> = names.collect();
    assert!(
        names.contains(&"work/energy".to_owned()) && !names.iter().any(|name| name.contains("setup")),
        "{names:?}"
    );
    fixture.nothing_is_left();
}
