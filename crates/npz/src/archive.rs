//! Opens archives and reads their arrays.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufReader, Cursor, ErrorKind, Read, Seek};
use std::path::{Path, PathBuf};

use npyz::npz::{NpzArchive, file_name_from_array_name};
use npyz::{DType, Deserialize, TypeChar, TypeRead};

use crate::array::Array;
use crate::error::{ArrayName, Error};
use crate::header::NpyHeader;

/// Larger arrays count as corrupt, bytes.
const MAX_ARRAY_BYTES: u64 = 1 << 32;

/// An open archive. Arrays are read on demand, and the archive records which ones were read.
pub struct NpzFile<R: Read + Seek = BufReader<File>> {
    path: PathBuf,
    names: BTreeSet<String>,
    zip: RefCell<NpzArchive<R>>,
    requested: RefCell<BTreeSet<String>>,
}

impl NpzFile {
    /// Opens a file.
    ///
    /// # Errors
    /// If it cannot be opened or is not an archive.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let opened = match path.is_dir() {
            true => Err(ErrorKind::IsADirectory.into()),
            false => File::open(path),
        };
        let file = opened.map_err(|source| Error::Open { path: path.to_owned(), source })?;
        Self::read(path, BufReader::new(file))
    }
}

impl<'a> NpzFile<Cursor<&'a [u8]>> {
    /// Reads an archive in memory; errors refer to it as `name`.
    ///
    /// # Errors
    /// If the bytes are not an archive.
    pub fn from_bytes(name: impl AsRef<Path>, bytes: &'a [u8]) -> Result<Self, Error> {
        Self::read(name.as_ref(), Cursor::new(bytes))
    }
}

impl<R: Read + Seek> NpzFile<R> {
    fn read(path: &Path, source: R) -> Result<Self, Error> {
        let zip = NpzArchive::new(source)
            .map_err(|source| Error::NotAnArchive { path: path.to_owned(), source })?;
        let names = zip.array_names().map(str::to_owned).collect();
        Ok(Self { path: path.to_owned(), names, zip: zip.into(), requested: RefCell::default() })
    }

    /// The path, as used in errors.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether the archive has this array.
    pub fn contains(&self, key: &str) -> bool {
        self.names.contains(key)
    }

    /// Names of all arrays, in alphabetical order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.names.iter().map(String::as_str)
    }

    /// Names of the arrays that were neither read nor ignored.
    pub fn unread(&self) -> Vec<&str> {
        let requested = self.requested.borrow();
        self.names().filter(|name| !requested.contains(*name)).collect()
    }

    /// Marks an array as not needed.
    pub fn ignore(&self, key: &str) {
        self.requested.borrow_mut().insert(key.to_owned());
    }

    /// An error about the values of an array.
    pub fn invalid(&self, key: &str, found: impl ToString, expected: impl ToString) -> Error {
        self.array_name(key).wrong_value(found, expected)
    }

    /// Numbers of any common type (floats, integers, booleans) as `f64`.
    ///
    /// # Errors
    /// If the array is missing, corrupt or of another type.
    pub fn numbers(&self, key: &str) -> Result<Array<f64>, Error> {
        let entry = self.entry(key)?;
        match entry.kind() {
            (TypeChar::Float, 8) => entry.decode(|value: f64| value),
            (TypeChar::Float, 4) => entry.decode(|value: f32| f64::from(value)),
            (TypeChar::Int, 8) => entry.decode(|value: i64| value as f64),
            (TypeChar::Int, 4) => entry.decode(|value: i32| f64::from(value)),
            (TypeChar::Bool, _) => entry.decode(|value: bool| f64::from(value)),
            _ => Err(entry.wrong_type("numbers (f4, f8, i4, i8 or b1)")),
        }
    }

    /// Integers.
    ///
    /// # Errors
    /// As [`NpzFile::numbers`].
    pub fn integers(&self, key: &str) -> Result<Array<i64>, Error> {
        let entry = self.entry(key)?;
        match entry.kind() {
            (TypeChar::Int, 8) => entry.decode(|value: i64| value),
            (TypeChar::Int, 4) => entry.decode(|value: i32| i64::from(value)),
            _ => Err(entry.wrong_type("an array of integers (i4 or i8)")),
        }
    }

    /// Single-precision numbers.
    ///
    /// # Errors
    /// As [`NpzFile::numbers`].
    pub fn floats_f32(&self, key: &str) -> Result<Array<f32>, Error> {
        let entry = self.entry(key)?;
        match entry.kind() {
            (TypeChar::Float, 4) => entry.decode(|value: f32| value),
            _ => Err(entry.wrong_type("an array of single-precision numbers (f4)")),
        }
    }

    /// Strings, stored as bytes (`S`) or characters (`U`), without NUL padding.
    ///
    /// # Errors
    /// As [`NpzFile::numbers`].
    pub fn strings(&self, key: &str) -> Result<Vec<String>, Error> {
        let entry = self.entry(key)?;
        let unpadded = |text: &str| text.trim_end_matches('\0').to_owned();
        let array = match entry.kind() {
            (TypeChar::UnicodeStr, _) => entry.decode(|text: String| unpadded(&text)),
            (TypeChar::ByteStr, _) => entry.decode(|text: Vec<u8>| unpadded(&String::from_utf8_lossy(&text))),
            _ => Err(entry.wrong_type("text (S or U)")),
        };
        Ok(array?.data)
    }

    fn array_name(&self, key: &str) -> ArrayName {
        ArrayName { path: self.path.clone(), key: key.to_owned() }
    }

    /// Header and data of an array; the length of the data matches the header.
    ///
    /// Compares the header with the size in the archive before reading any data, and reads the data to their
    /// end, where the archive verifies the checksum.
    fn entry(&self, key: &str) -> Result<StoredArray, Error> {
        let name = self.array_name(key);
        if !self.contains(key) {
            return Err(name.missing());
        }
        self.ignore(key);
        let readable = |error: &dyn ToString| name.damaged(error.to_string(), "a readable array");
        let mut zip = self.zip.borrow_mut();
        let file = zip.zip_archive().by_name(&file_name_from_array_name(key));
        let mut file = file.map_err(|error| readable(&error))?;
        let stored = file.size();
        if stored > MAX_ARRAY_BYTES {
            return Err(name.damaged(format!("{stored} bytes"), "at most 4 GiB"));
        }
        let header = NpyHeader::read(&mut file)
            .map_err(|found| name.damaged(found, "a plain array in .npy format"))?;
        if header.kind.num_bytes().is_none() {
            return Err(name.wrong_type(header.kind, "numbers or text"));
        }
        let stored = stored.saturating_sub(header.length);
        let wrong_length = |stored: u64| {
            let found = format!("{stored} bytes of data for shape {:?} of {}", header.shape, header.kind);
            name.damaged(found, "as many as shape and type need")
        };
        let (items, needed) = header.size().ok_or_else(|| wrong_length(stored))?;
        if needed != stored || (needed == 0 && items > 0) {
            return Err(wrong_length(stored));
        }
        let mut data = Vec::new();
        file.take(needed + 1).read_to_end(&mut data).map_err(|error| readable(&error))?;
        if data.len() as u64 != needed {
            return Err(wrong_length(data.len() as u64));
        }
        if header.fortran_order && header.shape.len() > 1 {
            return Err(name.wrong_shape(format!("{:?} in Fortran order", header.shape), "C order"));
        }
        Ok(StoredArray { name, header, items, data })
    }
}

/// An array as stored.
struct StoredArray {
    name: ArrayName,
    header: NpyHeader,
    items: usize,
    data: Vec<u8>,
}

impl StoredArray {
    fn kind(&self) -> (TypeChar, u64) {
        (self.header.kind.type_char(), self.header.kind.size_field())
    }

    fn wrong_type(&self, expected: &str) -> Error {
        self.name.wrong_type(&self.header.kind, expected)
    }

    fn decode<T: Deserialize, U>(self, convert: impl Fn(T) -> U) -> Result<Array<U>, Error> {
        let Self { name, header, items, data } = self;
        let readable = |error: &dyn ToString| name.damaged(error.to_string(), "readable data");
        let reader = T::reader(&DType::Plain(header.kind)).map_err(|error| readable(&error))?;
        let mut rest = &data[..];
        let values: Result<Vec<U>, _> =
            (0..items).map(|_| reader.read_one(&mut rest).map(&convert)).collect();
        let data = values.map_err(|error| readable(&error))?;
        Ok(Array { shape: header.shape, data, name })
    }
}
