//! An array of an archive.

use crate::error::{ArrayName, Error};

/// An array. The product of the shape equals the length of the data.
#[derive(Debug, Clone)]
pub struct Array<T> {
    /// Dimensions, last one fastest; empty for a scalar.
    pub shape: Vec<usize>,
    /// All values.
    pub data: Vec<T>,
    pub(crate) name: ArrayName,
}

impl<T> Array<T> {
    /// The values, if the array has this shape.
    ///
    /// # Errors
    /// If it has another shape.
    pub fn with_shape(self, expected: &[usize]) -> Result<Vec<T>, Error> {
        if self.shape == expected {
            return Ok(self.data);
        }
        Err(self.wrong_shape(format!("shape {expected:?}")))
    }

    /// Shape and values of an array with `N` dimensions.
    ///
    /// # Errors
    /// If it has another number of dimensions or is empty.
    pub fn tensor<const N: usize>(self) -> Result<([usize; N], Vec<T>), Error> {
        match <[usize; N]>::try_from(&self.shape[..]) {
            Ok(shape) if !self.data.is_empty() => Ok((shape, self.data)),
            _ => Err(self.wrong_shape(format!("{N} dimensions, none of them empty"))),
        }
    }

    /// The only value, of shape `()` or `(1,)`.
    ///
    /// # Errors
    /// If there is not exactly one value.
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
    /// The array, if all values are finite.
    ///
    /// # Errors
    /// Names the first value that is not finite.
    pub fn finite(self) -> Result<Self, Error> {
        match self.data.iter().map(|&value| value.into()).find(|value| !value.is_finite()) {
            Some(value) => Err(self.name.wrong_value(format!("partly {value}"), "finite numbers")),
            None => Ok(self),
        }
    }
}
