//! The trained arrays of a model file.

use std::collections::BTreeMap;

use npz::NpzFile;

use super::error::GraceError;

/// The trained arrays by their names in the file.
#[derive(Clone, Debug, Default)]
pub(super) struct WeightArrays {
    arrays: BTreeMap<String, WeightArray>,
    /// Further names of arrays in the file, each with the name here.
    pub aliases: Vec<(String, String)>,
}

/// One of them, row-major.
#[derive(Clone, Debug)]
pub(super) struct WeightArray {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

impl WeightArrays {
    /// Reads the array `key` and returns its shape.
    pub fn read<const N: usize>(&mut self, archive: &NpzFile, key: &str) -> Result<[usize; N], GraceError> {
        let (shape, values) = archive.tensor::<N>(key)?;
        self.arrays.insert(key.to_owned(), WeightArray { shape: shape.to_vec(), values });
        Ok(shape)
    }

    /// Reads the array `key`, which must have this shape.
    pub fn read_exactly(&mut self, archive: &NpzFile, key: &str, shape: &[usize]) -> Result<(), GraceError> {
        let values = archive.floats(key, shape)?;
        self.arrays.insert(key.to_owned(), WeightArray { shape: shape.to_vec(), values });
        Ok(())
    }

    /// The values of an array; empty if it was not read.
    pub fn get(&self, key: &str) -> &[f64] {
        self.arrays.get(key).map_or(&[], |array| &array.values)
    }

    /// The same, to be changed.
    pub fn get_mut(&mut self, key: &str) -> &mut [f64] {
        self.arrays.get_mut(key).map_or(&mut [], |array| &mut array.values)
    }

    /// All arrays in the order of their names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &WeightArray)> {
        self.arrays.iter().map(|(name, array)| (name.as_str(), array))
    }

    /// The values of all arrays, to be changed.
    pub fn values_mut(&mut self) -> impl Iterator<Item = &mut [f64]> {
        self.arrays.values_mut().map(|array| &mut array.values[..])
    }

    /// Adds the arrays of another part of the model.
    pub fn append(&mut self, mut other: Self) {
        self.arrays.append(&mut other.arrays);
        self.aliases.append(&mut other.aliases);
    }

    /// Number of weights.
    pub fn count(&self) -> usize {
        self.arrays.values().map(|array| array.values.len()).sum()
    }
}
