//! Trajectory files: extended XYZ or LAMMPS dumps, compressed or not, as their names show.

mod frame;

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use atoms::extxyz::write_frame;
use atoms::lammps_dump::write_snapshot;
use flate2::Compression;
use flate2::write::GzEncoder;

use crate::atomic_file::{cannot_create, cannot_write};
use crate::exit_status::CommandError;
pub use frame::{StepMotion, TrajectoryStep};

/// Level of zstd: about as fast as the dynamics of small cells.
const ZSTD_LEVEL: i32 = 3;

/// A trajectory file. Without compression it is valid after every frame, with it when it is finished.
pub struct Trajectory {
    path: PathBuf,
    format: TrajectoryFormat,
    output: PackedFile,
    /// Number of frames written.
    pub frames: u64,
}

#[derive(Clone, Copy)]
enum TrajectoryFormat {
    Extxyz,
    LammpsDump,
}

enum PackedFile {
    Plain(File),
    Gzip(GzEncoder<File>),
    Zstd(zstd::Encoder<'static, File>),
}

impl Trajectory {
    /// Creates the file; an existing one is replaced. A name that ends in `.dump` or `.lammpstrj` makes a LAMMPS dump, any other
    /// extended XYZ; `.gz` or `.zst` after it compresses the file.
    pub fn create(path: &Path) -> Result<Self, CommandError> {
        let name = path.to_string_lossy().to_lowercase();
        let is_dump = ends(&name, &[".dump", ".lammpstrj"]);
        let format = if is_dump { TrajectoryFormat::LammpsDump } else { TrajectoryFormat::Extxyz };
        let output = PackedFile::create(path, &name).map_err(|error| cannot_create(path, error))?;
        Ok(Self { path: path.to_owned(), format, output, frames: 0 })
    }

    /// Appends a frame.
    pub fn push(&mut self, step: &TrajectoryStep<'_>) -> Result<(), CommandError> {
        let written = match self.format {
            TrajectoryFormat::Extxyz => {
                write_frame(&mut self.output, &step.frame()).map_err(|e| e.to_string())
            }
            TrajectoryFormat::LammpsDump => {
                write_snapshot(&mut self.output, &step.snapshot()).map_err(|e| e.to_string())
            }
        };
        written.map_err(|error| cannot_write(&self.path, error))?;
        self.frames += 1;
        Ok(())
    }

    /// Completes the file.
    pub fn finish(self) -> Result<(), CommandError> {
        let Self { path, output, .. } = self;
        output.finish().map_err(|error| cannot_write(&path, error))
    }
}

/// Checks that the name of a file is that of a trajectory.
pub fn check_name(path: &str) -> Result<PathBuf, String> {
    match ends(&path.to_lowercase(), &[".extxyz", ".xyz", ".dump", ".lammpstrj"]) {
        true => Ok(path.into()),
        false => Err(
            "expected a name that ends in .extxyz, .xyz, .dump or .lammpstrj, with or without .gz or .zst"
                .to_owned(),
        ),
    }
}

/// Whether a name ends so, with or without that of a compression.
fn ends(name: &str, endings: &[&str]) -> bool {
    let name = name.strip_suffix(".gz").or_else(|| name.strip_suffix(".zst")).unwrap_or(name);
    endings.iter().any(|ending| name.ends_with(ending))
}

impl PackedFile {
    fn create(path: &Path, name: &str) -> io::Result<Self> {
        let file = File::create(path)?;
        Ok(if name.ends_with(".gz") {
            Self::Gzip(GzEncoder::new(file, Compression::default()))
        } else if name.ends_with(".zst") {
            Self::Zstd(zstd::Encoder::new(file, ZSTD_LEVEL)?)
        } else {
            Self::Plain(file)
        })
    }

    fn finish(self) -> io::Result<()> {
        match self {
            Self::Plain(_) => Ok(()),
            Self::Gzip(encoder) => encoder.finish().map(drop),
            Self::Zstd(encoder) => encoder.finish().map(drop),
        }
    }
}

impl Write for PackedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Plain(file) => file.write(bytes),
            Self::Gzip(encoder) => encoder.write(bytes),
            Self::Zstd(encoder) => encoder.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Plain(file) => file.flush(),
            Self::Gzip(encoder) => encoder.flush(),
            Self::Zstd(encoder) => encoder.flush(),
        }
    }
}

#[cfg(test)]
mod tests;
