//! TLS to the server of `.ci/postgres`. Its certificate, and that of a user who needs one, are signed by its own
//! authority.

use std::path::{Path, PathBuf};
use std::process::Command;

use sqlx::Executor;
use store::{CampaignLock, Location, Store, StoreError};

use super::common::*;
use super::leading::connect;

/// The directory with `authority.pem`, `server` and `anna`.
async fn certificates(database: &TestDatabase) -> PathBuf {
    let mut connection = connect(database).await;
    let file: String = sqlx::query_scalar("SHOW ssl_ca_file").fetch_one(&mut connection).await.unwrap();
    Path::new(&file).parent().unwrap().to_owned()
}

/// The location for `user` over an encrypted connection to this host name.
fn at(database: &TestDatabase, user: &str, host: &str, parameters: &str) -> Location {
    let address = server().split_once('@').unwrap().1.replace("127.0.0.1", host);
    let schema = database.schema();
    let url = format!("postgres://{user}@{address}?schema={schema}&application_name={schema}&{parameters}");
    url.parse().unwrap()
}

/// Number of connections of a test's store and lock, and of the encrypted ones among them.
async fn connections(database: &TestDatabase) -> (i64, i64) {
    let sql = "SELECT count(*), count(*) FILTER (WHERE ssl) FROM pg_stat_activity NATURAL JOIN pg_stat_ssl
               WHERE application_name = $1";
    sqlx::query_as(sql).bind(database.schema()).fetch_one(&mut connect(database).await).await.unwrap()
}

#[tokio::test]
async fn a_verified_server_gets_an_encrypted_connection() {
    let database = TestDatabase::new();
    let root = certificates(&database).await.join("authority.pem");
    let location = at(
        &database,
        "calmwalk",
        "localhost",
        &format!("sslmode=verify-full&sslrootcert={}", root.display()),
    );
    let lock = CampaignLock::acquire_at(&location, "protected").await.unwrap();
    let store = Store::create(&location, &campaign(), &[], 0).await.unwrap().fenced_by(&lock);
    store.status().await.unwrap();
    let (all, encrypted) = connections(&database).await;
    assert!(all >= 2, "the lock has one, and the store");
    assert_eq!(all, encrypted);
}

#[tokio::test]
async fn an_unverified_server_is_refused() {
    let database = TestDatabase::new();
    let own = certificates(&database).await;
    let others = tempfile::tempdir().unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/certificates.sh");
    let made = Command::new(script).arg(others.path()).arg("server").output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let wrong = format!("sslmode=verify-full&sslrootcert={}/authority.pem", others.path().display());
    let right = format!("sslmode=verify-full&sslrootcert={}/authority.pem", own.display());
    for (host, parameters, expected) in [
        ("localhost", wrong.as_str(), "BadSignature"),
        // Public authorities only.
        ("localhost", "sslmode=verify-full", "UnknownIssuer"),
        // Another name than in its certificate.
        ("127.0.0.1", right.as_str(), "not valid for name"),
    ] {
        let error = Store::open(at(&database, "calmwalk", host, parameters)).await.unwrap_err();
        let message = error.to_string();
        assert!(matches!(error, StoreError::Protection(_)) && !error.is_transient(), "{error:?}");
        assert!(message.contains(expected) && message.contains("sslrootcert"), "{message}");
    }
}

#[tokio::test]
async fn a_user_may_log_in_with_a_certificate() {
    let database = TestDatabase::new();
    let certificates = certificates(&database).await;
    let make = "DO $$ BEGIN CREATE ROLE anna LOGIN SUPERUSER; EXCEPTION WHEN duplicate_object THEN END $$";
    connect(&database).await.execute(make).await.unwrap();
    let (root, anna) = (certificates.join("authority.pem"), certificates.join("anna"));
    let known = format!("sslmode=verify-full&sslrootcert={}", root.display());
    let refused = Store::open(at(&database, "anna", "localhost", &known)).await.unwrap_err();
    assert!(refused.to_string().contains("certificate"), "{refused}");
    let anna = anna.display();
    let own = format!("sslcert={anna}/certificate.pem&sslkey={anna}/key.pem");
    let location = at(&database, "anna", "localhost", &format!("{known}&{own}"));
    let store = Store::create(&location, &campaign(), &[], 0).await.unwrap();
    assert!(connections(&database).await.1 >= 1);
    store.close().await;
    let leave = "REASSIGN OWNED BY anna TO CURRENT_USER; DROP ROLE anna";
    connect(&database).await.execute(leave).await.unwrap();
}
