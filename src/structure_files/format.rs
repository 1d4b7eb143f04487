//! Formats and compressions, which the names of files show.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use atoms::extxyz::{self, Frame};
use atoms::{FileError, Species, lammps_dump, open_extxyz, poscar};
use flate2::read::MultiGzDecoder;

use crate::exit_status::CommandError;

/// The structures of a file, in order.
pub enum Structures {
    Extxyz(Box<extxyz::ExtxyzReader<BoxedReader>>),
    /// One structure.
    Poscar(Option<BoxedReader>),
    LammpsDump(Box<lammps_dump::LammpsDumpReader<BoxedReader>>),
}

type BoxedReader = Box<dyn BufRead + Send>;

/// Format of a file.
enum StructureFormat {
    Extxyz,
    Poscar,
    LammpsDump,
}

/// The format that the name shows, with or without the extension of a compression.
fn format(path: &Path) -> Option<StructureFormat> {
    let name = path.file_name()?.to_string_lossy().to_lowercase();
    let name = name.strip_suffix(".gz").or_else(|| name.strip_suffix(".zst")).unwrap_or(&name);
    let ends = |endings: &[&str]| endings.iter().any(|ending| name.ends_with(ending));
    let begins = |beginnings: &[&str]| beginnings.iter().any(|beginning| name.starts_with(beginning));
    match () {
        () if ends(&[".xyz", ".extxyz"]) => Some(StructureFormat::Extxyz),
        () if ends(&[".poscar", ".vasp"]) || begins(&["poscar", "contcar"]) => Some(StructureFormat::Poscar),
        () if ends(&[".dump", ".lammpstrj"]) || begins(&["dump."]) => Some(StructureFormat::LammpsDump),
        () => None,
    }
}

/// Checks that a file can be opened. If its name shows no format, or it is a pipe, it is read as extended XYZ.
pub fn check_format_or_extxyz(path: &Path) -> Result<(), CommandError> {
    let is_known = match std::fs::metadata(path) {
        Ok(found) => !found.is_dir() && (!found.is_file() || format(path).is_some()),
        Err(_) => false,
    };
    if is_known { Ok(()) } else { open_extxyz(path).map(drop).map_err(CommandError::input) }
}

/// Whether a file of this name is read as extended XYZ that is not packed.
pub fn is_plain_extxyz(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let is_packed = name.ends_with(".gz") || name.ends_with(".zst");
    !is_packed && matches!(format(path), None | Some(StructureFormat::Extxyz))
}

/// Checks that the name of a file shows a format that can be read.
pub fn check_format(path: &Path) -> Result<(), CommandError> {
    if format(path).is_some() {
        return Ok(());
    }
    Err(CommandError::Input(format!(
        "{}: unknown format: expected a name that ends in .extxyz, .xyz, .poscar, .vasp, .dump or .lammpstrj or begins with \
         POSCAR, CONTCAR or dump., each with or without .gz or .zst",
        path.display()
    )))
}

impl Structures {
    /// Opens a file, as extended XYZ if its name shows no format; `bytes` counts what is read of it.
    pub fn open(path: &Path, dump_elements: &[Species], bytes: &Arc<AtomicU64>) -> Result<Self, FileError> {
        let input =
            unpacked(path, bytes).map_err(|source| FileError::Open { path: path.to_path_buf(), source })?;
        Ok(match format(path).unwrap_or(StructureFormat::Extxyz) {
            StructureFormat::Extxyz => Self::Extxyz(Box::new(extxyz::ExtxyzReader::new(input))),
            StructureFormat::Poscar => Self::Poscar(Some(input)),
            StructureFormat::LammpsDump => {
                Self::LammpsDump(Box::new(lammps_dump::LammpsDumpReader::new(input, dump_elements.to_vec())))
            }
        })
    }

    /// The next structure. Errors name `path`, that of the file.
    pub fn next(&mut self, path: &Path) -> Option<Result<Frame, FileError>> {
        let path = || path.to_path_buf();
        match self {
            Self::Extxyz(reader) => reader.next().map(|frame| {
                frame.map_err(|error| FileError::Extxyz { path: path(), line: error.line, fault: error.kind })
            }),
            Self::Poscar(input) => input.take().map(|input| {
                poscar::read_poscar(input).map_err(|error| FileError::Poscar {
                    path: path(),
                    line: error.line,
                    fault: error.kind,
                })
            }),
            Self::LammpsDump(reader) => reader.next().map(|frame| {
                frame.map_err(|error| FileError::LammpsDump {
                    path: path(),
                    line: error.line,
                    fault: error.kind,
                })
            }),
        }
    }
}

fn unpacked(path: &Path, bytes: &Arc<AtomicU64>) -> io::Result<BoxedReader> {
    let file = BufReader::new(Counting(File::open(path)?, Arc::clone(bytes)));
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    Ok(match extension.as_str() {
        "gz" => Box::new(BufReader::new(MultiGzDecoder::new(file))),
        "zst" => Box::new(BufReader::new(zstd::Decoder::with_buffer(file)?)),
        _ => Box::new(file),
    })
}

/// Counts the bytes read.
struct Counting(File, Arc<AtomicU64>);

impl Read for Counting {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.0.read(buffer)?;
        self.1.fetch_add(count as u64, Ordering::Relaxed);
        Ok(count)
    }
}
