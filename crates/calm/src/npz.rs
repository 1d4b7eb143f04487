//! Arrays of an `.npz` archive, with every size checked against the data before it is used.

use std::fs::File;
use std::io::{BufReader, ErrorKind, Read};
use std::path::{Path, PathBuf};

use npyz::npz::NpzArchive;
use npyz::{DType, Deserialize, NpyFile, Order};

use crate::artifact::ArtifactError;

/// Digits that a shape may have in all: the product of its extents then fits 64 bits.
const SHAPE_DIGITS: usize = 18;

/// An open archive and the path that errors name.
pub(crate) struct Archive {
    path: PathBuf,
    zip: NpzArchive<BufReader<File>>,
}

/// An array of numbers, as `f64` whatever it was on disk.
pub(crate) struct Array {
    pub shape: Vec<usize>,
    pub numbers: Vec<f64>,
}

impl Archive {
    pub fn open(path: &Path) -> Result<Self, ArtifactError> {
        let opened = match path.is_dir() {
            true => Err(ErrorKind::IsADirectory.into()),
            false => NpzArchive::open(path),
        };
        let zip = opened.map_err(|source| ArtifactError::Open { path: path.to_path_buf(), source })?;
        Ok(Self { path: path.to_path_buf(), zip })
    }

    /// An error about a key of this file.
    pub fn invalid(&self, key: &str, found: impl ToString, expected: impl ToString) -> ArtifactError {
        ArtifactError::Invalid {
            path: self.path.clone(),
            key: key.to_owned(),
            found: found.to_string(),
            expected: expected.to_string(),
        }
    }

    pub fn contains(&self, key: &str) -> bool {
        self.zip.array_names().any(|name| name == key)
    }

    /// Numbers of any usual type; an error if the key is missing.
    pub fn array(&mut self, key: &str) -> Result<Array, ArtifactError> {
        let bytes = self.entry(key)?;
        let (file, shape) = self.header(key, &bytes)?;
        let numbers = match type_of(&file).as_str() {
            "f4" => values::<f32>(file, f64::from),
            "f8" => values::<f64>(file, |value| value),
            "i4" => values::<i32>(file, f64::from),
            "i8" => values::<i64>(file, |value| value as f64),
            "b1" => values::<bool>(file, f64::from),
            found => {
                return Err(self.invalid(key, format!("type {found}"), "numbers (f4, f8, i4, i8 or b1)"));
            }
        };
        let numbers = numbers.map_err(|error| self.invalid(key, error, "readable data"))?;
        Ok(Array { shape, numbers })
    }

    /// Numbers of a known shape.
    pub fn shaped(&mut self, key: &str, expected: &[usize]) -> Result<Vec<f64>, ArtifactError> {
        let Array { shape, numbers } = self.array(key)?;
        if shape != expected {
            return Err(self.invalid(key, format!("shape {shape:?}"), format!("shape {expected:?}")));
        }
        Ok(numbers)
    }

    /// One number, stored with shape `()` or `(1,)`.
    pub fn scalar(&mut self, key: &str) -> Result<f64, ArtifactError> {
        let Array { shape, numbers } = self.array(key)?;
        match numbers.as_slice() {
            [number] => Ok(*number),
            _ => Err(self.invalid(key, format!("shape {shape:?}"), "a single number")),
        }
    }

    /// One number that counts something.
    pub fn count(&mut self, key: &str) -> Result<usize, ArtifactError> {
        let found = self.scalar(key)?;
        self.as_count(key, found)
    }

    /// A number as a count.
    pub fn as_count(&self, key: &str, found: f64) -> Result<usize, ArtifactError> {
        if found.fract() == 0.0 && (0.0..=u32::MAX as f64).contains(&found) {
            Ok(found as usize)
        } else {
            Err(self.invalid(key, found, "a whole number that is not negative"))
        }
    }

    /// One number, or `default` if the key is missing.
    pub fn scalar_or(&mut self, key: &str, default: f64) -> Result<f64, ArtifactError> {
        if self.contains(key) { self.scalar(key) } else { Ok(default) }
    }

    /// Text: bytes (`S`) or characters (`U`), without the NUL padding.
    pub fn strings(&mut self, key: &str) -> Result<Vec<String>, ArtifactError> {
        let bytes = self.entry(key)?;
        let (file, _) = self.header(key, &bytes)?;
        let found = type_of(&file);
        let strings: Result<Vec<String>, std::io::Error> = match found.get(..1) {
            Some("U") => file.into_vec::<String>(),
            Some("S") => file.into_vec::<Vec<u8>>().map(|strings| {
                strings.iter().map(|string| String::from_utf8_lossy(string).into_owned()).collect()
            }),
            _ => return Err(self.invalid(key, format!("type {found}"), "text (S or U)")),
        };
        let strings = strings.map_err(|error| self.invalid(key, error, "readable text"))?;
        Ok(strings.iter().map(|string| string.trim_end_matches('\0').to_owned()).collect())
    }

    /// The uncompressed bytes of an entry.
    fn entry(&mut self, key: &str) -> Result<Vec<u8>, ArtifactError> {
        if !self.contains(key) {
            return Err(ArtifactError::Missing { path: self.path.clone(), key: key.to_owned() });
        }
        let mut bytes = Vec::new();
        let read = match self.zip.zip_archive().by_name(&npyz::npz::file_name_from_array_name(key)) {
            Ok(mut file) => file.read_to_end(&mut bytes).map_err(|error| error.to_string()),
            Err(error) => Err(error.to_string()),
        };
        read.map_err(|error| self.invalid(key, error, "a readable array"))?;
        Ok(bytes)
    }

    /// Header and shape of an entry whose data have the length that the header announces.
    fn header<'a>(
        &self,
        key: &str,
        bytes: &'a [u8],
    ) -> Result<(NpyFile<&'a [u8]>, Vec<usize>), ArtifactError> {
        if shape_digits(bytes) > SHAPE_DIGITS {
            return Err(self.invalid(key, "a shape beyond 64 bits", "the shape of a stored array"));
        }
        let file =
            NpyFile::new(bytes).map_err(|error| self.invalid(key, error, "an array in .npy format"))?;
        if file.order() != Order::C && file.shape().len() > 1 {
            return Err(self.invalid(key, "Fortran order", "C order"));
        }
        let shape: Vec<usize> = file.shape().iter().map(|&extent| extent as usize).collect();
        let announced = item_size(&file).and_then(|size| size.checked_mul(file.len()));
        let stored = file.header().clone();
        let data = file.into_inner();
        if announced != Some(data.len() as u64) {
            return Err(self.invalid(
                key,
                format!("{} bytes of data for shape {shape:?}", data.len()),
                "as many as shape and type need",
            ));
        }
        Ok((NpyFile::with_header(stored, data), shape))
    }
}

/// Number of decimal digits between `'shape':` and the closing bracket in the header text.
fn shape_digits(bytes: &[u8]) -> usize {
    let text = &bytes[..bytes.len().min(4096)];
    let key = b"'shape'";
    let Some(start) = text.windows(key.len()).position(|window| window == key) else { return 0 };
    let shape = text.iter().skip(start).take_while(|&&byte| byte != b')');
    shape.filter(|byte| byte.is_ascii_digit()).count()
}

/// The type without its byte order, such as `f8`.
fn type_of(file: &NpyFile<&[u8]>) -> String {
    match file.dtype() {
        DType::Plain(kind) => kind.to_string().trim_start_matches(['<', '>', '|', '=']).to_owned(),
        other => other.descr(),
    }
}

fn item_size(file: &NpyFile<&[u8]>) -> Option<u64> {
    file.dtype().num_bytes().map(|size| size as u64)
}

fn values<T: Deserialize>(file: NpyFile<&[u8]>, to_f64: impl Fn(T) -> f64) -> std::io::Result<Vec<f64>> {
    Ok(file.into_vec::<T>()?.into_iter().map(to_f64).collect())
}
