//! A few numbers of an `.npz` archive that only people want to know.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use npyz::npz::{NpzArchive, file_name_from_array_name};
use npyz::{DType, NpyFile};

use crate::cli::Failure;

/// Arrays of more bytes than this are left alone.
const LARGEST: u64 = 1 << 22;

/// An open archive.
pub struct Archive(NpzArchive<BufReader<File>>);

impl Archive {
    /// Opens it.
    pub fn open(path: &Path) -> Result<Self, Failure> {
        let cannot = |error| {
            Failure::Input(format!(
                "{}: {error}; expected a NumPy .npz archive (kokkos.npz or gmm_artifacts.npz)",
                path.display()
            ))
        };
        NpzArchive::open(path).map(Self).map_err(cannot)
    }

    /// Whether it holds an array of that name.
    pub fn has(&self, key: &str) -> bool {
        self.0.array_names().any(|name| name == key)
    }

    /// A small array of numbers; none if it is absent, large, damaged or of another type.
    pub fn numbers(&mut self, key: &str) -> Option<Vec<f64>> {
        let bytes = self.small_entry(key)?;
        let file = NpyFile::new(&bytes[..]).ok()?;
        match letters(&file).as_str() {
            "f4" => Some(file.into_vec::<f32>().ok()?.into_iter().map(f64::from).collect()),
            "f8" => file.into_vec::<f64>().ok(),
            "i4" => Some(file.into_vec::<i32>().ok()?.into_iter().map(f64::from).collect()),
            "i8" => Some(file.into_vec::<i64>().ok()?.into_iter().map(|x| x as f64).collect()),
            _ => None,
        }
    }

    /// A single number.
    pub fn number(&mut self, key: &str) -> Option<f64> {
        match self.numbers(key)?[..] {
            [number] => Some(number),
            _ => None,
        }
    }

    /// A single text.
    pub fn text(&mut self, key: &str) -> Option<String> {
        let bytes = self.small_entry(key)?;
        let file = NpyFile::new(&bytes[..]).ok()?;
        if file.len() != 1 || !letters(&file).starts_with('U') {
            return None;
        }
        file.into_vec::<String>().ok()?.pop().map(|text| text.trim_end_matches('\0').to_owned())
    }

    /// The bytes of an array, if they are not too many and its header announces no more than there are.
    fn small_entry(&mut self, key: &str) -> Option<Vec<u8>> {
        let mut bytes = Vec::new();
        let entry = self.0.zip_archive().by_name(&file_name_from_array_name(key)).ok()?;
        entry.take(LARGEST).read_to_end(&mut bytes).ok()?;
        let header = String::from_utf8_lossy(bytes.get(..bytes.len().min(1024))?).into_owned();
        let shape = header.split_once("'shape': (")?.1.split_once(')')?.0;
        let extents = shape.split(',').map(str::trim).filter(|extent| !extent.is_empty());
        let numbers = extents
            .map(|extent| extent.parse().ok())
            .try_fold(1_usize, |n, extent| n.checked_mul(extent?))?;
        (numbers < bytes.len()).then_some(bytes)
    }
}

/// The type without its byte order, such as `f8`.
fn letters(file: &NpyFile<&[u8]>) -> String {
    match file.dtype() {
        DType::Plain(kind) => kind.to_string().trim_start_matches(['<', '>', '|', '=']).to_owned(),
        other => other.descr(),
    }
}
