//! The password is shown nowhere.

use sqlx::Executor;
use store::{CampaignLock, Location, Store};

use super::common::*;
use super::leading::connect;

const PASSWORD: &str = "tr0ub4dor";

/// The location for a user of its own, with the password in the URL.
async fn with_password(database: &TestDatabase) -> Location {
    let user = database.schema();
    let create = format!("CREATE ROLE {user} LOGIN SUPERUSER PASSWORD '{PASSWORD}'");
    connect(database).await.execute(sqlx::AssertSqlSafe(create)).await.unwrap();
    let host = server().split_once('@').unwrap().1.to_owned();
    format!("postgres://{user}:{PASSWORD}@{host}?schema={user}&application_name={user}").parse().unwrap()
}

#[tokio::test]
async fn a_password_is_in_no_message_and_not_in_the_database() {
    let database = TestDatabase::new();
    let location = with_password(&database).await;
    let lock = CampaignLock::acquire_at(&location, "first").await.unwrap();
    let store = Store::create(&location, &campaign(), &[], 0).await.unwrap().fenced_by(&lock);
    let refused = CampaignLock::acquire_at(&location, "second").await.unwrap_err();
    let exists = Store::create(&location, &campaign(), &[], 0).await.unwrap_err();
    let nowhere: Location = format!("postgres://anna:{PASSWORD}@127.0.0.1:1/lab?schema=x").parse().unwrap();
    let unreachable = Store::open(&nowhere).await.unwrap_err();
    assert!(unreachable.is_transient(), "{unreachable}");
    for shown in [
        format!("{refused} {refused:?}"),
        format!("{exists} {exists:?}"),
        format!("{unreachable} {unreachable:?}"),
        format!("{location} {location:?}"),
        format!("{store:?} {lock:?}"),
    ] {
        assert!(!shown.contains(PASSWORD), "{shown}");
    }
    let mut connection = connect(&database).await;
    for table in ["campaign", "leader", "process", "operation", "value"] {
        let sql = sqlx::AssertSqlSafe(format!("SELECT {table}::TEXT FROM {table}"));
        let rows: Vec<String> = sqlx::query_scalar(sql).fetch_all(&mut connection).await.unwrap();
        assert!(rows.iter().all(|row| !row.contains(PASSWORD)), "{table}: {rows:?}");
    }
    drop((store, lock));
    let drop_role = format!("REASSIGN OWNED BY {0} TO CURRENT_USER; DROP ROLE {0}", database.schema());
    connection.execute(sqlx::AssertSqlSafe(drop_role)).await.unwrap();
}
