//! Accessors that check values: finite numbers, counts and indices.

use std::io::{Read, Seek};

use crate::{Error, NpzFile};

impl<R: Read + Seek> NpzFile<R> {
    /// Finite numbers of this shape.
    ///
    /// # Errors
    /// As [`NpzFile::numbers`], and if the shape differs or a number is not finite.
    pub fn floats(&self, key: &str, shape: &[usize]) -> Result<Vec<f64>, Error> {
        self.numbers(key)?.finite()?.with_shape(shape)
    }

    /// Shape and finite numbers of a non-empty array with `N` dimensions.
    ///
    /// # Errors
    /// As [`NpzFile::floats`].
    pub fn tensor<const N: usize>(&self, key: &str) -> Result<([usize; N], Vec<f64>), Error> {
        self.numbers(key)?.finite()?.tensor()
    }

    /// One finite number, of shape `()` or `(1,)`.
    ///
    /// # Errors
    /// As [`NpzFile::floats`].
    pub fn scalar(&self, key: &str) -> Result<f64, Error> {
        self.numbers(key)?.finite()?.into_scalar()
    }

    /// One finite number, or `default` if the array is absent.
    ///
    /// # Errors
    /// As [`NpzFile::floats`].
    pub fn scalar_or(&self, key: &str, default: f64) -> Result<f64, Error> {
        if self.contains(key) { self.scalar(key) } else { Ok(default) }
    }

    /// One integer from `min` to `max`.
    ///
    /// # Errors
    /// As [`NpzFile::integers`], and if there is not exactly one integer within these bounds.
    pub fn count(&self, key: &str, min: usize, max: usize) -> Result<usize, Error> {
        let value = self.integers(key)?.into_scalar()?;
        match usize::try_from(value) {
            Ok(count) if (min..=max).contains(&count) => Ok(count),
            _ => Err(self.invalid(key, value, format!("a number from {min} to {max}"))),
        }
    }

    /// One integer that must equal `expected`, which other arrays determine.
    ///
    /// # Errors
    /// As [`NpzFile::count`].
    pub fn expect_count(&self, key: &str, expected: usize) -> Result<(), Error> {
        let value = self.integers(key)?.into_scalar()?;
        if usize::try_from(value) == Ok(expected) {
            return Ok(());
        }
        Err(self.invalid(key, value, expected))
    }

    /// A flag, 0 or 1; `default` if absent.
    ///
    /// # Errors
    /// As [`NpzFile::count`].
    pub fn flag_or(&self, key: &str, default: bool) -> Result<bool, Error> {
        if self.contains(key) { Ok(self.count(key, 0, 1)? == 1) } else { Ok(default) }
    }

    /// Indices below `bound`, any number of them.
    ///
    /// # Errors
    /// As [`NpzFile::integers`], and if an index is not below the bound.
    pub fn indices(&self, key: &str, bound: usize) -> Result<Vec<usize>, Error> {
        let check = |i: &i64| usize::try_from(*i).ok().filter(|i| *i < bound).ok_or(*i);
        self.integers(key)?.data.iter().map(check).collect::<Result<_, _>>().map_err(|i| {
            let expected = match bound.checked_sub(1) {
                Some(last) => format!("indices from 0 to {last}"),
                None => "no index".to_owned(),
            };
            self.invalid(key, format!("a list with the index {i}"), expected)
        })
    }

    /// `length` indices below `bound`.
    ///
    /// # Errors
    /// As [`NpzFile::indices`], and if the number of indices differs.
    pub fn exactly_indices(&self, key: &str, length: usize, bound: usize) -> Result<Vec<usize>, Error> {
        let indices = self.indices(key, bound)?;
        if indices.len() == length {
            return Ok(indices);
        }
        Err(self.invalid(key, format!("a list of {}", indices.len()), format!("a list of {length}")))
    }
}
