//! One way to two databases.
//!
//! SQLite and PostgreSQL get the same SQL, with `$1` for what is bound, and the same four types: BIGINT (also for truth:
//! 0 and 1), DOUBLE PRECISION, TEXT and BYTEA. What differs stands here, each in its place: how a transaction begins
//! (this file), how rows are locked ([`query`]), how many rows are written at once ([`rows`]), what values are
//! ([`value`]). Making and opening a database is in `sqlite` and `postgres`.

pub mod query;
pub mod row;
pub mod rows;
pub mod value;

use sqlx::{Postgres, Sqlite};

pub use query::{Query, query};
pub(crate) use row::from_columns;
pub use row::{FromRow, Row};
pub use rows::execute_rows;
pub use value::Value;

use crate::error::{Result, StoreError};
use crate::postgres::Server;
use crate::sqlite::DatabaseFile;

/// An open database. Clones share its connections.
#[derive(Clone, Debug)]
pub enum Database {
    Sqlite(DatabaseFile),
    Postgres(Server),
}

/// Statements that are made as a whole, or not at all: dropped without [`Transaction::commit`], they are not.
pub enum Transaction {
    Sqlite(sqlx::Transaction<'static, Sqlite>),
    /// With how this server tells the time.
    Postgres(sqlx::Transaction<'static, Postgres>, Clock),
}

/// Whose clock leases go by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// The server's: hosts need not agree about the time.
    Server,
    /// The caller's, as in SQLite, which serves one host.
    Caller,
}

impl Database {
    /// A transaction that may write.
    pub async fn begin(&self) -> Result<Transaction> {
        match self {
            Self::Sqlite(file) => Ok(Transaction::Sqlite(file.begin().await?)),
            Self::Postgres(server) => server.begin().await,
        }
    }

    /// A transaction of whoever leads the campaign; no other one of these is under way.
    ///
    /// # Errors
    /// [`StoreError::LockLost`] if another process leads it by now.
    pub async fn begin_to_lead(&self) -> Result<Transaction> {
        match self {
            Self::Sqlite(file) => Ok(Transaction::Sqlite(file.begin().await?)),
            Self::Postgres(server) => server.begin_to_lead().await,
        }
    }

    /// The same for a commit with this mark; the second is whether it was made already, which is looked up if an earlier
    /// try may have come through.
    pub async fn begin_to_commit(&self, mark: i64, again: bool) -> Result<(Transaction, bool)> {
        match self {
            Self::Sqlite(file) => Ok((Transaction::Sqlite(file.begin().await?), false)),
            Self::Postgres(server) => server.begin_to_commit(mark, again).await,
        }
    }

    /// A transaction that sees everything at one instant.
    pub async fn begin_to_read(&self) -> Result<Transaction> {
        match self {
            Self::Sqlite(file) => Ok(Transaction::Sqlite(file.readers.begin().await?)),
            Self::Postgres(server) => server.begin_to_read().await,
        }
    }

    /// Whether leases go by the clock of a server.
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

    /// The time by which leases begin and end, ms since 1970; `now` is the caller's.
    pub async fn time(&mut self, now: i64) -> Result<i64> {
        match self {
            Self::Postgres(_, Clock::Server) => query("SELECT server_clock()").fetch_one(self).await,
            _ => Ok(now),
        }
    }

    /// Whether leases go by the clock of a server.
    pub fn has_clock(&self) -> bool {
        matches!(self, Self::Postgres(_, Clock::Server))
    }

    /// Whether there is a table of this name: those of an earlier version lack some.
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

    /// The same of a column.
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

/// Where a query may be sent.
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

/// The error for a row that has to be there.
fn missing_row() -> StoreError {
    StoreError::Database(sqlx::Error::RowNotFound)
}
