//! The tables of a campaign are created in one transaction.

use std::collections::BTreeSet;
use std::time::Duration;

use sqlx::postgres::PgConnection;
use sqlx::{AssertSqlSafe, Executor};
use store::{CampaignLock, Store, StoreError};

use super::common::*;
use super::leading::connect;

/// The columns of all tables in the schema of a test, as `table.column`.
async fn columns(connection: &mut PgConnection, database: &TestDatabase) -> Vec<String> {
    let sql = "SELECT table_name::TEXT || '.' || column_name::TEXT FROM information_schema.columns
               WHERE table_schema = $1 ORDER BY 1";
    sqlx::query_scalar(sql).bind(database.schema()).fetch_all(connection).await.unwrap()
}

/// Whether a process of the campaign waits for the end of another transaction.
async fn waits_for_a_transaction(connection: &mut PgConnection, database: &TestDatabase) -> bool {
    let sql = "SELECT EXISTS (SELECT 1 FROM pg_stat_activity
               WHERE application_name = $1 AND wait_event = 'transactionid')";
    sqlx::query_scalar(sql).bind(database.schema()).fetch_one(connection).await.unwrap()
}

/// A table of the same name, which another transaction has not committed, stops the creation at one of the last tables.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn readers_see_no_tables_or_all_of_them() {
    let database = TestDatabase::new();
    let (mut other, mut reader) = (connect(&database).await, connect(&database).await);
    let schema = AssertSqlSafe(format!("CREATE SCHEMA {}", database.schema()));
    other.execute(schema).await.unwrap();
    other.execute("BEGIN; CREATE TABLE walk_conditions ()").await.unwrap();
    let location = database.location();
    let creating = tokio::spawn(async move { CampaignLock::acquire_at(location, "creator").await });
    let mut seen = BTreeSet::new();
    loop {
        let stopped = waits_for_a_transaction(&mut reader, &database).await;
        seen.insert(columns(&mut reader, &database).await);
        if stopped {
            break;
        }
        assert!(!creating.is_finished(), "the creation did not wait for the other transaction");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let error = Store::open_read_only(database.location()).await.unwrap_err();
    assert!(matches!(error, StoreError::Missing { .. }), "{error}");
    other.execute("ROLLBACK").await.unwrap();
    while !creating.is_finished() {
        seen.insert(columns(&mut reader, &database).await);
    }
    let _lock = creating.await.unwrap().unwrap();
    let all = columns(&mut reader, &database).await;
    assert!(all.iter().any(|column| column == "walk_conditions.conditions"), "{all:?}");
    assert_eq!(seen.difference(&BTreeSet::from([Vec::new(), all])).next(), None);
    database.create().await;
}

/// Several at once: none finds tables that another is still creating.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn several_processes_may_create_the_tables() {
    let database = TestDatabase::new();
    let create = || {
        let location = database.location();
        tokio::spawn(async move { CampaignLock::acquire_at(location, "one of them").await })
    };
    let tries = [create(), create(), create()];
    let mut held = Vec::new();
    for tried in tries {
        match tried.await.unwrap() {
            Ok(lock) => held.push(lock),
            Err(error) => assert!(matches!(error, StoreError::Locked { .. }), "{error}"),
        }
    }
    assert_eq!(held.len(), 1);
}
