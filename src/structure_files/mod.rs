//! Structures from files that a command line names: several formats, packed or not, and a filter.

mod arguments;
mod format;
mod reader;

use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use atoms::Species;

pub use self::arguments::{StructureArgs, StructureReadingArgs};
pub use self::reader::{FileLine, StructureReader};
use crate::exit_status::CommandError;
use crate::filter::StructureFilter;

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

impl StructureFiles {
    /// Begins with the first file; `bytes` counts what is read of all of them.
    pub fn reader(&self, bytes: Arc<AtomicU64>) -> StructureReader {
        StructureReader::new(self.clone(), bytes)
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
