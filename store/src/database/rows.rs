//! Writes many rows with one statement.
//!
//! For PostgreSQL every statement is a round trip, so all rows travel together as one array per column. SQLite runs
//! in this process, where one row after the other is fastest.

use std::sync::Arc;

use sqlx::postgres::PgArguments;
use sqlx::query::Query;
use sqlx::{AssertSqlSafe, Postgres};

use super::Transaction;
use super::value::{SqlValue, replace_nul};
use crate::error::{Result, StoreError};

/// Approximate number of bytes sent at once: PostgreSQL arrays hold up to 1 GB, and the server copies them.
const BATCH_BYTES: usize = 1 << 25;

/// Executes `sql` for every row. In it, `{rows}` stands for a table `new` of the rows, `{columns}` for its column
/// names, separated by commas, and `{excluded}` for the assignments that overwrite all columns except the first.
/// The values of a column have one type. Returns the number of rows written.
pub async fn execute_rows(
    transaction: &mut Transaction,
    sql: &'static str,
    columns: &'static [&'static str],
    rows: Vec<Vec<SqlValue>>,
) -> Result<u64> {
    let Some(first) = rows.first() else { return Ok(0) };
    let excluded: Vec<_> = columns.iter().skip(1).map(|name| format!("{name} = excluded.{name}")).collect();
    let sql = sql.replace("{columns}", &columns.join(", ")).replace("{excluded}", &excluded.join(", "));
    let mut written = 0;
    match transaction {
        Transaction::Sqlite(transaction) => {
            let sql: Arc<str> = sql.replace("{rows}", &one_row(columns)).into();
            for row in rows {
                let query = sqlx::query(AssertSqlSafe(Arc::clone(&sql)));
                let query = row.into_iter().fold(query, |query, value| value.bind_sqlite(query));
                written += query.execute(&mut **transaction).await?.rows_affected();
            }
        }
        Transaction::Postgres(transaction, _) => {
            let sql = sql.replace("{rows}", &arrays(columns, first)).replace("CROSS JOIN", "JOIN");
            let mut rows = rows.into_iter().peekable();
            while rows.peek().is_some() {
                let load = next_batch(&mut rows);
                let mut query = sqlx::query(AssertSqlSafe(sql.clone()));
                for column in transpose(columns.len(), load) {
                    query = bind_column(query, column)?;
                }
                written += query.execute(&mut **transaction).await?.rows_affected();
            }
        }
    }
    Ok(written)
}

/// A table of one row, for SQLite.
fn one_row(columns: &[&str]) -> String {
    let columns: Vec<_> = columns.iter().zip(1..).map(|(name, k)| format!("${k} AS {name}")).collect();
    format!("(SELECT {}) AS new", columns.join(", "))
}

/// A table of as many rows as each array has, for PostgreSQL.
fn arrays(columns: &[&str], first: &[SqlValue]) -> String {
    let array = |(value, k): (&SqlValue, usize)| {
        let kind = match value {
            SqlValue::Integer(_) => "BIGINT",
            SqlValue::Real(_) => "DOUBLE PRECISION",
            SqlValue::Text(_) => "TEXT",
            SqlValue::Bytes(_) => "BYTEA",
        };
        format!("${k}::{kind}[]")
    };
    let arrays: Vec<_> = first.iter().zip(1..).map(array).collect();
    format!("unnest({}) AS new ({})", arrays.join(", "), columns.join(", "))
}

/// The next rows to send at once.
fn next_batch(rows: &mut impl Iterator<Item = Vec<SqlValue>>) -> Vec<Vec<SqlValue>> {
    let (mut load, mut bytes) = (Vec::new(), 0);
    while bytes < BATCH_BYTES
        && let Some(row) = rows.next()
    {
        bytes += row.iter().map(SqlValue::len).sum::<usize>();
        load.push(row);
    }
    load
}

fn transpose(columns: usize, rows: Vec<Vec<SqlValue>>) -> Vec<Vec<SqlValue>> {
    let mut transposed: Vec<Vec<SqlValue>> = (0..columns).map(|_| Vec::with_capacity(rows.len())).collect();
    for row in rows {
        transposed.iter_mut().zip(row).for_each(|(column, value)| column.push(value));
    }
    transposed
}

type PostgresQuery<'q> = Query<'q, Postgres, PgArguments>;

/// Binds a column as an array; its values have the type of the first.
fn bind_column(query: PostgresQuery<'_>, column: Vec<SqlValue>) -> Result<PostgresQuery<'_>> {
    macro_rules! array {
        ($variant:ident) => {{
            let value = |value| match value {
                SqlValue::$variant(value) => Ok(value),
                _ => Err(StoreError::Inconsistent("values of two types in one column".into())),
            };
            column.into_iter().map(value).collect::<Result<Vec<_>>>()?
        }};
    }
    Ok(match column.first() {
        Some(SqlValue::Integer(_)) => query.bind(array!(Integer)),
        Some(SqlValue::Real(_)) => query.bind(array!(Real)),
        Some(SqlValue::Text(_)) => {
            let texts = array!(Text);
            query.bind(texts.into_iter().map(|text| text.map(replace_nul)).collect::<Vec<_>>())
        }
        Some(SqlValue::Bytes(_)) => query.bind(array!(Bytes)),
        None => query,
    })
}
