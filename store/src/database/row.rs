//! Results of queries.

use sqlx::postgres::PgRow;
use sqlx::sqlite::SqliteRow;
use sqlx::{ColumnIndex, Row as _};

use crate::error::{Result, StoreError};

/// A row of either database.
pub enum SqlRow {
    Sqlite(SqliteRow),
    Postgres(PgRow),
}

/// The name of a column, or its index from 0.
pub trait Index: ColumnIndex<SqliteRow> + ColumnIndex<PgRow> + std::fmt::Display + Copy {}
impl<I: ColumnIndex<SqliteRow> + ColumnIndex<PgRow> + std::fmt::Display + Copy> Index for I {}

/// A type that a column can be read as.
pub trait FromColumn: Sized {
    fn from_column(row: &SqlRow, index: impl Index) -> Result<Self>;
}

/// A type that a row can be read as: a struct, a tuple, or a single column.
pub trait FromRow: Sized {
    fn from_row(row: &SqlRow) -> Result<Self>;
}

impl SqlRow {
    /// The value of a column.
    pub fn get<T: FromColumn>(&self, index: impl Index) -> Result<T> {
        T::from_column(self, index)
    }

    /// A text, in place.
    pub fn text(&self, index: impl Index) -> Result<Option<&str>> {
        Ok(match self {
            Self::Sqlite(row) => row.try_get(index)?,
            Self::Postgres(row) => row.try_get(index)?,
        })
    }

    /// Bytes, in place.
    pub fn bytes(&self, index: impl Index) -> Result<Option<&[u8]>> {
        Ok(match self {
            Self::Sqlite(row) => row.try_get(index)?,
            Self::Postgres(row) => row.try_get(index)?,
        })
    }

    /// The index of the first column with a name.
    pub fn place(&self, name: &str) -> Result<usize> {
        Ok(match self {
            Self::Sqlite(row) => ColumnIndex::index(&name, row)?,
            Self::Postgres(row) => ColumnIndex::index(&name, row)?,
        })
    }

    /// The value of a column that tables of earlier versions lack.
    pub fn get_or_default<T: FromColumn + Default>(&self, name: &str) -> Result<T> {
        if self.has_column(name) { self.get(name) } else { Ok(T::default()) }
    }

    /// The value of a column that tables of earlier versions call `former`, or lack.
    pub fn get_renamed<T: FromColumn + Default>(&self, name: &str, former: &str) -> Result<T> {
        self.get_or_default(if self.has_column(name) { name } else { former })
    }

    fn has_column(&self, name: &str) -> bool {
        match self {
            Self::Sqlite(row) => row.try_column(name).is_ok(),
            Self::Postgres(row) => row.try_column(name).is_ok(),
        }
    }
}

macro_rules! columns {
    ($($type:ty),*) => {$(
        columns!(@ $type, $type);
        columns!(@ $type, Option<$type>);
    )*};
    (@ $type:ty, $read:ty) => {
        impl FromColumn for $read {
            fn from_column(row: &SqlRow, index: impl Index) -> Result<Self> {
                Ok(match row {
                    SqlRow::Sqlite(row) => row.try_get(index)?,
                    SqlRow::Postgres(row) => row.try_get(index)?,
                })
            }
        }
    };
}
columns!(i64, f64, String, Vec<u8>, bool);

macro_rules! small_integers {
    ($($type:ty),*) => {$(
        impl FromColumn for $type {
            fn from_column(row: &SqlRow, index: impl Index) -> Result<Self> {
                Option::from_column(row, index)?.ok_or_else(|| StoreError::damaged("a row", format!("{index} is NULL")))
            }
        }
        impl FromColumn for Option<$type> {
            fn from_column(row: &SqlRow, index: impl Index) -> Result<Self> {
                let absurd = |number| StoreError::damaged("a row", format!("{index} is {number}"));
                let number: Option<i64> = row.get(index)?;
                number.map(|number| number.try_into().map_err(|_| absurd(number))).transpose()
            }
        }
    )*};
}
small_integers!(u32, u64, i32);

macro_rules! only_column {
    ($($type:ty),*) => {$(
        impl FromRow for $type {
            fn from_row(row: &SqlRow) -> Result<Self> {
                row.get(0)
            }
        }
    )*};
}
only_column!(i64, u32, u64, bool, String, Option<String>, Vec<u8>);

macro_rules! tuples {
    ($(($($type:ident $place:literal),*))*) => {$(
        impl<$($type: FromColumn),*> FromRow for ($($type,)*) {
            fn from_row(row: &SqlRow) -> Result<Self> {
                Ok(($(row.get::<$type>($place)?,)*))
            }
        }
    )*};
}
tuples! {
    (A 0, B 1)
    (A 0, B 1, C 2)
    (A 0, B 1, C 2, D 3)
}

/// Reads a struct from the columns with the names of its fields.
macro_rules! from_columns {
    ($type:ty { $($field:ident),* $(,)? }) => {
        impl $crate::database::FromRow for $type {
            fn from_row(row: &$crate::database::SqlRow) -> $crate::error::Result<Self> {
                Ok(Self { $($field: row.get(stringify!($field))?,)* })
            }
        }
    };
}
pub(crate) use from_columns;
