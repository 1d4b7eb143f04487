//! Typed, checked access to the arrays of a `kokkos.npz` file.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};

use npyz::npz::{NpzArchive, file_name_from_array_name};
use npyz::{Deserialize, NpyFile, Order, TypeChar};

use super::error::GraceError;

/// Larger arrays than this are taken for damage, bytes.
const LARGEST_ARRAY: u64 = 1 << 30;

/// An open model file. Arrays are read when asked for, and the file remembers which ones were.
pub(super) struct Archive {
    path: PathBuf,
    names: BTreeSet<String>,
    arrays: RefCell<NpzArchive<Cursor<Vec<u8>>>>,
    asked: RefCell<BTreeSet<String>>,
}

/// One array as stored; integers and floats of any width are widened on reading.
pub(super) struct Array<T> {
    pub shape: Vec<usize>,
    pub data: Vec<T>,
}

impl Archive {
    pub fn open(path: &Path) -> Result<Self, GraceError> {
        let bytes =
            std::fs::read(path).map_err(|source| GraceError::Read { path: path.to_owned(), source })?;
        let arrays = NpzArchive::new(Cursor::new(bytes)).map_err(|error| GraceError::Damaged {
            path: path.to_owned(),
            key: None,
            reason: error.to_string(),
        })?;
        let names = arrays.array_names().map(str::to_owned).collect();
        Ok(Self { path: path.to_owned(), names, arrays: arrays.into(), asked: RefCell::default() })
    }

    pub fn has(&self, key: &str) -> bool {
        self.names.contains(key)
    }

    /// Notes that an array needs no reading.
    pub fn ignore(&self, key: &str) {
        self.asked.borrow_mut().insert(key.to_owned());
    }

    /// Names that start with none of `ignored` and were never asked for.
    pub fn not_asked(&self, ignored: &[&str]) -> Vec<&str> {
        let asked = self.asked.borrow();
        let left_over = self.names.iter().filter(|name| !asked.contains(*name));
        left_over.filter(|name| !ignored.iter().any(|i| name.starts_with(i))).map(String::as_str).collect()
    }

    pub fn unsupported(&self, reason: impl Into<String>) -> GraceError {
        GraceError::Unsupported { path: self.path.clone(), reason: reason.into() }
    }

    pub fn mismatch(&self, key: &str, found: impl Into<String>, expected: impl Into<String>) -> GraceError {
        GraceError::Mismatch {
            path: self.path.clone(),
            key: key.to_owned(),
            found: found.into(),
            expected: expected.into(),
        }
    }

    fn damaged(&self, key: &str, reason: impl ToString) -> GraceError {
        GraceError::Damaged { path: self.path.clone(), key: Some(key.to_owned()), reason: reason.to_string() }
    }

    /// The bytes of one array file; reading to the end makes the archive check their checksum.
    fn bytes(&self, key: &str) -> Result<Vec<u8>, GraceError> {
        if !self.has(key) {
            return Err(GraceError::Missing { path: self.path.clone(), key: key.to_owned() });
        }
        self.asked.borrow_mut().insert(key.to_owned());
        let mut arrays = self.arrays.borrow_mut();
        let file = arrays.zip_archive().by_name(&file_name_from_array_name(key));
        let mut bytes = Vec::new();
        let read =
            file.map_err(|error| self.damaged(key, error))?.take(LARGEST_ARRAY + 1).read_to_end(&mut bytes);
        match read {
            Ok(length) if length as u64 > LARGEST_ARRAY => Err(self.damaged(key, "larger than 1 GiB")),
            Ok(_) => Ok(bytes),
            Err(error) => Err(self.damaged(key, error)),
        }
    }

    /// Reads an array of the types `convert` accepts; it gets the type and the file and gives
    /// `None` for a type it does not take.
    fn read<T>(
        &self,
        key: &str,
        expected: &str,
        convert: impl FnOnce(TypeChar, u64, NpyFile<&[u8]>) -> Option<std::io::Result<Vec<T>>>,
    ) -> Result<Array<T>, GraceError> {
        let bytes = self.bytes(key)?;
        let file = NpyFile::new(&bytes[..]).map_err(|error| self.damaged(key, error))?;
        let npyz::DType::Plain(stored) = file.dtype() else {
            return Err(self.mismatch(key, file.dtype().descr(), expected));
        };
        let shape: Vec<usize> =
            file.shape().iter().map(|n| usize::try_from(*n).unwrap_or(usize::MAX)).collect();
        let needed =
            shape.iter().try_fold(stored.num_bytes().unwrap_or(usize::MAX), |a, n| a.checked_mul(*n));
        if needed.is_none_or(|needed| needed > bytes.len()) {
            return Err(self.damaged(key, format!("shape {shape:?} but {} bytes", bytes.len())));
        }
        if shape.len() > 1 && file.order() != Order::C {
            return Err(self.mismatch(key, "in Fortran order", "C order"));
        }
        match convert(stored.type_char(), stored.size_field(), file) {
            Some(Ok(data)) => Ok(Array { shape, data }),
            Some(Err(error)) => Err(self.damaged(key, error)),
            None => Err(self.mismatch(key, format!("of type {stored}"), expected)),
        }
    }

    fn integer_array(&self, key: &str) -> Result<Array<i64>, GraceError> {
        self.read(key, "an array of integers", |kind, size, file| match (kind, size) {
            (TypeChar::Int, 8) => Some(file.into_vec::<i64>()),
            (TypeChar::Int, 4) => Some(widened::<i32, i64>(file)),
            _ => None,
        })
    }

    /// Finite floats, of any shape; integers are taken as well (a cutoff keeps the type of the
    /// training input).
    pub fn float_array(&self, key: &str) -> Result<Array<f64>, GraceError> {
        let array = self.read(key, "an array of numbers", |kind, size, file| match (kind, size) {
            (TypeChar::Float, 8) => Some(file.into_vec::<f64>()),
            (TypeChar::Float, 4) => Some(widened::<f32, f64>(file)),
            (TypeChar::Int, 8) => {
                Some(file.into_vec::<i64>().map(|data| data.into_iter().map(|x| x as f64).collect()))
            }
            (TypeChar::Int, 4) => Some(widened::<i32, f64>(file)),
            _ => None,
        })?;
        match array.data.iter().find(|x| !x.is_finite()) {
            Some(x) => Err(self.mismatch(key, format!("partly {x}"), "finite numbers")),
            None => Ok(array),
        }
    }

    /// Single-precision floats as stored, of exactly this shape.
    pub fn singles(&self, key: &str, shape: &[usize]) -> Result<Vec<f32>, GraceError> {
        let array = self.read(key, "an array of single-precision numbers", |kind, size, file| {
            matches!((kind, size), (TypeChar::Float, 4)).then(|| file.into_vec::<f32>())
        })?;
        self.check_shape(key, &array.shape, shape)?;
        match array.data.iter().find(|x| !x.is_finite()) {
            Some(x) => Err(self.mismatch(key, format!("partly {x}"), "finite numbers")),
            None => Ok(array.data),
        }
    }

    /// Strings of fixed width without their padding.
    pub fn strings(&self, key: &str) -> Result<Vec<String>, GraceError> {
        let array = self.read(key, "an array of byte strings", |kind, _, file| {
            (kind == TypeChar::ByteStr).then(|| file.into_vec::<Vec<u8>>())
        })?;
        let text = |bytes: &Vec<u8>| String::from_utf8_lossy(bytes).trim_end_matches('\0').to_owned();
        Ok(array.data.iter().map(text).collect())
    }

    fn check_shape(&self, key: &str, found: &[usize], expected: &[usize]) -> Result<(), GraceError> {
        if found == expected {
            return Ok(());
        }
        Err(self.mismatch(key, format!("of shape {found:?}"), format!("shape {expected:?}")))
    }

    /// Floats of exactly this shape.
    pub fn floats(&self, key: &str, shape: &[usize]) -> Result<Vec<f64>, GraceError> {
        let array = self.float_array(key)?;
        self.check_shape(key, &array.shape, shape)?;
        Ok(array.data)
    }

    /// `N` dimensions and the floats.
    pub fn tensor<const N: usize>(&self, key: &str) -> Result<([usize; N], Vec<f64>), GraceError> {
        let array = self.float_array(key)?;
        match <[usize; N]>::try_from(&array.shape[..]) {
            Ok(shape) if !array.data.is_empty() => Ok((shape, array.data)),
            _ => Err(self.mismatch(
                key,
                format!("of shape {:?}", array.shape),
                format!("{N} dimensions, none of them empty"),
            )),
        }
    }

    /// One number, of shape () or (1,).
    pub fn float(&self, key: &str) -> Result<f64, GraceError> {
        let array = self.float_array(key)?;
        self.one(key, &array.shape, &array.data)
    }

    /// One number, or `default` where the array is absent.
    pub fn float_or(&self, key: &str, default: f64) -> Result<f64, GraceError> {
        if self.has(key) { self.float(key) } else { Ok(default) }
    }

    fn one<T: Copy>(&self, key: &str, shape: &[usize], data: &[T]) -> Result<T, GraceError> {
        match data {
            [x] => Ok(*x),
            _ => Err(self.mismatch(key, format!("of shape {shape:?}"), "one number")),
        }
    }

    /// One integer from `least` to `most`.
    pub fn count(&self, key: &str, least: usize, most: usize) -> Result<usize, GraceError> {
        let array = self.integer_array(key)?;
        let value = self.one(key, &array.shape, &array.data)?;
        match usize::try_from(value) {
            Ok(count) if (least..=most).contains(&count) => Ok(count),
            _ => Err(self.mismatch(key, value.to_string(), format!("a number from {least} to {most}"))),
        }
    }

    /// One integer that must be `expected`, because other arrays say so.
    pub fn expect_count(&self, key: &str, expected: usize) -> Result<(), GraceError> {
        let array = self.integer_array(key)?;
        let value = self.one(key, &array.shape, &array.data)?;
        if usize::try_from(value) == Ok(expected) {
            return Ok(());
        }
        Err(self.mismatch(key, value.to_string(), expected.to_string()))
    }

    /// An integer flag, `default` where it is absent.
    pub fn flag_or(&self, key: &str, default: bool) -> Result<bool, GraceError> {
        if self.has(key) { Ok(self.count(key, 0, 1)? == 1) } else { Ok(default) }
    }

    /// Indices below `bound`, as many as the array holds.
    pub fn indices(&self, key: &str, bound: usize) -> Result<Vec<usize>, GraceError> {
        let array = self.integer_array(key)?;
        let check = |i: &i64| usize::try_from(*i).ok().filter(|i| *i < bound).ok_or(*i);
        array.data.iter().map(check).collect::<Result<_, _>>().map_err(|i| {
            self.mismatch(
                key,
                format!("a list with the index {i}"),
                format!("indices from 0 to {}", bound as i64 - 1),
            )
        })
    }

    /// `length` indices below `bound`.
    pub fn exactly_indices(&self, key: &str, length: usize, bound: usize) -> Result<Vec<usize>, GraceError> {
        let indices = self.indices(key, bound)?;
        if indices.len() == length {
            return Ok(indices);
        }
        Err(self.mismatch(key, format!("a list of {}", indices.len()), format!("a list of {length}")))
    }
}

fn widened<T: Deserialize, U: From<T>>(file: NpyFile<&[u8]>) -> std::io::Result<Vec<U>> {
    Ok(file.into_vec::<T>()?.into_iter().map(U::from).collect())
}
