//! Values bound to a query.

use std::borrow::Cow;

use sqlx::postgres::PgArguments;
use sqlx::query::Query;
use sqlx::sqlite::SqliteArguments;
use sqlx::{Postgres, Sqlite};

use super::row::SqlRow;
use crate::error::Result;

/// A value of a type that both databases have. `None` is NULL.
#[derive(Clone, Debug, PartialEq)]
pub enum SqlValue {
    Integer(Option<i64>),
    /// NaN is stored as NULL, as in SQLite.
    Real(Option<f64>),
    Text(Option<String>),
    Bytes(Option<Vec<u8>>),
}

/// The type of a column.
#[derive(Clone, Copy, Debug)]
pub enum ColumnType {
    /// BIGINT.
    Integer,
    /// DOUBLE PRECISION.
    Real,
    /// TEXT.
    Text,
    /// BYTEA.
    Bytes,
}

impl ColumnType {
    /// The value of a column of this type.
    pub fn read(self, row: &SqlRow, name: &str) -> Result<SqlValue> {
        Ok(match self {
            Self::Integer => SqlValue::Integer(row.get(name)?),
            Self::Real => SqlValue::Real(row.get(name)?),
            Self::Text => SqlValue::Text(row.get(name)?),
            Self::Bytes => SqlValue::Bytes(row.get(name)?),
        })
    }
}

impl SqlValue {
    pub(super) fn bind_sqlite(
        self,
        query: Query<'_, Sqlite, SqliteArguments>,
    ) -> Query<'_, Sqlite, SqliteArguments> {
        match self {
            Self::Integer(value) => query.bind(value),
            Self::Real(value) => query.bind(value),
            Self::Text(value) => query.bind(value),
            Self::Bytes(value) => query.bind(value),
        }
    }

    pub(super) fn bind_postgres(
        self,
        query: Query<'_, Postgres, PgArguments>,
    ) -> Query<'_, Postgres, PgArguments> {
        match self {
            Self::Integer(value) => query.bind(value),
            Self::Real(value) => query.bind(value),
            Self::Text(value) => query.bind(value.map(replace_nul)),
            Self::Bytes(value) => query.bind(value),
        }
    }

    /// Its approximate size in bytes.
    pub(super) fn len(&self) -> usize {
        match self {
            Self::Integer(_) | Self::Real(_) => 8,
            Self::Text(text) => text.as_ref().map_or(0, String::len),
            Self::Bytes(bytes) => bytes.as_ref().map_or(0, Vec::len),
        }
    }
}

/// Replaces NUL characters: PostgreSQL rejects them in text, and the output of programs may contain some.
pub fn replace_nul(text: String) -> String {
    if text.contains('\0') { text.replace('\0', "\u{fffd}") } else { text }
}

macro_rules! values {
    ($($from:ty => $variant:ident, $convert:expr;)*) => {$(
        impl From<$from> for SqlValue {
            fn from(value: $from) -> Self {
                Self::from(Some(value))
            }
        }
        impl From<Option<$from>> for SqlValue {
            fn from(value: Option<$from>) -> Self {
                Self::$variant(value.map($convert))
            }
        }
    )*};
}

values! {
    i64 => Integer, |value| value;
    i32 => Integer, i64::from;
    u32 => Integer, i64::from;
    bool => Integer, i64::from;
    String => Text, |value| value;
    &str => Text, str::to_owned;
    &String => Text, String::clone;
    Cow<'_, str> => Text, Cow::into_owned;
    Vec<u8> => Bytes, |value| value;
    &[u8] => Bytes, <[u8]>::to_vec;
}

impl From<f64> for SqlValue {
    fn from(value: f64) -> Self {
        Self::from(Some(value))
    }
}

impl From<Option<f64>> for SqlValue {
    fn from(value: Option<f64>) -> Self {
        Self::Real(value.filter(|value| !value.is_nan()))
    }
}
