//! An array and what can be asked of it.

use crate::error::{ArrayName, Error};

/// An array that was read. The product of the shape is the length of the data.
#[derive(Debug, Clone)]
pub struct Array<T> {
    /// Extents, the last one running fastest; empty for a scalar.
    pub shape: Vec<usize>,
    /// All values.
    pub data: Vec<T>,
    pub(crate) name: ArrayName,
}

impl<T> Array<T> {
    /// The values, if the shape is this one.
    ///
    /// # Errors
    /// If the shape is another.
    pub fn with_shape(self, expected: &[usize]) -> Result<Vec<T>, Error> {
        if self.shape == expected {
            return Ok(self.data);
        }
        Err(self.wrong_shape(format!("shape {expected:?}")))
    }

    /// Extents and values of an array of `N` dimensions.
    ///
    /// # Errors
    /// If there are more or fewer dimensions, or nothing in them.
    pub fn tensor<const N: usize>(self) -> Result<([usize; N], Vec<T>), Error> {
        match <[usize; N]>::try_from(&self.shape[..]) {
            Ok(shape) if !self.data.is_empty() => Ok((shape, self.data)),
            _ => Err(self.wrong_shape(format!("{N} dimensions, none of them empty"))),
        }
    }

    /// The only value, stored with shape `()` or `(1,)`.
    ///
    /// # Errors
    /// If there are more or none.
    pub fn into_scalar(mut self) -> Result<T, Error> {
        match (self.data.pop(), self.data.is_empty()) {
            (Some(value), true) => Ok(value),
            _ => Err(self.wrong_shape("a single number")),
        }
    }

    fn wrong_shape(&self, expected: impl ToString) -> Error {
        self.name.wrong_shape(format!("{:?}", self.shape), expected)
    }
}

impl<T: Copy + Into<f64>> Array<T> {
    /// The array itself, if all its numbers are finite.
    ///
    /// # Errors
    /// Names the first that is not.
    pub fn finite(self) -> Result<Self, Error> {
        match self.data.iter().map(|&value| value.into()).find(|value| !value.is_finite()) {
            Some(value) => Err(self.name.wrong_value(format!("partly {value}"), "finite numbers")),
            None => Ok(self),
        }
    }
}
