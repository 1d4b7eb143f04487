//! Directories of calculations, and the files that they read.

use std::fs;

use dft::Original;
use store::JobState;
use workers::labeller::{KeepDirectories, LabelBounds, label_structure};

use super::fixture::*;
use crate::common::structure;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn directories_of_failures_are_kept_in_the_store() {
    let script =
        "mkdir deep; echo x > deep/file; head -c 20000000 /dev/zero > large; echo Zr > POTCAR; exit 3";
    for (keep, archives) in
        [(KeepDirectories::Nothing, 0), (KeepDirectories::Failed, 4), (KeepDirectories::All, 4)]
    {
        let mut place = Fixture::new(1, script).await;
        place.running.keep = keep;
        place.work().await;
        let job = place.job().await.job.job;
        let kept = place.store.archives(job).await.unwrap();
        assert_eq!(kept.len(), archives);
        place.nothing_is_left();
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
        place.is_consistent().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_that_is_replaced_between_two_labels_ends_the_labeller() {
    let script = "cat ../data/setup > energy; echo -8.5 > $HERE/new; mv $HERE/new $HERE/setup";
    let place = Fixture::with_setup(2, script, "-7.5\n").await;
    let error = place.labeller().await.ended().await.unwrap_err().to_string();
    let path = place.setup_path().display().to_string();
    let (new, _) = Original::hashed(place.setup_path()).unwrap();
    let [found, expected] = [&new, place.setup.as_ref().unwrap()].map(|original| &original.hash()[..12]);
    let begin = format!(
        "cannot use {path} (its content has changed: BLAKE3 {found}…, where the protocol of the labels has {expected}…;"
    );
    assert!(error.starts_with(&begin), "{error}");
    assert_eq!((place.begun(), place.labels().await[0].label.energy), (1, -7.5));
    let second = async || place.store.queue_show(&place.candidates[1]).await.unwrap();
    let job = second().await;
    assert_eq!((job.job.state, job.job.failures), (JobState::Queued, 0));
    assert_eq!(job.attempts_made[0].calculation, None);
    place.nothing_is_left();
    let once = label_structure(&place.method(), &structure(0.0), &LabelBounds::default())
        .await
        .map(drop)
        .unwrap_err();
    assert_eq!(once.to_string(), error);
    // The file of the protocol comes back.
    fs::write(place.setup_path(), "-7.5\n").unwrap();
    place.work().await;
    assert_eq!((place.begun(), second().await.job.state), (2, JobState::Labelled));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_under_way_has_a_copy_of_its_own() {
    let script = "while [ ! -e $HERE/go ]; do sleep 0.01; done; cat ../data/setup > energy";
    let place = Fixture::with_setup(1, script, "-7.5\n").await;
    let labeller = place.labeller().await;
    place.wait_until_begun(1).await;
    labeller.kill(&place).await;
    fs::write(place.setup_path(), "-8.5\n").unwrap();
    place.go();
    // Who comes next finds it, and has nothing to copy.
    place.work().await;
    assert_eq!((place.begun(), place.labels().await[0].label.energy), (1, -7.5));
    place.nothing_is_left();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn copies_of_files_are_not_kept_in_the_store() {
    let mut place = Fixture::with_setup(1, "cat ../data/setup > energy", "-7.5\n").await;
    place.running.keep = KeepDirectories::All;
    place.work().await;
    let kept = place.store.archives(place.job().await.job.job).await.unwrap();
    assert_eq!(kept[0].left_out, "data/setup (5 bytes)\n");
    let mut unpacked = tar::Archive::new(zstd::Decoder::new(&kept[0].bytes[..]).unwrap());
    let names = unpacked.entries().unwrap().map(|entry| entry.unwrap().path().unwrap().display().to_string());
    let names: Vec<_> = names.collect();
    assert!(
        names.contains(&"work/energy".to_owned()) && !names.iter().any(|name| name.contains("setup")),
        "{names:?}"
    );
    place.nothing_is_left();
}
