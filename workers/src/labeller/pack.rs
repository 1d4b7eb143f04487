//! A directory as one row of the store.

use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use dft::result_file;

use super::prepare::DATA;

/// What VASP's licence lets nobody pass on.
const LICENSED: &str = "POTCAR";
/// Larger files stay out: charge densities and wave functions are of no use without the program, and are made again.
const MAX_FILE_SIZE: u64 = 16 << 20;
/// Bytes of all files together, before they are compressed, each with its header.
const MAX_TOTAL_SIZE: u64 = 64 << 20;
/// What a file takes beside its content.
const HEADER: u64 = 1024;
/// Directories within each other that are looked into. Paths of some thousand levels cannot be named any more.
const MAX_DEPTH: usize = 64;
/// Lines about what is left out.
const MAX_LINES: usize = 1000;
/// More would cost time and win little.
const COMPRESSION_LEVEL: i32 = 3;

/// A tar file, compressed.
pub(super) struct Packed {
    pub bytes: Vec<u8>,
    /// What is not in it, with its bytes or why, a line each.
    pub left_out: String,
}

/// Packs the files below a directory, in order of their names, each as long as it is not too large and there is room.
/// Pseudopotentials stay out ([`DATA`], [`LICENSED`]): all calculations have the same. So does what cannot be read.
pub(super) fn pack(directory: &Path) -> io::Result<Packed> {
    let mut encoder = zstd::Encoder::new(Vec::new(), COMPRESSION_LEVEL)?;
    encoder.include_checksum(true)?;
    let mut archive = tar::Builder::new(encoder);
    let mut left_out = LeftOut::default();
    let mut room = MAX_TOTAL_SIZE;
    for path in files(directory, &mut left_out) {
        let name = path.strip_prefix(directory).unwrap_or(&path);
        let size = fs::symlink_metadata(&path).map_or(0, |file| file.len());
        if name.starts_with(DATA) || name.ends_with(LICENSED) || size.max(HEADER) > MAX_FILE_SIZE.min(room) {
            left_out.add(name, &format!("{size} bytes"));
            continue;
        }
        match append(&mut archive, &path, name) {
            Ok(()) => room = room.saturating_sub(size + HEADER),
            Err(Unpacked::Unreadable(why)) => left_out.add(name, &why),
            Err(Unpacked::Archive(error)) => return Err(error),
        }
    }
    let bytes = archive.into_inner()?.finish()?;
    Ok(Packed { bytes, left_out: left_out.text() })
}

/// Why a file is not packed.
enum Unpacked {
    /// It stays out.
    Unreadable(String),
    /// Nothing can be packed any more.
    Archive(io::Error),
}

/// Appends a file or a link, with what it has in common with others of its kind.
fn append<W: io::Write>(archive: &mut tar::Builder<W>, path: &Path, name: &Path) -> Result<(), Unpacked> {
    let unreadable = |error: io::Error| Unpacked::Unreadable(error.to_string());
    let metadata = fs::symlink_metadata(path).map_err(unreadable)?;
    let mut header = tar::Header::new_gnu();
    header.set_metadata(&metadata);
    if metadata.is_symlink() {
        // It may lead anywhere, and is not followed.
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
                _ => left_out.add(&name.join(entry.file_name()), "no regular file"),
            }
        }
    }
    files.sort();
    files
}

/// What is not packed.
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
        // A name may have line breaks in it.
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
