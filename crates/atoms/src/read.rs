//! Reading structures from a file of any format that is known here.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use crate::extxyz::{self, Frame, Reader};
use crate::poscar;

/// A file that cannot be used.
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
    /// Its name tells no format.
    #[error("{}: unknown format: expected a name ending in .extxyz, .xyz, .poscar or .vasp, or beginning with POSCAR or CONTCAR", .0.display())]
    Format(PathBuf),
    /// It has no frame.
    #[error("{}: the file has no structures, expected at least one", .0.display())]
    Empty(PathBuf),
    /// It is not the extended XYZ that its name tells.
    #[error("{}:{line}: {fault}", path.display())]
    Extxyz {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        #[source]
        fault: extxyz::Fault,
    },
    /// It is not the POSCAR that its name tells.
    #[error("{}:{line}: {fault}", path.display())]
    Poscar {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What is wrong with it.
        #[source]
        fault: poscar::Fault,
    },
}

/// All structures of a file, at least one: POSCAR (`POSCAR*`, `CONTCAR*`, `*.poscar`, `*.vasp`) or
/// extended XYZ (`*.xyz`, `*.extxyz`), by its name in any case.
pub fn read_structures(path: &Path) -> Result<Vec<Frame>, FileError> {
    let lower = |name: Option<&std::ffi::OsStr>| name.unwrap_or_default().to_string_lossy().to_lowercase();
    let name = lower(path.file_name());
    match lower(path.extension()).as_str() {
        "xyz" | "extxyz" => read_extxyz(path),
        "poscar" | "vasp" => read_poscar(path).map(|frame| vec![frame]),
        _ if name.starts_with("poscar") || name.starts_with("contcar") => {
            read_poscar(path).map(|frame| vec![frame])
        }
        _ => Err(FileError::Format(path.to_owned())),
    }
}

/// All frames of a file in extended XYZ, at least one.
pub fn read_extxyz(path: &Path) -> Result<Vec<Frame>, FileError> {
    let frames: Result<Vec<_>, _> = Reader::new(open(path)?).collect();
    match frames {
        Ok(frames) if frames.is_empty() => Err(FileError::Empty(path.to_owned())),
        Ok(frames) => Ok(frames),
        Err(error) => Err(FileError::Extxyz { path: path.to_owned(), line: error.line, fault: error.fault }),
    }
}

/// The structure of a POSCAR file.
pub fn read_poscar(path: &Path) -> Result<Frame, FileError> {
    poscar::read_poscar(open(path)?).map_err(|error| FileError::Poscar {
        path: path.to_owned(),
        line: error.line,
        fault: error.fault,
    })
}

fn open(path: &Path) -> Result<BufReader<File>, FileError> {
    let file = File::open(path).map_err(|source| FileError::Open { path: path.to_owned(), source })?;
    Ok(BufReader::new(file))
}
