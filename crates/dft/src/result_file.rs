//! Reads files that a program left in its directory.
//!
//! Anything may stand under the name of a result: a pipe without a writer, a link to an endless device, a
//! sparse file larger than the memory. This module opens all such files: regular files only, up to a size
//! limit, without blocking and without following links.

use std::fs::{File, FileType};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Take};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;

use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;

/// Size limit of a file that is read into memory: 256 MiB.
pub const MAX_BYTES: u64 = 256 << 20;
/// Size limit of a file that is streamed, such as VASP's: 16 GiB.
pub const MAX_STREAMED_BYTES: u64 = 16 << 30;
/// Size limit of a record in a streamed file: 1 MiB.
pub const MAX_RECORD_BYTES: usize = 1 << 20;

/// Why a file is not read. The message continues a sentence that starts with the file's name.
#[derive(Debug, thiserror::Error)]
pub enum ResultFileError {
    /// The file does not exist.
    #[error("is missing")]
    Missing,
    /// Not a regular file; reading it might never end.
    #[error("is {found}, expected a regular file")]
    NotRegular {
        /// What it is.
        found: &'static str,
    },
    /// Too large for the memory.
    #[error("has {bytes} bytes, expected at most {most}")]
    TooLarge {
        /// Its size.
        bytes: u64,
        /// The limit.
        most: u64,
    },
    /// The system reports an error.
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
}

impl ResultFileError {
    /// Whether the file does not exist.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Missing)
    }
}

/// The end of a file.
#[derive(Debug)]
pub struct Tail {
    /// Size of the whole file, bytes.
    pub length: u64,
    /// Its last bytes.
    pub bytes: Vec<u8>,
}

/// Reads a file of at most [`MAX_BYTES`] bytes.
///
/// # Errors
/// See [`ResultFileError`].
pub fn read(path: &Path) -> Result<Vec<u8>, ResultFileError> {
    let (file, length) = open(path)?;
    within(length, MAX_BYTES)?;
    let mut content = Vec::new();
    // The file may grow while it is read.
    let read = file.take(MAX_BYTES + 1).read_to_end(&mut content)?;
    within(read as u64, MAX_BYTES)?;
    Ok(content)
}

/// Reads the last `bytes` of a file of any size.
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

/// Opens a file of at most [`MAX_STREAMED_BYTES`] bytes for streaming. Reading fails if more than
/// [`MAX_RECORD_BYTES`] bytes come without a `delimiter`, which bounds the memory of a parser that keeps one
/// record.
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

/// Opens a regular file; also returns its size.
fn open(path: &Path) -> Result<(File, u64), ResultFileError> {
    // Without NONBLOCK, opening a pipe waits for a writer.
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

    /// Every reader rejects all of these at once.
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
        // A line without an end.
        let mut line = Vec::new();
        let message =
            open_delimited(&path, b'\n').unwrap().read_until(b'\n', &mut line).unwrap_err().to_string();
        assert_eq!(message, "has a line of more than 1048576 bytes");
        assert!(line.len() < 2 * MAX_RECORD_BYTES);
        file.set_len(MAX_STREAMED_BYTES + 1).unwrap();
        assert!(matches!(open_delimited(&path, b'\n'), Err(ResultFileError::TooLarge { .. })));
    }
}
