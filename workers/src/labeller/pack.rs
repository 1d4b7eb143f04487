//! A directory as one row of the store.

use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::prepare::DATA;

/// What VASP's licence lets nobody pass on.
const LICENSED: &str = "POTCAR";
/// Larger files stay out: charge densities and wave functions are of no use without the program, and are made again.
const LARGEST_FILE: u64 = 16 << 20;
/// Bytes of all files together, before they are compressed.
const MOST: u64 = 64 << 20;
/// More would cost time and win little.
const LEVEL: i32 = 3;

/// A tar file, compressed.
pub(super) struct Packed {
    pub bytes: Vec<u8>,
    /// Files that are not in it, with their bytes, a line each.
    pub left_out: String,
}

/// Packs the files below a directory, in order of their names, each as long as it is not too large and there is room.
/// Pseudopotentials stay out ([`DATA`], [`LICENSED`]): all calculations have the same.
pub(super) fn pack(directory: &Path) -> io::Result<Packed> {
    let mut encoder = zstd::Encoder::new(Vec::new(), LEVEL)?;
    encoder.include_checksum(true)?;
    let mut archive = tar::Builder::new(encoder);
    // A link may lead anywhere.
    archive.follow_symlinks(false);
    let (mut left_out, mut room) = (String::new(), MOST);
    for path in files(directory)? {
        let (name, size) =
            (path.strip_prefix(directory).unwrap_or(&path), fs::symlink_metadata(&path)?.len());
        if name.starts_with(DATA) || name.ends_with(LICENSED) || size > LARGEST_FILE.min(room) {
            let _ = writeln!(left_out, "{} ({size} bytes)", name.display());
            continue;
        }
        room -= size;
        archive.append_path_with_name(&path, name)?;
    }
    let bytes = archive.into_inner()?.finish()?;
    Ok(Packed { bytes, left_out })
}

/// Regular files and links below a directory; nothing else can be packed.
fn files(directory: &Path) -> io::Result<Vec<PathBuf>> {
    let (mut open, mut files) = (vec![directory.to_owned()], Vec::new());
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(folder)? {
            let (entry, kind) = entry.and_then(|entry| Ok((entry.path(), entry.file_type()?)))?;
            match kind {
                kind if kind.is_dir() => open.push(entry),
                kind if kind.is_file() || kind.is_symlink() => files.push(entry),
                _ => {}
            }
        }
    }
    files.sort();
    Ok(files)
}
