//! Packs a directory into one row of the store.

use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use dft::result_file;

use super::prepare::DATA;

/// Files that VASP's licence forbids to redistribute.
const LICENSED: &str = "POTCAR";
/// Larger files are left out: charge densities and wave functions are useless without the program and can be
/// recomputed.
const MAX_FILE_SIZE: u64 = 16 << 20;
/// Maximum size of all files before compression, with headers.
const MAX_TOTAL_SIZE: u64 = 64 << 20;
/// Size of a file's header.
const HEADER_SIZE: u64 = 1024;
/// Maximum directory depth. Paths thousands of levels deep exceed the system's limit.
const MAX_DEPTH: usize = 64;
/// Maximum number of lines about files left out.
const MAX_LINES: usize = 1000;
/// Higher levels take longer and gain little.
const COMPRESSION_LEVEL: i32 = 3;

/// A compressed tar file.
pub(super) struct PackedDirectory {
    pub bytes: Vec<u8>,
    /// Files left out, with their size or the reason, one per line.
    pub left_out: String,
}

/// Packs the files below a directory, ordered by name, unless a file or the sum becomes too large. Leaves out
/// pseudopotentials ([`DATA`], [`LICENSED`]), which all calculations share, and unreadable files.
pub(super) fn pack(directory: &Path) -> io::Result<PackedDirectory> {
    let mut encoder = zstd::Encoder::new(Vec::new(), COMPRESSION_LEVEL)?;
    encoder.include_checksum(true)?;
    let mut archive = tar::Builder::new(encoder);
    let mut left_out = LeftOut::default();
    let mut room = MAX_TOTAL_SIZE;
    for path in files(directory, &mut left_out) {
        let name = path.strip_prefix(directory).unwrap_or(&path);
        let size = fs::symlink_metadata(&path).map_or(0, |file| file.len());
        if name.starts_with(DATA)
            || name.ends_with(LICENSED)
            || size.max(HEADER_SIZE) > MAX_FILE_SIZE.min(room)
        {
            left_out.add(name, &format!("{size} bytes"));
            continue;
        }
        match append(&mut archive, &path, name) {
            Ok(()) => room = room.saturating_sub(size + HEADER_SIZE),
            Err(Unpacked::Unreadable(why)) => left_out.add(name, &why),
            Err(Unpacked::Archive(error)) => return Err(error),
        }
    }
    let bytes = archive.into_inner()?.finish()?;
    Ok(PackedDirectory { bytes, left_out: left_out.text() })
}

/// Why a file is not packed.
enum Unpacked {
    /// It is left out.
    Unreadable(String),
    /// The archive is unusable.
    Archive(io::Error),
}

/// Appends a file or a link with its usual metadata.
fn append<W: io::Write>(archive: &mut tar::Builder<W>, path: &Path, name: &Path) -> Result<(), Unpacked> {
    let unreadable = |error: io::Error| Unpacked::Unreadable(error.to_string());
    let metadata = fs::symlink_metadata(path).map_err(unreadable)?;
    let mut header = tar::Header::new_gnu();
    header.set_metadata(&metadata);
    if metadata.is_symlink() {
        // A link may point anywhere and is not followed.
        let target = fs::read_link(path).map_err(unreadable)?;
        header.set_size(0);
        return archive.append_link(&mut header, name, target).map_err(unreadable);
    }
    let content = result_file::read(path).map_err(|error| Unpacked::Unreadable(error.to_string()))?;
    header.set_size(content.len() as u64);
    archive.append_data(&mut header, name, content.as_slice()).map_err(Unpacked::Archive)
}

/// Regular files and links below a directory; nothing else can be packed.
fn files(directory: &Path, left_out: &mut LeftOut) -> Vec<PathBuf> {
    let (mut open, mut files) = (vec![(directory.to_owned(), 0)], Vec::new());
    while let Some((folder, depth)) = open.pop() {
        let name = folder.strip_prefix(directory).unwrap_or(&folder).to_owned();
        let entries = match fs::read_dir(&folder) {
            Ok(entries) if depth <= MAX_DEPTH => entries,
            Ok(_) => {
                left_out.add(&name, &format!("more than {MAX_DEPTH} directories deep"));
                continue;
            }
            Err(error) => {
                left_out.add(&name, &error.to_string());
                continue;
            }
        };
        for entry in entries.flatten() {
            match entry.file_type() {
                Ok(kind) if kind.is_dir() => open.push((entry.path(), depth + 1)),
                Ok(kind) if kind.is_file() || kind.is_symlink() => files.push(entry.path()),
                _ => left_out.add(&name.join(entry.file_name()), "not a regular file"),
            }
        }
    }
    files.sort();
    files
}

/// Files left out.
#[derive(Default)]
struct LeftOut {
    lines: Vec<String>,
    more: usize,
}

impl LeftOut {
    fn add(&mut self, name: &Path, why: &str) {
        if self.lines.len() == MAX_LINES {
            self.more += 1;
            return;
        }
        // A name may contain line breaks.
        let name: String =
            name.to_string_lossy().chars().map(|c| if c.is_control() { '?' } else { c }).collect();
        self.lines.push(format!("{name} ({why})"));
    }

    fn text(mut self) -> String {
        self.lines.sort();
        let mut text = self.lines.iter().fold(String::new(), |text, line| text + line + "\n");
        if self.more > 0 {
            let _ = writeln!(text, "and {} more", self.more);
        }
        text
    }
}
