//! Reads the structures of all files, one after another.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use atoms::FileError;
use atoms::extxyz::{Frame, LabelError};

use super::format::Structures;
use super::{StructureFile, StructureFiles};
use crate::exit_status::CommandError;
use crate::filter::{StructureFilter, StructureProperties};

/// Reads one structure after another.
pub struct StructureReader {
    given: StructureFiles,
    files: VecDeque<StructureFile>,
    current: Option<(StructureFile, Structures)>,
    bytes: Arc<AtomicU64>,
    /// Structures of the current file.
    in_file: u64,
    matching: u64,
    left_out: u64,
    /// Whether an error ended it.
    failed: bool,
}

/// File and line of a structure.
#[derive(Debug, Clone)]
pub struct FileLine {
    pub file: Arc<Path>,
    /// From 1.
    pub line: usize,
}

impl std::fmt::Display for FileLine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}:{}", self.file.display(), self.line)
    }
}

impl FileLine {
    /// Wrong input, which names file and line.
    pub fn wrong(&self, reason: impl std::fmt::Display) -> CommandError {
        CommandError::Input(format!("{self}: {reason}"))
    }
}

impl StructureReader {
    pub(super) fn new(given: StructureFiles, bytes: Arc<AtomicU64>) -> Self {
        let files = given.files.iter().cloned().collect();
        Self { given, files, current: None, bytes, in_file: 0, matching: 0, left_out: 0, failed: false }
    }

    /// The next structure that matches the filter, with its file; `None` at the end of the last file and after an error. Threads that
    /// share a reader find one error, the one that names the place.
    ///
    /// # Errors
    /// A file that cannot be read or has no structures; labels that the filter cannot read; a filter that no structure of all files
    /// matches.
    pub fn next(&mut self) -> Result<Option<(Frame, StructureFile)>, CommandError> {
        if self.failed {
            return Ok(None);
        }
        let next = self.read_next();
        self.failed = next.is_err();
        next
    }

    fn read_next(&mut self) -> Result<Option<(Frame, StructureFile)>, CommandError> {
        while self.current.is_some() || self.open_next()? {
            let Some((file, structures)) = &mut self.current else { continue };
            let Some(frame) = structures.next(&file.path) else {
                if self.in_file == 0 {
                    return Err(CommandError::input(FileError::Empty(file.path.to_path_buf())));
                }
                self.current = None;
                continue;
            };
            let frame = frame?;
            self.in_file += 1;
            if matches(self.given.filter.as_ref(), &frame, file)? {
                self.matching += 1;
                return Ok(Some((frame, file.clone())));
            }
            self.left_out += 1;
        }
        match &self.given.filter {
            Some(filter) if self.matching == 0 => {
                Err(CommandError::Input(format!("no structure of the files matches --where '{filter}'")))
            }
            _ => Ok(None),
        }
    }

    /// Index of the file of the structure that came last among the files given, from 0.
    pub fn file_index(&self) -> usize {
        (self.given.files.len() - self.files.len()).saturating_sub(1)
    }

    /// Index of the structure that came last in its file, from 0; those that did not match the filter count.
    pub fn frame_index(&self) -> u64 {
        self.in_file.saturating_sub(1)
    }

    /// Number of structures that did not match the filter.
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Opens the next file; false after the last one.
    fn open_next(&mut self) -> Result<bool, CommandError> {
        let Some(file) = self.files.pop_front() else { return Ok(false) };
        self.in_file = 0;
        let structures = Structures::open(&file.path, &self.given.dump_elements, &self.bytes)?;
        self.current = Some((file, structures));
        Ok(true)
    }
}

/// Whether a structure matches the filter.
fn matches(
    filter: Option<&StructureFilter>,
    frame: &Frame,
    file: &StructureFile,
) -> Result<bool, CommandError> {
    let Some(filter) = filter else { return Ok(true) };
    let wrong = |error: LabelError| CommandError::Input(format!("{}: {error}", file.path.display()));
    let names = filter.names();
    // Wrong labels that the filter does not name are none of its business.
    let energy = if names.iter().any(|name| ["energy", "energy_per_atom"].contains(name)) {
        frame.energy_label().map_err(wrong)?
    } else {
        None
    };
    let forces = if names.contains(&"max_force") { frame.force_labels().map_err(wrong)? } else { None };
    let norm = |force: &[f64; 3]| force.iter().map(|x| x * x).sum::<f64>().sqrt();
    let properties = StructureProperties {
        species: &frame.structure.species,
        energy,
        max_force: forces.map(|forces| forces.iter().map(norm).fold(0.0, f64::max)),
        ..StructureProperties::default()
    };
    Ok(filter.matches(&properties))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn nothing_comes_after_an_error() {
        let directory = tempfile::tempdir().unwrap();
        let path: Arc<Path> = directory.path().join("broken.dump").into();
        fs::write(&path, "ITEM: TIMESTEP\nfirst\n").unwrap();
        let file = StructureFile { path, weight: 1.0 };
        let files =
            StructureFiles { files: vec![file.clone(), file], filter: None, dump_elements: Vec::new() };
        let mut reader = files.reader(Arc::default());
        let error = reader.next().unwrap_err();
        assert!(error.to_string().contains("broken.dump:2: "), "{error}");
        assert!(reader.next().unwrap().is_none());
    }

    #[test]
    fn a_filter_reads_only_the_labels_that_it_names() {
        let directory = tempfile::tempdir().unwrap();
        let path: Arc<Path> = directory.path().join("clusters.xyz").into();
        let virial = "virial=\"1 0 0 0 1 0 0 0 1\"";
        let frames = [
            format!("energy=1 {virial} pbc=\"F F F\""),
            "REF_energy=2 REF_stress=much".to_owned(),
            "energy=much".to_owned(),
        ];
        let frames = frames.map(|comment| format!("1\n{comment}\nAl 0 0 0\n"));
        let count = |frames: &[String], filter: &str| {
            fs::write(&path, frames.concat()).unwrap();
            let filter = Some(filter.parse().unwrap());
            let files = vec![StructureFile { path: path.clone(), weight: 1.0 }];
            let mut reader =
                StructureFiles { files, filter, dump_elements: Vec::new() }.reader(Arc::default());
            let mut count = 0;
            while reader.next().map_err(|error| error.to_string())?.is_some() {
                count += 1;
            }
            Ok::<u32, String>(count)
        };
        assert_eq!(count(&frames, "atoms < 200 and element = Al"), Ok(3));
        assert_eq!(count(&frames[..2], "energy < 3"), Ok(2));
        assert_eq!(count(&frames[..2], "energy_per_atom < 1.5"), Ok(1));
        let error = count(&frames, "energy < 3").unwrap_err();
        assert!(error.contains("clusters.xyz") && error.contains("energy is 'much'"), "{error}");
    }

    #[test]
    fn structures_have_the_index_of_their_file_and_in_it() {
        let directory = tempfile::tempdir().unwrap();
        let file = |(name, frames): (&str, usize)| {
            let path: Arc<Path> = directory.path().join(name).into();
            fs::write(&path, "1\n\nAl 0 0 0\n".repeat(frames)).unwrap();
            StructureFile { path, weight: 1.0 }
        };
        let files = [("a.xyz", 1), ("b.xyz", 2), ("c.xyz", 1)].map(file).to_vec();
        let files = StructureFiles { files, filter: None, dump_elements: Vec::new() };
        let mut reader = files.reader(Arc::default());
        let mut found = Vec::new();
        while let Some((_, file)) = reader.next().unwrap() {
            assert_eq!(file.path, files.files[reader.file_index()].path);
            found.push((reader.file_index(), reader.frame_index()));
        }
        assert_eq!(found, [(0, 0), (1, 0), (1, 1), (2, 0)]);
    }
}
