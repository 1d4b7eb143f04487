//! Error messages for missing connections, and reads that are cancelled.

use std::future::poll_fn;
use std::pin::pin;
use std::task::Poll;
use std::time::Duration;

use sqlx::postgres::PgConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, Executor};
use store::{Commit, Location, Store};

use super::common::*;
use super::leading::connect;

/// A server that refuses new connections.
#[tokio::test]
async fn a_server_without_free_connections_is_waited_for_and_named() {
    let database = TestDatabase::new();
    let store = database.create().await;
    store.close().await;
    let role = format!("one_{}", database.schema());
    let mut connection = connect(&database).await;
    let make = format!(
        "CREATE ROLE {role} LOGIN CONNECTION LIMIT 1; GRANT USAGE ON SCHEMA {0} TO {role};
         GRANT SELECT ON ALL TABLES IN SCHEMA {0} TO {role}",
        database.schema()
    );
    connection.execute(AssertSqlSafe(make)).await.unwrap();
    let options: PgConnectOptions = server().parse().unwrap();
    let first = options.username(&role).connect().await.unwrap();
    let address = server().split_once('@').unwrap().1.to_owned();
    let location: Location =
        format!("postgres://{role}@{address}?schema={}", database.schema()).parse().unwrap();
    let error = Store::open_read_only(&location).await.unwrap_err();
    assert!(error.is_transient() && error.to_string().contains("too many connections"), "{error}");
    first.close().await.unwrap();
    let leave = format!("DROP OWNED BY {role}; DROP ROLE {role}");
    connection.execute(AssertSqlSafe(leave)).await.unwrap();
}

/// All connections of a process wait for a lock.
#[tokio::test]
async fn waiting_for_a_lock_is_not_reported_as_an_unreachable_server() {
    let database = TestDatabase::new();
    let store = database.create().await;
    let mut other = connect(&database).await;
    other.execute("BEGIN; UPDATE leader SET holder = 'somebody'").await.unwrap();
    let commits = (0..5).map(|_| {
        let store = store.clone();
        tokio::spawn(async move { store.commit(&Commit::default()).await })
    });
    let commits: Vec<_> = commits.collect();
    tokio::time::sleep(Duration::from_secs(1)).await;
    let error = store.add_running_time(1).await.unwrap_err();
    assert!(error.is_transient() && error.to_string().contains("for locks"), "{error}");
    other.execute("ROLLBACK").await.unwrap();
    for commit in commits {
        commit.await.unwrap().unwrap();
    }
    store.add_running_time(1).await.unwrap();
}

/// Polls a future this many times, lets others go on in between, and drops it.
async fn cancelled_after<F: Future>(polls: usize, future: F) {
    let mut future = pin!(future);
    for _ in 0..polls {
        if poll_fn(|context| Poll::Ready(future.as_mut().poll(context).is_ready())).await {
            return;
        }
        tokio::task::yield_now().await;
    }
}

/// sqlx rolls back no transaction whose beginning is cancelled: writes would fail on its connection.
#[tokio::test]
async fn cancelled_reads_leave_no_transaction_on_their_connection() {
    let database = TestDatabase::new();
    let store = database.create().await;
    for polls in 1..60 {
        cancelled_after(polls, store.status()).await;
        let written = store.add_running_time(1).await;
        written.unwrap_or_else(|error| panic!("after a read that was polled {polls} times: {error}"));
    }
}
