//! Files that a program has left in its directory.
//!
//! Under the name of a result there may be anything: a pipe that nobody writes to, a link to a device that never ends, a
//! sparse file that is larger than the memory. All files that a program has left are therefore opened here: without waiting
//! and without following a link, regular files only, and up to a size.

use std::fs::{File, FileType};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Take};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;

use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;

/// Bytes of the largest file that is read into memory as a whole: 256 MiB.
pub const MAX_BYTES: u64 = 256 << 20;
/// Bytes of the largest file that is read piece by piece, as VASP's: 16 GiB.
pub const MAX_STREAMED_BYTES: u64 = 16 << 30;
/// Bytes of the longest piece of such a file: 1 MiB.
pub const MAX_RECORD_BYTES: usize = 1 << 20;

/// Why a file is not read. It completes a sentence that begins with the name of the file.
#[derive(Debug, thiserror::Error)]
pub enum ResultFileError {
    /// There is none.
    #[error("is missing")]
    Missing,
    /// Reading it might never end.
    #[error("is {found}, expected a regular file")]
    NotRegular {
        /// What it is.
        found: &'static str,
    },
    /// It might fill the memory.
    #[error("has {bytes} bytes, expected at most {most}")]
    TooLarge {
        /// Its size.
        bytes: u64,
        /// The bound.
        most: u64,
    },
    /// The system refuses.
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
}

impl ResultFileError {
    /// Whether there is no such file.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Missing)
    }
}

/// The last part of a file.
#[derive(Debug)]
pub struct Tail {
    /// Bytes of the whole file.
    pub length: u64,
    /// The last of them.
    pub bytes: Vec<u8>,
}

/// The whole content, of at most [`MAX_BYTES`] bytes.
///
/// # Errors
/// See [`ResultFileError`].
pub fn read(path: &Path) -> Result<Vec<u8>, ResultFileError> {
    let (file, length) = open(path)?;
    within(length, MAX_BYTES)?;
    let mut content = Vec::new();
    // It may grow while it is read.
    let read = file.take(MAX_BYTES + 1).read_to_end(&mut content)?;
    within(read as u64, MAX_BYTES)?;
    Ok(content)
}

/// The last `bytes` of a file, however large it is.
///
/// # Errors
/// See [`ResultFileError`].
pub fn tail(path: &Path, bytes: u64) -> Result<Tail, ResultFileError> {
    let (mut file, length) = open(path)?;
    file.seek(SeekFrom::Start(length.saturating_sub(bytes)))?;
    let mut end = Vec::new();
    file.take(bytes).read_to_end(&mut end)?;
    Ok(Tail { length, bytes: end })
}

/// A reader of a file of at most [`MAX_STREAMED_BYTES`] bytes. It fails where more than [`MAX_RECORD_BYTES`] bytes come without
/// the byte `mark`, so that a parser that keeps what stands between two of them needs no more memory.
///
/// # Errors
/// See [`ResultFileError`].
pub fn open_delimited(path: &Path, delimiter: u8) -> Result<DelimitedReader, ResultFileError> {
    let (file, length) = open(path)?;
    within(length, MAX_STREAMED_BYTES)?;
    Ok(DelimitedReader { file: BufReader::new(file.take(MAX_STREAMED_BYTES)), delimiter, since_delimiter: 0 })
}

fn within(bytes: u64, most: u64) -> Result<(), ResultFileError> {
    if bytes > most { Err(ResultFileError::TooLarge { bytes, most }) } else { Ok(()) }
}

/// The file with its size, if it is a regular one.
fn open(path: &Path) -> Result<(File, u64), ResultFileError> {
    // NONBLOCK: to open a pipe waits for somebody who writes to it otherwise.
    let flags = OFlags::RDONLY | OFlags::NONBLOCK | OFlags::NOFOLLOW | OFlags::NOCTTY | OFlags::CLOEXEC;
    let file = match rustix::fs::open(path, flags, Mode::empty()) {
        Ok(file) => File::from(file),
        Err(Errno::NOENT) => return Err(ResultFileError::Missing),
        Err(Errno::LOOP) => return Err(ResultFileError::NotRegular { found: "a symbolic link" }),
        Err(Errno::NXIO) => return Err(ResultFileError::NotRegular { found: "a socket" }),
        Err(error) => return Err(ResultFileError::Io(error.into())),
    };
    let metadata = file.metadata()?;
    match metadata.is_file() {
        true => Ok((file, metadata.len())),
        false => Err(ResultFileError::NotRegular { found: describe(metadata.file_type()) }),
    }
}

fn describe(kind: FileType) -> &'static str {
    match kind {
        kind if kind.is_dir() => "a directory",
        kind if kind.is_fifo() => "a named pipe",
        _ => "a device",
    }
}

/// See [`open_delimited`].
#[derive(Debug)]
pub struct DelimitedReader {
    file: BufReader<Take<File>>,
    delimiter: u8,
    since_delimiter: usize,
}

impl Read for DelimitedReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.fill_buf()?.read(buffer)?;
        self.consume(read);
        Ok(read)
    }
}

impl BufRead for DelimitedReader {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        if self.since_delimiter > MAX_RECORD_BYTES {
            let what = if self.delimiter == b'\n' { "line" } else { "text without a tag" };
            let message = format!("has a {what} of more than {MAX_RECORD_BYTES} bytes");
            return Err(io::Error::new(io::ErrorKind::InvalidData, message));
        }
        self.file.fill_buf()
    }

    fn consume(&mut self, bytes: usize) {
        let consumed = self.file.buffer().get(..bytes).unwrap_or_default();
        match consumed.iter().rposition(|byte| *byte == self.delimiter) {
            Some(place) => self.since_delimiter = bytes - place,
            None => self.since_delimiter += bytes,
        }
        self.file.consume(bytes);
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use super::*;

    #[test]
    fn a_regular_file_is_read() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("file");
        assert!(read(&path).unwrap_err().is_missing());
        fs::write(&path, "one\ntwo\n").unwrap();
        assert_eq!(read(&path).unwrap(), b"one\ntwo\n");
        let Tail { length, bytes } = tail(&path, 3).unwrap();
        assert_eq!((length, bytes.as_slice()), (8, &b"wo\n"[..]));
        assert_eq!(open_delimited(&path, b'\n').unwrap().lines().count(), 2);
    }

    /// All of these are refused by whoever reads, at once.
    #[test]
    fn nothing_but_a_regular_file_is_read() {
        let home = tempfile::tempdir().unwrap();
        let at = |name: &str| home.path().join(name);
        rustix::fs::mkfifoat(rustix::fs::CWD, at("pipe"), Mode::RUSR | Mode::WUSR).unwrap();
        symlink("/dev/zero", at("link")).unwrap();
        symlink("nowhere", at("dangling")).unwrap();
        fs::create_dir(at("directory")).unwrap();
        let _socket = UnixListener::bind(at("socket")).unwrap();
        let found = [
            ("pipe", "a named pipe"),
            ("link", "a symbolic link"),
            ("dangling", "a symbolic link"),
            ("directory", "a directory"),
            ("socket", "a socket"),
        ];
        for (name, found) in found {
            let expected = format!("is {found}, expected a regular file");
            assert_eq!(read(&at(name)).unwrap_err().to_string(), expected);
            assert_eq!(tail(&at(name), 10).unwrap_err().to_string(), expected);
            assert_eq!(open_delimited(&at(name), b'\n').unwrap_err().to_string(), expected);
        }
        assert_eq!(
            read(Path::new("/dev/zero")).unwrap_err().to_string(),
            "is a device, expected a regular file"
        );
    }

    #[test]
    fn a_file_that_is_too_large_is_not_read() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("sparse");
        let file = File::create(&path).unwrap();
        file.set_len(MAX_BYTES + 1).unwrap();
        let message = read(&path).unwrap_err().to_string();
        assert_eq!(message, "has 268435457 bytes, expected at most 268435456");
        assert_eq!(tail(&path, 5).unwrap().bytes, [0; 5]);
        // One line without an end.
        let mut line = Vec::new();
        let message =
            open_delimited(&path, b'\n').unwrap().read_until(b'\n', &mut line).unwrap_err().to_string();
        assert_eq!(message, "has a line of more than 1048576 bytes");
        assert!(line.len() < 2 * MAX_RECORD_BYTES);
        file.set_len(MAX_STREAMED_BYTES + 1).unwrap();
        assert!(matches!(open_delimited(&path, b'\n'), Err(ResultFileError::TooLarge { .. })));
    }
}
