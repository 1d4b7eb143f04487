//! The clusters of finished shards in pass 1, on disk: memory has only the places where they are.
//!
//! Each process appends its shards to a log of its own, one record each: the length of the content, index and hash of the
//! shard, and the BLAKE3 hash of the content. A crash can leave an incomplete record at the end, which is cut off when the
//! process continues.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, Read};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use calm::build::ShardClusters;

use super::stream::ShardHash;
use crate::atomic_file::{cannot_create, cannot_write};
use crate::exit_status::CommandError;

/// Length of content, index and hash of the shard, hash of the content.
const HEADER: usize = 8 + 8 + 32 + 32;

/// The clusters of all shards that are known, also of shards with contents that they no longer have.
pub struct KnownShards {
    logs: Vec<ClusterLog>,
    /// Path of the log of this process, and its number among the logs once it exists.
    own: (PathBuf, Option<usize>),
    /// The number of the log and the record's position.
    places: BTreeMap<(u64, ShardHash), (usize, u64)>,
}

/// A log of one process.
struct ClusterLog {
    path: PathBuf,
    file: File,
    /// Where the next record begins.
    end: u64,
}

impl KnownShards {
    /// Reads the logs of other processes and that of this one.
    pub fn open(own: PathBuf, logs: &[PathBuf]) -> Result<Self, CommandError> {
        let mut known = Self { logs: Vec::new(), own: (own, None), places: BTreeMap::new() };
        for path in logs {
            let is_own = *path == known.own.0;
            let file = File::options().read(true).write(is_own).open(path);
            known.read_log(ClusterLog {
                file: file.map_err(|error| unreadable(path, error))?,
                path: path.clone(),
                end: 0,
            })?;
            if is_own {
                let log = &known.logs[known.logs.len() - 1];
                log.file.set_len(log.end).map_err(|error| cannot_write(path, error))?;
                known.own.1 = Some(known.logs.len() - 1);
            }
        }
        Ok(known)
    }

    /// Adds a log up to its first incomplete record.
    fn read_log(&mut self, mut log: ClusterLog) -> Result<(), CommandError> {
        let cannot = |error| unreadable(&log.path, error);
        let length = log.file.metadata().map_err(cannot)?.len();
        let (mut file, mut content) = (BufReader::new(&log.file), Vec::new());
        while let Some(shard) = next_record(&mut file, length, &mut content).map_err(cannot)? {
            self.places.insert(shard, (self.logs.len(), log.end));
            log.end += (HEADER + content.len()) as u64;
        }
        self.logs.push(log);
        Ok(())
    }

    /// The shards.
    pub fn shards(&self) -> impl Iterator<Item = (u64, ShardHash)> {
        self.places.keys().copied()
    }

    /// The clusters of a shard by element index, if they are known.
    pub fn read(&self, index: u64, hash: ShardHash) -> Result<Option<Vec<ShardClusters>>, CommandError> {
        let Some(&(number, position)) = self.places.get(&(index, hash)) else { return Ok(None) };
        let log = &self.logs[number];
        let damaged = || unreadable(&log.path, "the file is damaged; start over with --restart");
        let mut header = [0; HEADER];
        log.file.read_exact_at(&mut header, position).map_err(|error| unreadable(&log.path, error))?;
        let (size, .., checksum) = fields(&header);
        if size > log.end - position {
            return Err(damaged());
        }
        let mut content = vec![0; size as usize];
        let read = log.file.read_exact_at(&mut content, position + HEADER as u64);
        read.map_err(|error| unreadable(&log.path, error))?;
        if blake3::hash(&content) != checksum {
            return Err(damaged());
        }
        postcard::from_bytes(&content).map(Some).map_err(|_| damaged())
    }

    /// Adds a finished shard, which has a record in the log of this process then.
    pub fn append(
        &mut self,
        index: u64,
        hash: ShardHash,
        elements: &[ShardClusters],
    ) -> Result<(), CommandError> {
        let number = self.own_log()?;
        let log = &mut self.logs[number];
        let content = postcard::to_stdvec(elements).map_err(|error| cannot_write(&log.path, error))?;
        let mut record = Vec::with_capacity(HEADER + content.len());
        record.extend((content.len() as u64).to_le_bytes());
        record.extend(index.to_le_bytes());
        record.extend(hash);
        record.extend(blake3::hash(&content).as_bytes());
        record.extend(content);
        log.file.write_all_at(&record, log.end).map_err(|error| cannot_write(&log.path, error))?;
        self.places.insert((index, hash), (number, log.end));
        log.end += record.len() as u64;
        Ok(())
    }

    fn own_log(&mut self) -> Result<usize, CommandError> {
        let (path, number) = &mut self.own;
        if let Some(number) = number {
            return Ok(*number);
        }
        let file = File::options().read(true).write(true).create(true).truncate(true).open(&*path);
        let file = file.map_err(|error| cannot_create(path, error))?;
        self.logs.push(ClusterLog { path: path.clone(), file, end: 0 });
        *number = Some(self.logs.len() - 1);
        Ok(self.logs.len() - 1)
    }

    /// Has the operating system write the log to the disk, so that it outlives a failure of the host.
    pub fn sync(&self) -> io::Result<()> {
        self.own.1.map_or(Ok(()), |number| self.logs[number].file.sync_data())
    }

    /// Where this process appends.
    pub fn path(&self) -> &Path {
        &self.own.0
    }
}

/// Index and hash of the shard of the next record, with its content; `None` at the end of the log and for a record that is incomplete, also
/// because another process cuts it off its log meanwhile. No content is longer than the log was.
fn next_record(
    log: &mut impl Read,
    length: u64,
    content: &mut Vec<u8>,
) -> io::Result<Option<(u64, ShardHash)>> {
    content.clear();
    log.by_ref().take(HEADER as u64).read_to_end(content)?;
    let Ok(header) = content.as_slice().try_into() else { return Ok(None) };
    let (size, index, shard, checksum) = fields(header);
    if size > length {
        return Ok(None);
    }
    content.clear();
    log.by_ref().take(size).read_to_end(content)?;
    let is_complete = content.len() as u64 == size && blake3::hash(content) == checksum;
    Ok(is_complete.then_some((index, shard)))
}

fn fields(header: &[u8; HEADER]) -> (u64, u64, ShardHash, blake3::Hash) {
    let number = |at: usize| u64::from_le_bytes(std::array::from_fn(|byte| header[at + byte]));
    let hash = |at: usize| -> [u8; 32] { std::array::from_fn(|byte| header[at + byte]) };
    (number(0), number(8), hash(16), blake3::Hash::from_bytes(hash(48)))
}

fn unreadable(path: &Path, error: impl std::fmt::Display) -> CommandError {
    CommandError::Failed(format!("cannot read {}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn clusters(shard: u64) -> Vec<ShardClusters> {
        vec![ShardClusters { shard, element: 0, atoms: 7, weight: 3.5, candidates: vec![] }]
    }

    #[test]
    fn shards_are_read_back_up_to_an_incomplete_record() {
        let directory = tempfile::tempdir().unwrap();
        let (own, other) = (directory.path().join("own"), directory.path().join("other"));
        let mut known = KnownShards::open(own.clone(), &[]).unwrap();
        assert!(!own.exists());
        for shard in [4, 2, 9] {
            known.append(shard, [shard as u8; 32], &clusters(shard)).unwrap();
        }
        known.sync().unwrap();
        assert_eq!(known.read(2, [2; 32]).unwrap(), Some(clusters(2)));
        assert_eq!(known.read(2, [3; 32]).unwrap(), None);
        fs::copy(&own, &other).unwrap();
        let whole = fs::read(&own).unwrap();
        let record = whole.len() / 3;
        // Any part of the last record, and one with another content.
        let mut changed = whole.clone();
        *changed.last_mut().unwrap() ^= 1;
        let cuts = (0..record).map(|length| whole[..2 * record + length].to_vec());
        for left in cuts.chain([changed]) {
            fs::write(&own, left).unwrap();
            let mut known = KnownShards::open(own.clone(), std::slice::from_ref(&own)).unwrap();
            assert_eq!(known.shards().collect::<Vec<_>>(), [(2, [2; 32]), (4, [4; 32])]);
            known.append(9, [9; 32], &clusters(9)).unwrap();
            assert_eq!(fs::read(&own).unwrap(), whole);
        }
        // A log of another process is left as it is.
        fs::write(&other, &whole[..record + 5]).unwrap();
        let both = KnownShards::open(own.clone(), &[other.clone(), own]).unwrap();
        assert_eq!(both.shards().count(), 3);
        assert_eq!(both.read(4, [4; 32]).unwrap(), Some(clusters(4)));
        assert_eq!(fs::read(&other).unwrap().len(), record + 5);
    }

    #[test]
    fn a_record_that_another_process_cuts_off_meanwhile_is_none() {
        let directory = tempfile::tempdir().unwrap();
        let own = directory.path().join("own");
        KnownShards::open(own.clone(), &[]).unwrap().append(4, [4; 32], &clusters(4)).unwrap();
        let record = fs::read(&own).unwrap();
        let mut content = Vec::new();
        let mut found = |mut left: &[u8]| next_record(&mut left, record.len() as u64, &mut content).unwrap();
        assert_eq!(found(&record), Some((4, [4; 32])));
        // The log had the whole record when its length was read.
        assert!((0..record.len()).all(|end| found(&record[..end]).is_none()));
        let mut long = record.clone();
        long[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        assert_eq!(found(&long), None);
    }
}
