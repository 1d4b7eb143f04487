//! A query for either database.

use std::borrow::Cow;
use std::time::Instant;

use sqlx::{AssertSqlSafe, Executor, Postgres, Sqlite};

use super::row::{FromRow, SqlRow};
use super::value::SqlValue;
use super::{Database, Target, Transaction, missing_row};
use crate::error::{Result, StoreError};
use crate::postgres::server::{PostgresServer, RETRY_INTERVAL};

/// SQL with its bound values.
#[derive(Clone)]
pub struct Query {
    sql: &'static str,
    lock: &'static str,
    values: Vec<SqlValue>,
}

/// A statement; `$1` is the first bound value.
pub fn query(sql: &'static str) -> Query {
    Query { sql, lock: "", values: Vec::new() }
}

impl Query {
    /// Binds the next value.
    pub fn bind(mut self, value: impl Into<SqlValue>) -> Self {
        self.values.push(value.into());
        self
    }

    /// Binds several values in order.
    pub fn bind_all(mut self, values: Vec<SqlValue>) -> Self {
        self.values.extend(values);
        self
    }

    /// Locks the rows that the query finds until the end of the transaction. SQLite has a single writer and needs
    /// no row locks.
    pub fn locked(self) -> Self {
        Self { lock: " FOR NO KEY UPDATE", ..self }
    }

    /// Locks like [`Self::locked`], but skips rows that others have locked.
    pub fn skip_locked(self) -> Self {
        Self { lock: " FOR NO KEY UPDATE SKIP LOCKED", ..self }
    }

    /// Executes the statement and returns the number of rows written.
    pub async fn execute(self, target: impl Into<Target<'_>>) -> Result<u64> {
        match target.into() {
            Target::Database(Database::Sqlite(file)) => self.execute_sqlite(&file.readers).await,
            Target::Database(Database::Postgres(server)) => {
                self.execute_postgres(&mut *server.connection().await?).await
            }
            Target::Transaction(Transaction::Sqlite(transaction)) => {
                self.execute_sqlite(&mut **transaction).await
            }
            Target::Transaction(Transaction::Postgres(transaction, _)) => {
                self.execute_postgres(&mut **transaction).await
            }
        }
    }

    pub async fn fetch_all<T: FromRow>(self, target: impl Into<Target<'_>>) -> Result<Vec<T>> {
        self.rows(target).await?.iter().map(T::from_row).collect()
    }

    /// What it finds, as it is.
    pub async fn rows(self, target: impl Into<Target<'_>>) -> Result<Vec<SqlRow>> {
        match target.into() {
            Target::Database(Database::Sqlite(file)) => self.fetch_sqlite(&file.readers).await,
            Target::Database(Database::Postgres(server)) => self.read_from(server).await,
            Target::Transaction(Transaction::Sqlite(transaction)) => {
                self.fetch_sqlite(&mut **transaction).await
            }
            Target::Transaction(Transaction::Postgres(transaction, _)) => {
                self.fetch_postgres(&mut **transaction).await
            }
        }
    }

    /// The first row, if there is one: such queries find at most one row.
    pub async fn fetch_optional<T: FromRow>(self, target: impl Into<Target<'_>>) -> Result<Option<T>> {
        Ok(self.fetch_all(target).await?.into_iter().next())
    }

    pub async fn fetch_one<T: FromRow>(self, target: impl Into<Target<'_>>) -> Result<T> {
        self.fetch_optional(target).await?.ok_or_else(missing_row)
    }

    /// Reads again over another connection if one breaks.
    async fn read_from(self, server: &PostgresServer) -> Result<Vec<SqlRow>> {
        let started = Instant::now();
        loop {
            let read = match server.connection().await {
                Ok(mut connection) => self.clone().fetch_postgres(&mut *connection).await,
                Err(error) => Err(error),
            };
            match read {
                Err(StoreError::Unreachable(_)) if started.elapsed() < server.reconnect_timeout => {
                    tokio::time::sleep(RETRY_INTERVAL).await
                }
                read => return read,
            }
        }
    }

    async fn execute_sqlite(self, on: impl Executor<'_, Database = Sqlite>) -> Result<u64> {
        let query =
            self.values.into_iter().fold(sqlx::query(self.sql), |query, value| value.bind_sqlite(query));
        Ok(query.execute(on).await?.rows_affected())
    }

    async fn fetch_sqlite(self, on: impl Executor<'_, Database = Sqlite>) -> Result<Vec<SqlRow>> {
        let query =
            self.values.into_iter().fold(sqlx::query(self.sql), |query, value| value.bind_sqlite(query));
        Ok(query.fetch_all(on).await?.into_iter().map(SqlRow::Sqlite).collect())
    }

    async fn execute_postgres(self, on: impl Executor<'_, Database = Postgres>) -> Result<u64> {
        let query = sqlx::query(AssertSqlSafe(for_postgres(self.sql, self.lock)));
        let query = self.values.into_iter().fold(query, |query, value| value.bind_postgres(query));
        Ok(query.execute(on).await?.rows_affected())
    }

    async fn fetch_postgres(self, on: impl Executor<'_, Database = Postgres>) -> Result<Vec<SqlRow>> {
        let query = sqlx::query(AssertSqlSafe(for_postgres(self.sql, self.lock)));
        let query = self.values.into_iter().fold(query, |query, value| value.bind_postgres(query));
        Ok(query.fetch_all(on).await?.into_iter().map(SqlRow::Postgres).collect())
    }
}

/// Query plan hints for SQLite, and their replacements for PostgreSQL, which needs none.
const HINTS: [(&str, &str); 2] = [("CROSS JOIN", "JOIN"), (" NOT INDEXED", "")];

/// In SQLite, `CROSS JOIN … ON` fixes the join order and `NOT INDEXED` forces a table scan. PostgreSQL knows
/// neither.
pub(super) fn for_postgres(sql: &'static str, lock: &'static str) -> String {
    let mut sql = Cow::from(sql);
    for (hint, instead) in HINTS {
        if sql.contains(hint) {
            sql = Cow::from(sql.replace(hint, instead));
        }
    }
    if !lock.is_empty() {
        sql.to_mut().push_str(lock);
    }
    sql.into_owned()
}
