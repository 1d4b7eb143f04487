//! Files whose content belongs to the protocol's identity and which are copied for every calculation.

use std::io::{Error, ErrorKind, Read, Result};
use std::path::{Path, PathBuf};

use flate2::read::GzDecoder;

/// Where a program finds the copies, relative to its working directory.
pub(crate) const DATA_DIRECTORY: &str = "../data";

/// Limit against archives that expand without end; pseudopotentials have a few MB.
const MAX_UNPACKED_BYTES: u64 = 64 << 20;

/// Digits of a hash in messages.
const SHORT_HASH_DIGITS: usize = 12;

/// A file identified by the hash of its content.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PinnedFile {
    path: PathBuf,
    hash: String,
}

impl PinnedFile {
    /// Hashes a file. Also returns its content, decompressed if the name ends with `.gz`.
    ///
    /// # Errors
    /// The file cannot be read or decompressed.
    pub fn open(path: PathBuf) -> Result<(Self, Vec<u8>)> {
        let content = content(&path)?;
        Ok((Self { hash: hash(&content), path }, content))
    }

    /// A file that does not exist.
    #[cfg(test)]
    pub(crate) fn fake(path: &str, hash: &str) -> Self {
        Self { path: path.into(), hash: hash.to_owned() }
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// BLAKE3 of its content.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// Reads the content and compares it with the hash.
    ///
    /// # Errors
    /// The file cannot be read, or its content has changed.
    pub fn content(&self) -> Result<Vec<u8>> {
        let content = content(&self.path)?;
        let found = hash(&content);
        if found == self.hash {
            return Ok(content);
        }
        Err(Error::other(format!(
            "its content has changed: BLAKE3 {}…, where the protocol of the labels has {}…; restore the file \
             of the protocol, or make labels with the new one with calmwalk relabel",
            &found[..SHORT_HASH_DIGITS],
            &self.hash[..SHORT_HASH_DIGITS]
        )))
    }
}

fn hash(content: &[u8]) -> String {
    blake3::hash(content).to_hex().to_string()
}

fn content(path: &Path) -> Result<Vec<u8>> {
    let bytes = std::fs::read(path)?;
    if path.extension().is_none_or(|extension| extension != "gz") {
        return Ok(bytes);
    }
    let mut content = Vec::new();
    match GzDecoder::new(&bytes[..]).take(MAX_UNPACKED_BYTES).read_to_end(&mut content)? as u64 {
        MAX_UNPACKED_BYTES => Err(Error::new(ErrorKind::InvalidData, "more than 64 MB when unpacked")),
        _ => Ok(content),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::io::Write;

    use flate2::Compression;
    use flate2::write::GzEncoder;

    use super::*;

    #[test]
    fn only_the_content_that_was_hashed_is_copied() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("Si.psp8");
        fs::write(&path, "first").unwrap();
        let (pinned, content) = PinnedFile::open(path.clone()).unwrap();
        assert_eq!(
            (content.as_slice(), pinned.content().unwrap().as_slice()),
            (&b"first"[..], &b"first"[..])
        );

        // Same length and same name.
        fs::write(directory.path().join("new"), "other").unwrap();
        fs::rename(directory.path().join("new"), &path).unwrap();
        let error = pinned.content().unwrap_err().to_string();
        let [found, expected] = ["other", "first"].map(|content| hash(content.as_bytes())[..12].to_owned());
        let begin = format!(
            "its content has changed: BLAKE3 {found}…, where the protocol of the labels has {expected}…;"
        );
        assert!(error.starts_with(&begin) && error.contains("calmwalk relabel"), "{error}");

        fs::write(&path, "first").unwrap();
        assert_eq!(pinned.content().unwrap(), b"first");
        fs::remove_file(&path).unwrap();
        assert_eq!(pinned.content().unwrap_err().kind(), ErrorKind::NotFound);
    }

    #[test]
    fn what_is_packed_is_hashed_and_copied_unpacked() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("Si.PBE.gz");
        for level in [Compression::fast(), Compression::best()] {
            let mut packed = GzEncoder::new(Vec::new(), level);
            packed.write_all(&b"setup ".repeat(1000)).unwrap();
            fs::write(&path, packed.finish().unwrap()).unwrap();
            let (pinned, content) = PinnedFile::open(path.clone()).unwrap();
            assert_eq!((content, pinned.hash()), (b"setup ".repeat(1000), &*hash(&b"setup ".repeat(1000))));
        }
        fs::write(&path, "no archive").unwrap();
        assert!(PinnedFile::open(path).is_err());
    }
}
