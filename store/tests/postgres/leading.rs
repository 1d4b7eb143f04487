//! Only one process leads a campaign, and a schema holds only one campaign.

use std::time::Duration;

use sqlx::postgres::{PgConnectOptions, PgConnection};
use sqlx::{ConnectOptions, Executor};
use store::{CampaignLock, CampaignRecord, Fate, Store, StoreError};
use wire::{CampaignId, Origin};

use super::common::*;

/// A connection for statements that the store does not offer.
pub async fn connect(database: &TestDatabase) -> PgConnection {
    let options: PgConnectOptions = server().parse().unwrap();
    options.options([("search_path", database.schema())]).connect().await.unwrap()
}

/// Ends the connection that holds the lock, like a network failure.
async fn break_the_lock(database: &TestDatabase) {
    let sql = "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity
               WHERE application_name = $1 AND pid IN (SELECT pid FROM pg_locks WHERE locktype = 'advisory')";
    let ended: Vec<bool> = sqlx::query_scalar(sql)
        .bind(database.schema())
        .fetch_all(&mut connect(database).await)
        .await
        .unwrap();
    assert_eq!(ended, [true]);
}

#[tokio::test]
async fn a_second_holder_learns_of_the_first_and_the_lock_is_released() {
    let database = TestDatabase::new();
    let lock = CampaignLock::acquire_at(database.location(), "first").await.unwrap();
    let error = CampaignLock::acquire_at(database.location(), "second").await.unwrap_err();
    assert!(matches!(error, StoreError::Locked { .. }), "{error}");
    let message = error.to_string();
    let first = format!("process {} (first) on {}", std::process::id(), store::this_host());
    assert!(message.contains(&first) && message.contains(database.schema()), "{message}");
    // Another schema is another campaign.
    let other = TestDatabase::new();
    CampaignLock::acquire_at(other.location(), "other").await.unwrap();
    drop(lock);
    CampaignLock::acquire_at(database.location(), "second").await.unwrap();
}

#[tokio::test]
async fn a_lock_whose_connection_broke_is_taken_again() {
    let database = TestDatabase::new();
    let lock = CampaignLock::acquire_at(database.location(), "first").await.unwrap();
    let store = database.create().await.fenced_by(&lock);
    break_the_lock(&database).await;
    let lost = tokio::time::timeout(Duration::from_secs(4), lock.lost()).await;
    assert!(lost.is_err(), "no other process took it: {lost:?}");
    let error = CampaignLock::acquire_at(database.location(), "second").await.unwrap_err();
    assert!(matches!(error, StoreError::Locked { .. }), "{error}");
    assert_eq!(accept(&store, 1).await.len(), 1);
}

#[tokio::test]
async fn a_process_that_lost_the_lock_stops_writing() {
    let database = TestDatabase::new();
    let first = CampaignLock::acquire_at(database.location(), "first").await.unwrap();
    let old = database.create().await.fenced_by(&first);
    accept(&old, 1).await;
    let second = loop {
        break_the_lock(&database).await;
        match CampaignLock::acquire_at(database.location(), "second").await {
            Ok(lock) => break lock,
            // The first process reacquired the lock earlier.
            Err(error) => assert!(matches!(error, StoreError::Locked { .. }), "{error}"),
        }
    };
    let new = database.open().await.fenced_by(&second);
    let fresh = |step| commit_of(vec![candidate(0, step, Origin::Biased, Fate::Accepted)]);
    // Writes fail even before the first process notices the loss of its lock.
    for error in [
        old.commit(&fresh(7)).await.unwrap_err(),
        old.add_protocol(&protocol("other"), 0).await.unwrap_err(),
        old.reclaim_leases(0).await.unwrap_err(),
        old.set_configuration_in_force("{}", &[], 0).await.unwrap_err(),
    ] {
        assert!(
            matches!(&error, StoreError::LockLost { holder, .. } if holder.contains("second")),
            "{error}"
        );
    }
    assert_eq!(new.commit(&fresh(8)).await.unwrap(), 2..3);
    let lost = tokio::time::timeout(Duration::from_secs(30), first.lost()).await.unwrap();
    assert!(matches!(&lost, StoreError::LockLost { holder, .. } if holder.contains("second")), "{lost}");
    assert_eq!(new.decisions(1..=9).await.unwrap().len(), 2);
}

#[tokio::test]
async fn another_campaign_in_the_same_schema_is_refused_with_both_ids() {
    let database = TestDatabase::new();
    database.create().await;
    let other = CampaignRecord { id: CampaignId([3; 16]), ..campaign() };
    let error = Store::create(database.location(), &other, &[], 0).await.unwrap_err();
    assert!(matches!(error, StoreError::Occupied { .. }), "{error}");
    let message = error.to_string();
    for part in [other.id.to_string(), CAMPAIGN.to_string(), database.schema().to_owned()] {
        assert!(message.contains(&part), "{message}");
    }
}

#[tokio::test]
async fn foreign_tables_and_newer_versions_are_refused() {
    let database = TestDatabase::new();
    let mut connection = connect(&database).await;
    let schema = sqlx::AssertSqlSafe(format!("CREATE SCHEMA {}", database.schema()));
    connection.execute(schema).await.unwrap();
    connection.execute("CREATE TABLE job (title TEXT)").await.unwrap();
    for error in [
        Store::create(database.location(), &campaign(), &[], 0).await.unwrap_err(),
        Store::open(database.location()).await.unwrap_err(),
        CampaignLock::acquire_at(database.location(), "first").await.unwrap_err(),
    ] {
        assert!(matches!(&error, StoreError::ForeignSchema { found, .. } if found == "job"), "{error}");
    }
    connection.execute("DROP TABLE job").await.unwrap();
    database.create().await;
    let newer = "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
                 VALUES (1000, 'newer', true, '', 0)";
    connection.execute(newer).await.unwrap();
    for opened in [Store::open(database.location()).await, Store::open_read_only(database.location()).await] {
        assert!(matches!(opened, Err(StoreError::Version { found: 1000, .. })), "{opened:?}");
    }
}

/// A process of an earlier version may lead the campaign: only the holder of the lock migrates.
#[tokio::test]
async fn tables_of_an_earlier_version_stay_while_another_process_leads() {
    let database = TestDatabase::new();
    let lock = CampaignLock::acquire_at(database.location(), "first").await.unwrap();
    database.create().await;
    let mut connection = connect(&database).await;
    connection.execute("DELETE FROM _sqlx_migrations WHERE version > 15").await.unwrap();
    let error = CampaignLock::acquire_at(database.location(), "second").await.unwrap_err();
    assert!(matches!(error, StoreError::Locked { .. }), "{error}");
    let version: i64 = sqlx::query_scalar("SELECT max(version) FROM _sqlx_migrations")
        .fetch_one(&mut connection)
        .await
        .unwrap();
    assert_eq!(version, 15);
    drop(lock);
}
