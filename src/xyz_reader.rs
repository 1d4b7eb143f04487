//! Reads the frames of a file one at a time, and their labels. Errors name the file.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use atoms::extxyz::{ExtxyzReader, Frame, FrameLabels};
use atoms::{FileError, open_extxyz};
use store::records::{Label, LabelDetails};

/// Reads an extended XYZ file frame by frame.
pub struct XyzReader {
    path: PathBuf,
    /// Length of the file, bytes. `None` for a pipe.
    pub length: Option<u64>,
    read: Arc<AtomicU64>,
    reader: ExtxyzReader<Box<dyn BufRead>>,
}

/// Counts the bytes read.
struct Counting(File, Arc<AtomicU64>);

impl XyzReader {
    /// Opens the file.
    pub fn open(path: &Path) -> Result<Self, FileError> {
        let file = open_extxyz(path)?;
        let length = file.metadata().ok().filter(|found| found.is_file()).map(|found| found.len());
        let read = Arc::new(AtomicU64::new(0));
        let input: Box<dyn BufRead> = Box::new(BufReader::new(Counting(file, Arc::clone(&read))));
        Ok(Self { path: path.to_owned(), length, read, reader: ExtxyzReader::new(input) })
    }

    /// Bytes read so far.
    pub fn position(&self) -> u64 {
        self.read.load(Ordering::Relaxed)
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

impl Read for Counting {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let count = self.0.read(buffer)?;
        self.1.fetch_add(count as u64, Ordering::Relaxed);
        Ok(count)
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
