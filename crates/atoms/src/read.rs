//! Reads structures from a file of any supported format.

use std::fs::File;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};

use crate::extxyz::{self, ExtxyzReader, Frame};
use crate::{lammps_dump, poscar};

/// Extensions of other programs' formats that `ase convert` reads.
const OTHER_FORMATS: [&str; 14] =
    ["cif", "vasp", "poscar", "pdb", "traj", "xsf", "cfg", "gen", "cell", "res", "lmp", "data", "in", "json"];

/// A file that cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// It cannot be opened.
    #[error("{}: cannot be opened: {source}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Its name does not indicate a format.
    #[error(
        "{}: unknown format: expected a name ending in .extxyz, .xyz, .poscar or .vasp, or beginning with POSCAR or CONTCAR; {}",
        .0.display(),
        conversion(.0)
    )]
    Format(PathBuf),
    /// Only extended XYZ is accepted here, and the file has another format.
    #[error("{}: expected extended XYZ; {}", .0.display(), conversion(.0))]
    NotExtxyz(PathBuf),
    /// It has no frames.
    #[error("{}: the file has no structures, expected at least one", .0.display())]
    Empty(PathBuf),
    /// Invalid extended XYZ.
    #[error("{}:{line}: {fault}", path.display())]
    Extxyz {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        #[source]
        fault: extxyz::ExtxyzErrorKind,
    },
    /// Invalid POSCAR.
    #[error("{}:{line}: {fault}", path.display())]
    Poscar {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        #[source]
        fault: poscar::PoscarErrorKind,
    },
    /// Invalid dump of LAMMPS.
    #[error("{}:{line}: {fault}", path.display())]
    LammpsDump {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        #[source]
        fault: lammps_dump::DumpErrorKind,
    },
}

impl FileError {
    /// Whether the operating system could not open or read the file, as opposed to what the file contains.
    pub fn is_of_system(&self) -> bool {
        match self {
            Self::Open { .. } => true,
            Self::Extxyz { fault, .. } => matches!(fault, extxyz::ExtxyzErrorKind::Io(_)),
            Self::Poscar { fault, .. } => matches!(fault, poscar::PoscarErrorKind::Io(_)),
            Self::LammpsDump { fault, .. } => matches!(fault, lammps_dump::DumpErrorKind::Io(_)),
            Self::Format(_) | Self::NotExtxyz(_) | Self::Empty(_) => false,
        }
    }
}

/// How to convert a file to extended XYZ.
fn conversion(path: &Path) -> String {
    format!("convert it with `ase convert {} {}`", path.display(), path.with_extension("extxyz").display())
}

/// Reads all structures of a file, at least one. The name determines the format, in any letter case: POSCAR
/// (`POSCAR*`, `CONTCAR*`, `*.poscar`, `*.vasp`) or extended XYZ (`*.xyz`, `*.extxyz`).
pub fn read_structures(path: &Path) -> Result<Vec<Frame>, FileError> {
    let lower = |name: Option<&std::ffi::OsStr>| name.unwrap_or_default().to_string_lossy().to_lowercase();
    let name = lower(path.file_name());
    match lower(path.extension()).as_str() {
        "xyz" | "extxyz" => read_extxyz(path),
        "poscar" | "vasp" => read_poscar(path).map(|frame| vec![frame]),
        _ if name.starts_with("poscar") || name.starts_with("contcar") => {
            read_poscar(path).map(|frame| vec![frame])
        }
        _ if path.is_dir() => Err(directory(path)),
        _ => Err(FileError::Format(path.to_owned())),
    }
}

/// Opens an extended XYZ file for reading frame by frame.
///
/// # Errors
/// The file cannot be opened, is a directory, or its name indicates another format.
pub fn open_extxyz(path: &Path) -> Result<File, FileError> {
    // A pipe has no extension.
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let is_other = OTHER_FORMATS.contains(&extension.as_str())
        || name.starts_with("poscar")
        || name.starts_with("contcar");
    match is_other && path.is_file() {
        true => Err(FileError::NotExtxyz(path.to_owned())),
        false => open_file(path),
    }
}

/// Reads all frames of an extended XYZ file, at least one.
pub fn read_extxyz(path: &Path) -> Result<Vec<Frame>, FileError> {
    let frames: Result<Vec<_>, _> = ExtxyzReader::new(open(path)?).collect();
    match frames {
        Ok(frames) if frames.is_empty() => Err(FileError::Empty(path.to_owned())),
        Ok(frames) => Ok(frames),
        Err(error) => Err(FileError::Extxyz { path: path.to_owned(), line: error.line, fault: error.kind }),
    }
}

/// Reads a POSCAR file.
pub fn read_poscar(path: &Path) -> Result<Frame, FileError> {
    poscar::read_poscar(open(path)?).map_err(|error| FileError::Poscar {
        path: path.to_owned(),
        line: error.line,
        fault: error.kind,
    })
}

fn open(path: &Path) -> Result<BufReader<File>, FileError> {
    open_file(path).map(BufReader::new)
}

/// Directories can be opened but not read.
fn open_file(path: &Path) -> Result<File, FileError> {
    if path.is_dir() {
        return Err(directory(path));
    }
    File::open(path).map_err(|source| FileError::Open { path: path.to_owned(), source })
}

fn directory(path: &Path) -> FileError {
    let source = io::Error::new(io::ErrorKind::IsADirectory, "it is a directory; expected a file");
    FileError::Open { path: path.to_owned(), source }
}
