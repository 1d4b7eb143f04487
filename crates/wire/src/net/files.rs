//! Files for walkers on other hosts, by the hash of their content.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;

/// Maximum size of the part in one message, bytes.
const MAX_PART_BYTES: u64 = 4 << 20;

pub(super) struct Files(BTreeMap<String, PathBuf>);

impl Files {
    pub(super) fn new(files: BTreeMap<String, PathBuf>) -> Self {
        Self(files)
    }

    /// Length of a file, and a part of it starting at an offset; `None` if the campaign has no such file.
    pub(super) fn part(&self, hash: &str, offset: u64) -> io::Result<Option<(u64, Vec<u8>)>> {
        let Some(path) = self.0.get(hash) else { return Ok(None) };
        let file = File::open(path)?;
        let length = file.metadata()?.len();
        let mut part = vec![0; length.saturating_sub(offset).min(MAX_PART_BYTES) as usize];
        file.read_exact_at(&mut part, offset)?;
        Ok(Some((length, part)))
    }
}
