//! The trained arrays of a model file.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::ops::{Index, IndexMut};

use npz::NpzFile;

use super::error::GraceError;

/// The trained arrays by their names in the file.
///
/// Index them by the name of an array that was read, as the maps of matrices have it. [`WeightArrays::get`] is for arrays that a
/// file may lack.
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
    /// Reads the array `key` and returns its shape and values.
    pub fn read<const N: usize>(
        &mut self,
        archive: &NpzFile,
        key: &str,
    ) -> Result<([usize; N], &[f64]), GraceError> {
        let (shape, values) = archive.tensor::<N>(key)?;
        Ok((shape, self.insert(key, &shape, values)))
    }

    /// Reads the array `key`, which must have this shape, and returns its values.
    pub fn read_exactly(
        &mut self,
        archive: &NpzFile,
        key: &str,
        shape: &[usize],
    ) -> Result<&[f64], GraceError> {
        let values = archive.floats(key, shape)?;
        Ok(self.insert(key, shape, values))
    }

    fn insert(&mut self, key: &str, shape: &[usize], values: Vec<f64>) -> &[f64] {
        let array = WeightArray { shape: shape.to_vec(), values };
        let found = match self.arrays.entry(key.to_owned()) {
            Entry::Vacant(place) => place.insert(array),
            Entry::Occupied(place) => {
                let found = place.into_mut();
                *found = array;
                found
            }
        };
        &found.values
    }

    /// The values of an array; `None` if it was not read.
    pub fn get(&self, key: &str) -> Option<&[f64]> {
        self.arrays.get(key).map(|array| &array.values[..])
    }

    /// The same, to be changed.
    pub fn get_mut(&mut self, key: &str) -> Option<&mut [f64]> {
        self.arrays.get_mut(key).map(|array| &mut array.values[..])
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

impl Index<&str> for WeightArrays {
    type Output = [f64];

    fn index(&self, key: &str) -> &[f64] {
        self.get(key).unwrap_or_else(|| panic!("the array '{key}' was not read"))
    }
}

impl IndexMut<&str> for WeightArrays {
    fn index_mut(&mut self, key: &str) -> &mut [f64] {
        self.get_mut(key).unwrap_or_else(|| panic!("the array '{key}' was not read"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arrays() -> WeightArrays {
        let mut arrays = WeightArrays::default();
        assert_eq!(arrays.insert("a", &[2], vec![1.0, 2.0]), [1.0, 2.0]);
        arrays
    }

    #[test]
    fn an_array_is_found_by_its_name() {
        let mut arrays = arrays();
        arrays["a"][1] = 3.0;
        assert_eq!(&arrays["a"], [1.0, 3.0]);
        assert_eq!(arrays.get("a"), Some(&[1.0, 3.0][..]));
        assert_eq!(arrays.insert("a", &[1], vec![4.0]), [4.0]);
        assert_eq!(arrays.count(), 1);
    }

    #[test]
    fn an_array_that_was_not_read_is_not_empty() {
        let mut arrays = arrays();
        assert_eq!(arrays.get("b"), None);
        assert_eq!(arrays.get_mut("b"), None);
    }

    #[test]
    #[should_panic = "the array 'b' was not read"]
    fn a_map_names_arrays_that_were_read() {
        let _ = &arrays()["b"];
    }
}
