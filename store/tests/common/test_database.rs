//! The database of a test.

use std::sync::atomic::{AtomicU64, Ordering};

use sqlx::postgres::PgConnectOptions;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions, Executor};
use store::{Location, Store};
use tempfile::TempDir;

/// A directory, or a schema of its own on the server given by `CALMWALK_POSTGRES`, which the test target `postgres`
/// uses.
pub struct TestDatabase {
    directory: TempDir,
    schema: Option<String>,
}

/// URL of the test server.
pub fn server() -> String {
    std::env::var("CALMWALK_POSTGRES")
        .expect("CALMWALK_POSTGRES must be the URL of a PostgreSQL server; '.ci/postgres start' makes one")
}

impl TestDatabase {
    pub fn new() -> Self {
        static NUMBER: AtomicU64 = AtomicU64::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let on_server =
            env!("CARGO_CRATE_NAME") == "postgres" || std::env::var_os("CALMWALK_POSTGRES").is_some();
        let schema =
            on_server.then(|| format!("test_{}_{}_{number}", std::process::id(), store::unix_milliseconds()));
        Self { directory: tempfile::tempdir().unwrap(), schema }
    }

    /// The schema on a server.
    pub fn schema(&self) -> &str {
        self.schema.as_deref().expect("a directory has no schema")
    }

    pub fn location(&self) -> Location {
        match &self.schema {
            Some(schema) => {
                let url = format!("{}?schema={schema}&application_name={schema}", server());
                url.parse().unwrap()
            }
            None => self.directory.path().into(),
        }
    }

    /// Executes SQL on the tables without the store.
    pub async fn execute(&self, sql: &'static str) {
        if let Some(schema) = &self.schema {
            let options: PgConnectOptions = server().parse().unwrap();
            let options = options.options([("search_path", schema.as_str())]);
            options.connect().await.unwrap().execute(sql).await.unwrap();
        } else {
            let path = self.directory.path().join(store::DATABASE);
            let options = SqliteConnectOptions::new().filename(path).foreign_keys(false);
            options.connect().await.unwrap().execute(sql).await.unwrap();
        }
    }

    /// Creates a campaign with one seed structure and the protocol "dft" in force, which uses the caller's clock.
    pub async fn create(&self) -> Store {
        super::create_at(self.location()).await.with_caller_clock()
    }

    pub async fn open(&self) -> Store {
        Store::open(self.location()).await.unwrap().with_caller_clock()
    }

    pub async fn open_read_only(&self) -> Store {
        Store::open_read_only(self.location()).await.unwrap().with_caller_clock()
    }
}

impl Drop for TestDatabase {
    fn drop(&mut self) {
        let Some(schema) = self.schema.take() else { return };
        let remove = async move {
            let options: PgConnectOptions = server().parse().unwrap();
            let mut connection = options.connect().await.unwrap();
            // A transaction that the test dropped may not be rolled back yet.
            let end =
                "SELECT pg_terminate_backend(pid, 5000) FROM pg_stat_activity WHERE application_name = $1";
            sqlx::query(end).bind(&schema).execute(&mut connection).await.unwrap();
            let sql = AssertSqlSafe(format!("DROP SCHEMA IF EXISTS {schema} CASCADE"));
            connection.execute(sql).await.unwrap();
        };
        // The test's runtime cannot wait for anything at this point.
        let thread = std::thread::spawn(|| {
            tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(remove);
        });
        if thread.join().is_err() && !std::thread::panicking() {
            panic!("the schema could not be removed");
        }
    }
}
