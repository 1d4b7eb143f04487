//! Reads the frames of a file one at a time, and their labels. Errors name the file.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use atoms::extxyz::{ExtxyzReader, Frame, FrameLabels};
use atoms::{FileError, open_extxyz};
use store::records::{Label, LabelDetails};

/// Reads an extended XYZ file frame by frame.
pub struct XyzReader {
    path: PathBuf,
    reader: ExtxyzReader<BufReader<File>>,
}

impl XyzReader {
    /// Opens the file.
    pub fn open(path: &Path) -> Result<Self, FileError> {
        let reader = ExtxyzReader::new(BufReader::new(open_extxyz(path)?));
        Ok(Self { path: path.to_owned(), reader })
    }
}

impl Iterator for XyzReader {
    type Item = Result<Frame, FileError>;

    fn next(&mut self) -> Option<Self::Item> {
        let frame = self.reader.next()?;
        Some(frame.map_err(|error| FileError::Extxyz {
            path: self.path.clone(),
            line: error.line,
            fault: error.kind,
        }))
    }
}

/// The label of a frame, which must have energy and forces. An error says what is missing or wrong.
pub fn label(frame: &Frame) -> Result<Label, String> {
    match frame
        .labels()
        .map_err(|error| format!("{} is {}, expected {}", error.key, error.found, error.expected))?
    {
        FrameLabels { energy: Some(energy), forces: Some(forces), stress } => {
            Ok(Label { energy, forces, stress, details: LabelDetails::default() })
        }
        FrameLabels { energy, .. } => {
            let missing = if energy.is_none() { "energy" } else { "forces" };
            Err(format!("the frame has no {missing}: expected {missing} or REF_{missing}"))
        }
    }
}
