//! The databases for the benchmark.

use sqlx::postgres::PgConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions, Executor};
use store::Location;
use tempfile::TempDir;

/// Kind of database.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Database {
    Sqlite,
    /// The server with the URL in `CALMWALK_POSTGRES`.
    Postgres,
}

/// A campaign's location. It is removed when this is dropped or, on a server, when the next is created.
pub struct Room {
    pub location: Location,
    pub directory: TempDir,
}

impl Database {
    pub fn all() -> Vec<Self> {
        if server().is_some() { vec![Self::Sqlite, Self::Postgres] } else { vec![Self::Sqlite] }
    }

    pub fn name(self) -> &'static str {
        match self {
            Self::Sqlite => "SQLite",
            Self::Postgres => "PostgreSQL",
        }
    }

    pub async fn room(self) -> Room {
        let directory = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
        let location = match self {
            Self::Sqlite => directory.path().into(),
            Self::Postgres => empty_schema().await,
        };
        Room { location, directory }
    }
}

fn server() -> Option<String> {
    std::env::var("CALMWALK_POSTGRES").ok()
}

async fn empty_schema() -> Location {
    let server = server().expect("asked for only with a server");
    let options: PgConnectOptions = server.parse().unwrap();
    let sql = AssertSqlSafe("DROP SCHEMA IF EXISTS bench CASCADE");
    options.connect().await.unwrap().execute(sql).await.unwrap();
    format!("{server}?schema=bench").parse().unwrap()
}
