//! Properties of a database that is a file.

use std::fs;

use store::{CampaignLock, DATABASE, ProcessRecord, Store, StoreError};

use crate::common::*;

#[tokio::test]
async fn a_database_is_created_as_a_whole_or_not_at_all() {
    let directory = tempfile::tempdir().unwrap();
    // Leftovers of a killed creation are ignored.
    fs::write(directory.path().join("campaign.sqlite.new"), b"half a file").unwrap();
    create(directory.path()).await.close().await;
    let files = fs::read_dir(directory.path()).unwrap().count();
    assert_eq!(files, 1, "only {DATABASE}");
}

#[tokio::test]
async fn other_files_and_versions_are_refused_with_a_description() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join(DATABASE);
    fs::write(&path, "units metal\natom_style atomic\n").unwrap();
    let message = Store::open(directory.path()).await.unwrap_err().to_string();
    assert!(message.contains("not an SQLite database") && message.contains("units metal"), "{message}");
    fs::write(&path, "").unwrap();
    assert!(matches!(Store::open(directory.path()).await, Err(StoreError::NotADatabase { .. })));
    fs::remove_file(&path).unwrap();

    create(directory.path()).await.close().await;
    let whole = fs::read(&path).unwrap();
    // https://www.sqlite.org/fileformat.html: user version at byte 60, application id at byte 68, big-endian.
    let (known, mut newer) = (whole[63], whole.clone());
    newer[63] += 1;
    fs::write(&path, &newer).unwrap();
    let message = Store::open(directory.path()).await.unwrap_err().to_string();
    assert!(
        message
            .contains(&format!("schema version {}, and this program reads up to version {known}", newer[63])),
        "{message}"
    );
    assert!(matches!(
        Store::open_read_only(directory.path()).await,
        Err(StoreError::Version { found, reads, .. }) if found == i64::from(newer[63]) && reads == i64::from(known)
    ));
    let mut foreign = whole.clone();
    foreign[68..72].copy_from_slice(&[0, 0, 0, 9]);
    fs::write(&path, &foreign).unwrap();
    assert!(matches!(Store::open(directory.path()).await, Err(StoreError::Foreign { found: 9, .. })));
    assert_eq!(fs::read(&path).unwrap(), foreign, "a foreign database is left as it is");
    // Scrambles the bytes of a page.
    let mut damaged = whole;
    damaged[4096..].fill(0x55);
    fs::write(&path, &damaged).unwrap();
    let error = Store::open(directory.path()).await.unwrap_err();
    assert!(error.to_string().contains("damaged") || matches!(error, StoreError::Schema(_)), "{error}");
}

#[tokio::test]
async fn a_directory_that_cannot_be_written_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let missing = directory.path().join("missing");
    let error = Store::create(&missing, &campaign(), &[], 0).await.unwrap_err();
    assert!(matches!(error, StoreError::Directory { .. }), "{error}");
    let file = directory.path().join("file");
    fs::write(&file, "").unwrap();
    let error = Store::create(&file, &campaign(), &[], 0).await.unwrap_err();
    assert!(error.to_string().contains("file"), "{error}");
    assert!(matches!(CampaignLock::acquire(&file, "run"), Err(StoreError::Directory { .. })));
}

#[cfg(unix)]
#[tokio::test]
async fn a_campaign_opens_read_only_where_nothing_may_be_written() {
    use std::os::unix::fs::PermissionsExt;
    let directory = tempfile::tempdir().unwrap();
    let store = create(directory.path()).await;
    accept(&store, 2).await;
    store.close().await;
    let permit = |mode| fs::set_permissions(directory.path(), fs::Permissions::from_mode(mode)).unwrap();
    permit(0o555);
    let refused = Store::open(directory.path()).await;
    let lock = CampaignLock::acquire(directory.path(), "run");
    let seen = Store::open_read_only(directory.path()).await.unwrap().status().await.unwrap();
    permit(0o755);
    assert_eq!(seen.labels.queued, 2);
    // The superuser may do anything.
    if !rustix::process::geteuid().is_root() {
        assert!(matches!(lock, Err(StoreError::Directory { .. })), "{lock:?}");
        let error = refused.unwrap_err();
        assert!(matches!(error, StoreError::Directory { .. }), "{error}");
    }
}

#[tokio::test]
async fn nothing_is_written_to_a_deleted_file() {
    let directory = tempfile::tempdir().unwrap();
    let (path, moved) = (directory.path().join(DATABASE), directory.path().join("moved"));
    let store = create(directory.path()).await;
    accept(&store, 1).await;
    let record = ProcessRecord::new("labeller", Some(0), std::process::id(), 1);
    store.upsert_process(&record).await.unwrap();
    fs::rename(&path, &moved).unwrap();
    for _ in 0..2 {
        let error = store.upsert_process(&record).await.unwrap_err();
        assert!(matches!(&error, StoreError::Removed { path: found } if *found == path), "{error}");
        let refused = store.lease(protocol("dft").hash, "l", 0, 9).await;
        assert!(matches!(refused, Err(StoreError::Removed { .. })));
        // Another file in its place is detected.
        fs::copy(&moved, &path).unwrap();
    }
    fs::rename(&moved, &path).unwrap();
    store.lease(protocol("dft").hash, "l", 0, 9).await.unwrap().unwrap();
}
