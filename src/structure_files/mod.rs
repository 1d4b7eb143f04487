//! Structures from files that a command line names: several formats, packed or not, and a filter.

mod arguments;
mod format;
mod reader;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use atoms::Species;
use atoms::extxyz::Frame;

pub use self::arguments::{StructureArgs, StructureReadingArgs};
#[cfg(test)]
pub use self::format::Structures;
pub use self::format::is_plain_extxyz;
pub use self::reader::{FileLine, StructureReader};
use crate::exit_status::CommandError;
use crate::filter::StructureFilter;

/// The key of a frame with the weight of its structure, as `calmwalk calm sample` writes it.
pub const FRAME_WEIGHT: &str = "calmwalk_weight";

/// Files of structures, in order.
#[derive(Debug, Clone)]
pub struct StructureFiles {
    pub files: Vec<StructureFile>,
    /// Structures that do not match are left out.
    pub filter: Option<StructureFilter>,
    /// Elements of the atom types of LAMMPS dumps, from type 1.
    pub dump_elements: Vec<Species>,
}

/// One of them.
#[derive(Debug, Clone)]
pub struct StructureFile {
    pub path: Arc<Path>,
    /// Weight of the atoms of its structures, where a command has weights; otherwise 1.
    pub weight: f64,
}

impl StructureFile {
    /// The weight of a structure of this file: the file's times that of the frame ([`FRAME_WEIGHT`]), which is 1 without the key.
    ///
    /// # Errors
    /// A weight of the frame that is negative or not finite.
    pub fn weight_of(&self, frame: &Frame) -> Result<f64, CommandError> {
        let Some(value) = frame.info.get(FRAME_WEIGHT) else { return Ok(self.weight) };
        let weight = value.number().filter(|weight| *weight >= 0.0).map(|weight| weight * self.weight);
        weight.filter(|weight| weight.is_finite()).ok_or_else(|| {
            FileLine { file: Arc::clone(&self.path), line: frame.line }
                .wrong(format_args!("{FRAME_WEIGHT} is {value}; expected a number, 0 or more"))
        })
    }
}

impl StructureFiles {
    /// Begins with the first file; `bytes` counts what is read of all of them.
    pub fn reader(&self, bytes: Arc<AtomicU64>) -> StructureReader {
        StructureReader::new(self.clone(), bytes)
    }

    /// Sets the weights of some of the files.
    ///
    /// # Errors
    /// A file that is not one of these, or that is given twice.
    pub fn set_weights(&mut self, weights: &[(PathBuf, f64)]) -> Result<(), CommandError> {
        for (number, (path, weight)) in weights.iter().enumerate() {
            if weights[..number].iter().any(|(other, _)| other == path) {
                return Err(CommandError::Input(format!("--weight {}: given twice", path.display())));
            }
            let file = self.files.iter_mut().find(|file| *file.path == **path);
            let unknown = || {
                CommandError::Input(format!("--weight {}: expected one of the files of DATA", path.display()))
            };
            file.ok_or_else(unknown)?.weight = *weight;
        }
        Ok(())
    }

    /// Total size of the files, bytes.
    pub fn total_bytes(&self) -> Result<u64, CommandError> {
        let size = |file: &StructureFile| std::fs::metadata(&file.path).map(|found| found.len());
        self.files.iter().map(size).sum::<io::Result<u64>>().map_err(CommandError::failed)
    }

    /// The paths, for messages and for checks that no output replaces an input.
    pub fn paths(&self) -> impl Iterator<Item = &Path> {
        self.files.iter().map(|file| &*file.path)
    }
}

/// Parser of an argument `FILE=W` with the weight of a file.
pub fn file_weight(text: &str) -> Result<(PathBuf, f64), String> {
    let expected = || "expected FILE=W with a number W, 0 or more".to_owned();
    let (file, weight) = text.rsplit_once('=').ok_or_else(expected)?;
    let weight = weight.parse().ok().filter(|weight: &f64| weight.is_finite() && *weight >= 0.0);
    weight.map(|weight| (file.into(), weight)).ok_or_else(expected)
}

#[cfg(test)]
mod tests {
    use atoms::extxyz::ExtxyzValue;
    use atoms::{Cell, Structure};

    use super::*;

    #[test]
    fn the_weight_of_a_structure_is_that_of_its_file_and_frame() {
        let file = StructureFile { path: Path::new("a.xyz").into(), weight: 0.5 };
        let cell = Cell([[0.0; 3]; 3]);
        let structure = Structure { species: Vec::new(), positions: Vec::new(), cell, periodic: [false; 3] };
        let mut frame = Frame { line: 7, ..Frame::from(structure) };
        assert_eq!(file.weight_of(&frame).unwrap(), 0.5);
        frame.info.insert(FRAME_WEIGHT.to_owned(), ExtxyzValue::from(3.0));
        assert_eq!(file.weight_of(&frame).unwrap(), 1.5);
        frame.info.insert(FRAME_WEIGHT.to_owned(), ExtxyzValue::from(4_i64));
        assert_eq!(file.weight_of(&frame).unwrap(), 2.0);
        for wrong in [ExtxyzValue::from(-1.0), f64::INFINITY.into(), "much".into()] {
            frame.info.insert(FRAME_WEIGHT.to_owned(), wrong);
            let error = file.weight_of(&frame).unwrap_err().to_string();
            assert!(
                error.starts_with("a.xyz:7: calmwalk_weight is ") && error.contains("expected"),
                "{error}"
            );
        }
    }
}
