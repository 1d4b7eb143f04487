//! The features of shards on disk, in the directory of the state: a later pass reads those that an earlier one computed.
//!
//! The file `features-7` has the features of the structures of shard 7 in the order in which every pass takes them, as
//! little-endian numbers, and then a checksum of the build's identity, the shard's hash and these numbers. A file that is missing,
//! damaged or of another shard or build costs time only: the features are computed again, and are the same.

use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use super::part::BuildPart;
use super::stream::{Shard, ShardHash};

/// Start of the names of the files.
const NAME: &str = "features-";

/// End of the names of those that are being written, which begin with a dot.
const UNFINISHED: &str = ".part";

/// Bytes of the checksum.
const CHECKSUM: u64 = blake3::OUT_LEN as u64;

/// The files of a part's shards, up to a total size.
pub struct FeatureCache {
    directory: PathBuf,
    /// D
    dimension: usize,
    /// Largest total size, bytes.
    limit: u64,
    /// Size of the files that are there, or are being written.
    used: AtomicU64,
    /// What identifies the build.
    identity: Vec<u8>,
    /// Whether a file could not be written, as on a full disk: then no other is begun.
    failed: AtomicBool,
}

impl FeatureCache {
    /// Opens the files of the shards of a part in the directory of its build; `limit` is their largest total size in bytes. Removes
    /// those beyond it, and what a killed process left unfinished. Files of other parts are theirs.
    pub fn open(directory: &Path, part: BuildPart, identity: Vec<u8>, dimension: usize, limit: u64) -> Self {
        let files = fs::read_dir(directory).into_iter().flatten().flatten();
        let mut used = 0;
        for file in files {
            let name = file.file_name();
            let Some((shard, is_finished)) = shard_of(&name.to_string_lossy()) else { continue };
            if !part.has(shard) {
                continue;
            }
            let size = file.metadata().map_or(0, |found| found.len());
            if is_finished && used + size <= limit {
                used += size;
            } else {
                let _ = fs::remove_file(file.path());
            }
        }
        let (directory, failed) = (directory.to_owned(), AtomicBool::new(false));
        Self { directory, dimension, limit, used: AtomicU64::new(used), identity, failed }
    }

    /// Reads the features of a shard, if a file of the right size is there.
    pub fn reader(&self, shard: &Shard) -> Option<FeatureReader> {
        let file = File::open(self.path(shard.index)).ok()?;
        (file.metadata().ok()?.len() == self.size(shard)).then(|| FeatureReader {
            file: BufReader::new(file),
            hasher: self.hasher(&shard.hash),
            bytes: Vec::new(),
            features: Vec::new(),
        })
    }

    /// Begins to write the features of a shard. `None` if there is no room for them, or a file cannot be created.
    pub fn writer(&self, shard: &Shard) -> Option<FeatureWriter<'_>> {
        let path = self.path(shard.index);
        // A damaged file makes room.
        if let Ok(found) = fs::metadata(&path)
            && fs::remove_file(&path).is_ok()
        {
            self.release(found.len());
        }
        let size = self.size(shard);
        let fits = |used: u64| used.checked_add(size).filter(|sum| *sum <= self.limit);
        if self.failed.load(Ordering::Relaxed)
            || self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits).is_err()
        {
            return None;
        }
        // No two threads or parts have the same shard.
        let unfinished = self.directory.join(format!(".{NAME}{}{UNFINISHED}", shard.index));
        match File::create(&unfinished) {
            Ok(file) => {
                let (file, hasher) = (BufWriter::new(file), self.hasher(&shard.hash));
                Some(FeatureWriter { cache: self, path, unfinished, file, hasher, size, failed: false })
            }
            Err(_) => {
                self.release(size);
                None
            }
        }
    }

    /// Bytes of the file of a shard.
    fn size(&self, shard: &Shard) -> u64 {
        let atoms: usize = shard.structures.iter().map(|training| training.structure.len()).sum();
        (atoms * self.dimension * size_of::<f64>()) as u64 + CHECKSUM
    }

    fn release(&self, bytes: u64) {
        let _ = self
            .used
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, |used| Some(used.saturating_sub(bytes)));
    }

    fn hasher(&self, hash: &ShardHash) -> blake3::Hasher {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&self.identity).update(hash);
        hasher
    }

    fn path(&self, shard: u64) -> PathBuf {
        self.directory.join(format!("{NAME}{shard}"))
    }
}

/// Whether a file of this name has features.
pub fn is_feature_file(name: &str) -> bool {
    name.starts_with(NAME)
}

/// The shard of a file of this name, and whether the file is finished.
fn shard_of(name: &str) -> Option<(u64, bool)> {
    let unfinished = name.strip_prefix('.').and_then(|name| name.strip_suffix(UNFINISHED));
    let shard = unfinished.unwrap_or(name).strip_prefix(NAME)?;
    Some((shard.parse().ok()?, unfinished.is_none()))
}

/// Reads a file.
pub struct FeatureReader {
    file: BufReader<File>,
    hasher: blake3::Hasher,
    bytes: Vec<u8>,
    features: Vec<f64>,
}

impl FeatureReader {
    /// The next `count` numbers. `None` if the file cannot be read.
    pub fn next(&mut self, count: usize) -> Option<&[f64]> {
        self.bytes.resize(count * size_of::<f64>(), 0);
        self.file.read_exact(&mut self.bytes).ok()?;
        self.hasher.update(&self.bytes);
        self.features.clear();
        let (numbers, _) = self.bytes.as_chunks::<8>();
        self.features.extend(numbers.iter().map(|number| f64::from_le_bytes(*number)));
        Some(&self.features)
    }

    /// Ends the file: whether the checksum, which must be all that is left, belongs to what was read.
    pub fn finish(mut self) -> bool {
        let mut found = Vec::new();
        (&mut self.file).take(CHECKSUM + 1).read_to_end(&mut found).is_ok()
            && found == self.hasher.finalize().as_bytes()
    }
}

/// Writes a file. After an error, as of a full disk, it gives back what it has taken, and no other file is begun.
pub struct FeatureWriter<'a> {
    cache: &'a FeatureCache,
    path: PathBuf,
    unfinished: PathBuf,
    file: BufWriter<File>,
    hasher: blake3::Hasher,
    size: u64,
    failed: bool,
}

impl FeatureWriter<'_> {
    /// Adds numbers.
    pub fn add(&mut self, features: &[f64]) {
        if self.failed {
            return;
        }
        let bytes: Vec<u8> = features.iter().flat_map(|number| number.to_le_bytes()).collect();
        self.hasher.update(&bytes);
        if self.file.write_all(&bytes).is_err() {
            self.fail();
        }
    }

    fn fail(&mut self) {
        self.failed = true;
        self.cache.failed.store(true, Ordering::Relaxed);
        // The state of the build needs the room.
        let _ = self.file.get_ref().set_len(0);
    }

    /// Makes the file appear.
    pub fn finish(mut self) {
        let checksum = self.hasher.finalize();
        let mut end = || -> io::Result<()> {
            self.file.write_all(checksum.as_bytes())?;
            self.file.flush()?;
            fs::rename(&self.unfinished, &self.path)
        };
        // Dropping it removes what is not finished.
        if !self.failed {
            match end() {
                Ok(()) => self.size = 0,
                Err(_) => self.fail(),
            }
        }
    }
}

impl Drop for FeatureWriter<'_> {
    fn drop(&mut self) {
        if self.size > 0 {
            self.cache.release(self.size);
            let _ = fs::remove_file(&self.unfinished);
        }
    }
}
