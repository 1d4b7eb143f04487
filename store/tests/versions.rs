//! Versions of the potential and their files.

use store::{Store, StoreError, VersionFiles, VersionRecord, VersionState};

use crate::common::*;
use crate::version_records::{version_files, version_record};

async fn register(store: &Store, number: u32, parent: u32) -> VersionRecord {
    let record = version_record(number, parent, VersionState::Registered);
    store.add_version(&record, Some(&version_files(number))).await.unwrap();
    record
}

async fn refuse(store: &Store, number: u32, parent: u32) -> VersionRecord {
    let record = version_record(number, parent, VersionState::Refused);
    store.add_version(&record, None).await.unwrap();
    record
}

/// Versions 1 and 3 are registered, 2 is refused.
async fn three_versions(store: &Store) -> Vec<VersionRecord> {
    vec![register(store, 1, 0).await, refuse(store, 2, 1).await, register(store, 3, 1).await]
}

#[tokio::test]
async fn versions_and_refused_attempts_are_read_back() {
    let database = TestDatabase::new();
    let store = database.create().await;
    assert_eq!(store.versions().await.unwrap(), []);
    let expected = three_versions(&store).await;
    store.close().await;
    for store in [database.open().await, database.open_read_only().await] {
        assert_eq!(store.versions().await.unwrap(), expected);
        for number in [1, 3] {
            assert_eq!(store.version_files(number).await.unwrap(), Some(version_files(number)));
        }
        for number in [0, 2, 4] {
            assert_eq!(store.version_files(number).await.unwrap(), None);
        }
    }
    let store = database.open_read_only().await;
    let refused = version_record(4, 3, VersionState::Refused);
    assert!(matches!(store.add_version(&refused, None).await, Err(StoreError::ReadOnly)));
}

#[tokio::test]
async fn contradictory_versions_are_refused_with_the_reason() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let registered = |number, parent| version_record(number, parent, VersionState::Registered);
    let refused = version_record(1, 0, VersionState::Refused);
    let files = version_files(1);
    let hashes = VersionRecord { model_hash: registered(1, 0).model_hash, ..refused.clone() };
    let endless = VersionRecord { seconds: f64::INFINITY, ..registered(1, 0) };
    for (record, files, words) in [
        (registered(0, 0), Some(&files), "has a model with the BLAKE3 hash"),
        (registered(1, 0), Some(&version_files(2)), "has a model with the BLAKE3 hash"),
        (
            VersionRecord { mixture_hash: String::new(), ..registered(1, 0) },
            Some(&files),
            "and its record says ''",
        ),
        (registered(1, 0), None, "version 1 is registered without files"),
        (refused.clone(), Some(&files), "version 1 is refused and has files"),
        (hashes, None, "version 1 is refused and has a file with the hash"),
        (endless, Some(&files), "version 1 took inf s"),
        (registered(1, 1), Some(&files), "version 1 has the parent 1, which is not a registered version"),
        (version_record(2, 0, VersionState::Refused), None, "the next number is 1"),
        (version_record(0, 0, VersionState::Refused), None, "the next number is 1"),
    ] {
        let error = store.add_version(&record, files).await.unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
        assert_eq!(store.versions().await.unwrap(), []);
    }
    refuse(&store, 1, 0).await;
    let error = store.add_version(&registered(2, 1), Some(&version_files(2))).await.unwrap_err();
    assert!(matches!(&error, StoreError::Inconsistent(reason) if reason.contains("the parent 1")), "{error}");
    let again = store.add_version(&refused, None).await.unwrap_err();
    assert!(matches!(again, StoreError::VersionNumber { number: 1, next: 2 }), "{again}");
}

/// The version is written before its files.
#[tokio::test]
async fn a_version_whose_files_cannot_be_written_leaves_nothing() {
    let database = TestDatabase::new();
    let store = database.create().await;
    database.execute("DROP TABLE version_file").await;
    let record = version_record(1, 0, VersionState::Registered);
    store.add_version(&record, Some(&version_files(1))).await.unwrap_err();
    assert_eq!(store.versions().await.unwrap(), []);
    refuse(&store, 1, 0).await;
}

#[tokio::test]
async fn one_of_two_processes_registers_a_version() {
    let database = TestDatabase::new();
    let (one, other) = (database.create().await, database.open().await);
    for number in 1..=5 {
        let record = version_record(number, number - 1, VersionState::Registered);
        let files = version_files(number);
        let (first, second) =
            tokio::join!(one.add_version(&record, Some(&files)), other.add_version(&record, Some(&files)));
        let refused = match (first, second) {
            (Ok(()), Err(error)) | (Err(error), Ok(())) => error,
            both => panic!("{both:?}"),
        };
        let expected = (number, number + 1);
        assert!(
            matches!(refused, StoreError::VersionNumber { number, next } if (number, next) == expected),
            "{refused}"
        );
        assert_eq!(other.version_files(number).await.unwrap(), Some(files));
    }
    assert_eq!(one.versions().await.unwrap().len(), 5);
    assert_eq!(one.check(|_, _| {}).await.unwrap(), []);
}

#[tokio::test]
async fn damage_is_reported_with_version_and_file() {
    let database = TestDatabase::new();
    let store = database.create().await;
    three_versions(&store).await;
    database.execute("UPDATE version_file SET data = substr(data, 1, 3) WHERE name = 'mixture'").await;
    let error = store.version_files(3).await.unwrap_err().to_string();
    assert!(error.starts_with("damaged database: the mixture of version 3: its BLAKE3 hash is "), "{error}");
    database.execute("DELETE FROM version_file WHERE name = 'model' AND version = 1").await;
    let error = store.version_files(1).await.unwrap_err().to_string();
    assert!(error.starts_with("damaged database: the model of version 1: it is missing"), "{error}");
    database.execute("UPDATE version SET labels = 77 WHERE number = 2").await;
    let error = store.versions().await.unwrap_err().to_string();
    assert!(error.starts_with("damaged database: version 2: its content has the checksum "), "{error}");
}

#[tokio::test]
async fn backups_and_compacting_keep_versions() {
    let (database, elsewhere) = (TestDatabase::new(), tempfile::tempdir().unwrap());
    let store = database.create().await;
    let before = store.size().await.unwrap();
    let mut expected = three_versions(&store).await;
    let files =
        VersionFiles { model: (0..3_000_000_u32).map(|k| (k / 7) as u8).collect(), ..version_files(4) };
    let record = VersionRecord {
        model_hash: blake3::hash(&files.model).to_hex().to_string(),
        ..version_record(4, 3, VersionState::Registered)
    };
    store.add_version(&record, Some(&files)).await.unwrap();
    expected.push(record);
    assert!(store.size().await.unwrap() > before + 3_000_000);
    let target = elsewhere.path().join("copy");
    database.open_read_only().await.backup(&target, 7, |_, _| {}).await.unwrap();
    store.compact().await.unwrap();
    for store in [store, Store::open(&target).await.unwrap()] {
        assert_eq!(store.versions().await.unwrap(), expected);
        assert_eq!(store.version_files(1).await.unwrap(), Some(version_files(1)));
        assert_eq!(store.version_files(4).await.unwrap().as_ref(), Some(&files));
        assert_eq!(store.check(|_, _| {}).await.unwrap(), []);
        register(&store, 5, 4).await;
    }
}
