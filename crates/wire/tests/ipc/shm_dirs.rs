//! Concurrent campaigns, and the files of each.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use wire::ipc::{Sizes, space_needed};
use wire::shm_dir::{ShmDir, ShmDirError};

use super::process::Role;
use super::test_server::{TestServer, files_of};

#[tokio::test(flavor = "multi_thread")]
async fn two_campaigns_do_not_see_each_other() {
    let directories = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let [mut here, mut there] =
        directories.each_ref().map(|directory| TestServer::open(directory.path(), 1, 1 << 16));
    let mut walkers = [&here, &there].map(|server| server.start(0, 1, Role::Walker));
    let (mut first, mut second) = (here.offer().await, there.offer().await);
    for number in 1..20 {
        first = here.go_on(first, number, (3, 4)).await;
        second = there.go_on(second, number + 100, (4, 3)).await;
    }
    // The end of one campaign does not affect the other.
    first.reply.send(None).unwrap();
    assert!(walkers[0].wait().unwrap().success());
    assert_eq!(here.handle.traffic().rejected, 0);
    here.close().await;
    second = there.go_on(second, 200, (4, 3)).await;
    second.reply.send(None).unwrap();
    assert!(walkers[1].wait().unwrap().success());
    assert_eq!(there.handle.traffic().rejected, 0);
    there.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn all_files_are_private_and_in_the_campaign_directory() {
    let directory = tempfile::tempdir().unwrap();
    let elsewhere = || ["/tmp/iceoryx2", "/dev/shm/iox2_"].map(|path| Path::new(path).exists());
    let before = elsewhere();
    let mut server = TestServer::open(directory.path(), 1, 1 << 16);
    let mut walker = server.start(0, 1, Role::Walker);
    let offer = server.offer().await;
    let offer = server.go_on(offer, 1, (3, 4)).await;

    let place = server.place.clone();
    assert_eq!(place.campaign_directory(), Some(directory.path().canonicalize().unwrap().as_path()));
    assert!(ShmDir::all().unwrap().contains(&place));
    let home = place.directory().parent().unwrap();
    for directory in [home, place.directory()] {
        assert_eq!(directory.metadata().unwrap().mode() & 0o777, 0o700, "{}", directory.display());
    }
    let segments: Vec<_> = files_of(&place).into_iter().filter(|name| !name.starts_with('/')).collect();
    assert!(segments.len() > 8, "{segments:?}");
    for name in segments {
        let file = Path::new("/dev/shm").join(&name).symlink_metadata().unwrap();
        assert_eq!(file.mode() & 0o077, 0, "{name} has mode {:o}", file.mode());
    }
    assert_eq!(elsewhere(), before);

    offer.reply.send(None).unwrap();
    assert!(walker.wait().unwrap().success());
    server.close().await;
    assert!(!ShmDir::all().unwrap().contains(&place));
}

/// With sparse segments, a write could kill the process.
#[tokio::test(flavor = "multi_thread")]
async fn memory_is_reserved_and_no_more_than_was_asked_for() {
    let directory = tempfile::tempdir().unwrap();
    let sizes = Sizes { walkers: 2, message_bytes: 1 << 20 };
    let mut server = TestServer::open(directory.path(), sizes.walkers, sizes.message_bytes);
    let mut walkers = [0, 1].map(|walker| server.start(walker, 1, Role::Walker));
    let offers = [server.offer().await, server.offer().await];

    let mut bytes = 0;
    for name in files_of(&server.place).into_iter().filter(|name| !name.starts_with('/')) {
        let file = Path::new("/dev/shm").join(&name).symlink_metadata().unwrap();
        assert!(
            512 * file.blocks() >= file.len(),
            "{name}: {} bytes reserved of {}",
            512 * file.blocks(),
            file.len()
        );
        bytes += 512 * file.blocks();
    }
    // Ten reports of each walker, seven answers.
    let messages = 27 * sizes.message_bytes as u64;
    assert!(
        messages < bytes && bytes < space_needed(&sizes),
        "{messages} < {bytes} < {}",
        space_needed(&sizes)
    );

    for offer in offers {
        offer.reply.send(None).unwrap();
    }
    assert!(walkers.iter_mut().all(|walker| walker.wait().unwrap().success()));
    server.close().await;
}

#[test]
fn lack_of_space_is_reported_before_anything_is_created() {
    let directory = tempfile::tempdir().unwrap();
    let place = ShmDir::for_campaign(directory.path()).unwrap();
    let error = place.prepare(u64::MAX).unwrap_err();
    assert!(matches!(error, ShmDirError::Space { needed: u64::MAX, free } if free > 0));
    assert!(error.to_string().contains("enlarge /dev/shm"), "{error}");
    assert_eq!(files_of(&place), Vec::<String>::new());
}

#[test]
fn directories_are_cleaned_before_and_after_use() {
    let directory = tempfile::tempdir().unwrap();
    let place = ShmDir::for_campaign(directory.path()).unwrap();
    place.prepare(0).unwrap();
    fs::create_dir(place.directory().join("deep")).unwrap();
    fs::write(place.directory().join("deep/left"), [1; 10_000]).unwrap();
    let segment = Path::new("/dev/shm").join(format!("{}left", place.prefix()));
    fs::write(&segment, [1; 5_000]).unwrap();

    let removed = place.prepare(0).unwrap().removed;
    // Includes the file with the path of the campaign.
    assert_eq!((removed.files, removed.bytes), (3, 12_288 + 8_192 + 4_096));
    fs::write(&segment, b"again").unwrap();
    fs::remove_dir_all(place.directory()).unwrap();
    assert!(
        ShmDir::all().unwrap().iter().any(|other| other.directory() == place.directory()),
        "without directory"
    );
    assert_eq!(place.remove().unwrap().files, 1);
    assert_eq!(files_of(&place), Vec::<String>::new());
    assert_eq!(place.remove().unwrap(), wire::shm_dir::Removed::default());
}

/// Even if its campaign is unknown: the `campaign` file is not yet written, or its path does not exist here.
#[test]
fn directories_in_use_are_not_removed() {
    let directory = tempfile::tempdir().unwrap();
    let place = ShmDir::for_campaign(directory.path()).unwrap();
    let prepared = place.prepare(0).unwrap();
    let segment = Path::new("/dev/shm").join(format!("{}used", place.prefix()));
    fs::write(&segment, b"used").unwrap();
    for refused in [place.remove().unwrap_err(), place.prepare(0).unwrap_err()] {
        assert!(matches!(refused, ShmDirError::InUse { .. }), "{refused}");
        assert!(refused.to_string().contains(directory.path().to_str().unwrap()), "{refused}");
    }
    let file = place.directory().join("campaign");
    for content in [Some("/nowhere"), Some(""), None] {
        match content {
            Some(content) => fs::write(&file, content).unwrap(),
            None => fs::remove_file(&file).unwrap(),
        }
        let all = ShmDir::all().unwrap();
        let found = all.iter().find(|found| found.directory() == place.directory()).unwrap();
        let refused = found.remove().unwrap_err();
        assert!(matches!(refused, ShmDirError::InUse { .. }), "{content:?}: {refused}");
    }
    assert!(segment.exists() && place.directory().exists());

    drop(prepared);
    assert_eq!(place.remove().unwrap().files, 1);
    assert_eq!(files_of(&place), Vec::<String>::new());
}

/// Directories that are created and removed concurrently do not interfere.
#[test]
fn the_parent_directory_may_be_created_and_removed_concurrently() {
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                let directory = tempfile::tempdir().unwrap();
                let place = ShmDir::for_campaign(directory.path()).unwrap();
                for _ in 0..200 {
                    let prepared = place.prepare(0).unwrap();
                    assert!(place.directory().join("campaign").exists());
                    drop(prepared);
                    assert_eq!(place.remove().unwrap().files, 1);
                }
            });
        }
    });
}
