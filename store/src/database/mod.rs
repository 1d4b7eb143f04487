//! One interface to two databases.
//!
//! SQLite and PostgreSQL execute the same SQL, with `$1` for bound values and four types: BIGINT (also for
//! booleans: 0 and 1), DOUBLE PRECISION, TEXT and BYTEA. Each difference is handled in one place: beginning a
//! transaction (this file), locking rows ([`query`]), writing many rows at once ([`rows`]), values ([`value`]). Below
//! it, `sqlite/file` and `postgres/server` have the connections; above it, the `open` of each creates, opens and
//! migrates databases.

pub mod query;
pub mod row;
pub mod rows;
pub mod value;

use sqlx::{Postgres, Sqlite};

pub use query::{Query, query};
pub(crate) use row::from_columns;
pub use row::{FromRow, SqlRow};
pub use rows::execute_rows;
pub use value::SqlValue;

use crate::error::{Result, StoreError};
use crate::postgres::server::{Clock, PostgresServer};
use crate::sqlite::file::DatabaseFile;

/// An open database. Clones share its connections.
#[derive(Clone, Debug)]
pub enum Database {
    Sqlite(DatabaseFile),
    Postgres(PostgresServer),
}

/// A transaction. Dropped without [`Transaction::commit`], it is rolled back.
pub enum Transaction {
    Sqlite(sqlx::Transaction<'static, Sqlite>),
    /// With the clock that leases on this server use.
    Postgres(sqlx::Transaction<'static, Postgres>, Clock),
}

impl Database {
    /// Begins a transaction that may write.
    pub async fn begin(&self) -> Result<Transaction> {
        match self {
            Self::Sqlite(file) => Ok(Transaction::Sqlite(file.begin().await?)),
            Self::Postgres(server) => Ok(Transaction::Postgres(server.begin().await?, server.clock)),
        }
    }

    /// Begins a transaction of the process that leads the campaign. Only one of these runs at a time.
    ///
    /// # Errors
    /// [`StoreError::LockLost`] if another process leads the campaign now.
    pub async fn begin_as_leader(&self) -> Result<Transaction> {
        match self {
            Self::Sqlite(file) => Ok(Transaction::Sqlite(file.begin().await?)),
            Self::Postgres(server) => {
                Ok(Transaction::Postgres(server.begin_as_leader().await?, server.clock))
            }
        }
    }

    /// Begins the transaction of a commit with this mark. The second value says whether an earlier try has already
    /// made the commit; that is looked up only if `again` is set.
    pub async fn begin_commit(&self, mark: i64, again: bool) -> Result<(Transaction, bool)> {
        match self {
            Self::Sqlite(file) => Ok((Transaction::Sqlite(file.begin().await?), false)),
            Self::Postgres(server) => {
                let (transaction, made) = server.begin_commit(mark, again).await?;
                Ok((Transaction::Postgres(transaction, server.clock), made))
            }
        }
    }

    /// Begins a transaction that reads a snapshot.
    pub async fn begin_read(&self) -> Result<Transaction> {
        match self {
            Self::Sqlite(file) => Ok(Transaction::Sqlite(file.readers.begin().await?)),
            Self::Postgres(server) => Ok(Transaction::Postgres(server.begin_read().await?, server.clock)),
        }
    }

    /// Whether leases use the clock of a server.
    pub fn has_clock(&self) -> bool {
        matches!(self, Self::Postgres(server) if server.clock == Clock::Server)
    }

    pub async fn close(&self) {
        match self {
            Self::Sqlite(file) => file.close().await,
            Self::Postgres(server) => server.close().await,
        }
    }
}

impl Transaction {
    pub async fn commit(self) -> Result<()> {
        match self {
            Self::Sqlite(transaction) => Ok(transaction.commit().await?),
            Self::Postgres(transaction, _) => Ok(transaction.commit().await?),
        }
    }

    /// The time that leases use, ms since 1970; `now` is the caller's time.
    pub async fn time(&mut self, now: i64) -> Result<i64> {
        match self {
            Self::Postgres(_, Clock::Server) => query("SELECT server_clock()").fetch_one(self).await,
            _ => Ok(now),
        }
    }

    /// Whether leases use the clock of a server.
    pub fn has_clock(&self) -> bool {
        matches!(self, Self::Postgres(_, Clock::Server))
    }

    /// Whether the table exists: earlier versions lack some.
    pub async fn has_table(&mut self, name: &str) -> Result<bool> {
        let sql = match self {
            Self::Sqlite(_) => "SELECT count(*) FROM sqlite_schema WHERE type = 'table' AND name = $1",
            Self::Postgres(..) => {
                "SELECT count(*) FROM pg_tables WHERE schemaname = current_schema() AND tablename = $1"
            }
        };
        let found: u64 = query(sql).bind(name).fetch_one(self).await?;
        Ok(found > 0)
    }

    /// The same for a column.
    pub async fn has_column(&mut self, table: &str, name: &str) -> Result<bool> {
        let sql = match self {
            Self::Sqlite(_) => "SELECT count(*) FROM pragma_table_info($1) WHERE name = $2",
            Self::Postgres(..) => {
                "SELECT count(*) FROM information_schema.columns
                 WHERE table_schema = current_schema() AND table_name = $1 AND column_name = $2"
            }
        };
        let found: u64 = query(sql).bind(table).bind(name).fetch_one(self).await?;
        Ok(found > 0)
    }
}

/// The target of a query.
pub enum Target<'a> {
    Database(&'a Database),
    Transaction(&'a mut Transaction),
}

impl<'a> From<&'a Database> for Target<'a> {
    fn from(database: &'a Database) -> Self {
        Self::Database(database)
    }
}

impl<'a> From<&'a mut Transaction> for Target<'a> {
    fn from(transaction: &'a mut Transaction) -> Self {
        Self::Transaction(transaction)
    }
}

/// The error for a missing row that must exist.
fn missing_row() -> StoreError {
    StoreError::Database(sqlx::Error::RowNotFound)
}
