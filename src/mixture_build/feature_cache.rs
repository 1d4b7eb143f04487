//! The features of shards on disk, in the directory of the state: a later pass reads those that an earlier one computed.
//!
//! The file `features-7` has the features of the structures of shard 7 in the order in which every pass takes them, as
//! little-endian numbers, and then a checksum of the shard's hash and these. A file that is missing, damaged or of another shard
//! costs time only: the features are computed again, and are the same.

use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use super::stream::{Shard, ShardHash};

/// Start of the names of the files.
const NAME: &str = "features-";

/// Bytes of the checksum.
const CHECKSUM: u64 = blake3::OUT_LEN as u64;

/// The files, up to a total size.
pub struct FeatureCache {
    directory: PathBuf,
    /// D
    dimension: usize,
    /// Largest total size, bytes.
    limit: u64,
    /// Size of the files that are there, or are being written.
    used: AtomicU64,
}

impl FeatureCache {
    /// Opens the files in a directory; `limit` is the largest total size in bytes.
    pub fn open(directory: &Path, dimension: usize, limit: u64) -> Self {
        let files = fs::read_dir(directory).into_iter().flatten().flatten();
        let own = files.filter(|file| is_feature_file(&file.file_name().to_string_lossy()));
        let used = own.filter_map(|file| Some(file.metadata().ok()?.len())).sum();
        Self { directory: directory.to_owned(), dimension, limit, used: AtomicU64::new(used) }
    }

    /// Reads the features of a shard, if a file of the right size is there.
    pub fn reader(&self, shard: &Shard) -> Option<FeatureReader> {
        let file = File::open(self.path(shard.index)).ok()?;
        (file.metadata().ok()?.len() == self.size(shard)).then(|| FeatureReader {
            file: BufReader::new(file),
            hasher: hasher(&shard.hash),
            bytes: Vec::new(),
            features: Vec::new(),
        })
    }

    /// Begins to write the features of a shard. `None` if there is no room for them, or a file cannot be created.
    pub fn writer(&self, shard: &Shard) -> Option<FeatureWriter<'_>> {
        let path = self.path(shard.index);
        // What a damaged file has taken.
        self.release(fs::metadata(&path).map_or(0, |found| found.len()));
        let size = self.size(shard);
        let fits = |used: u64| used.checked_add(size).filter(|sum| *sum <= self.limit);
        let reserved = self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits).is_ok();
        if !reserved {
            let _ = fs::remove_file(&path);
            return None;
        }
        let unfinished = self.directory.join(format!(".{NAME}{}-{}.part", shard.index, std::process::id()));
        match File::create(&unfinished) {
            Ok(file) => {
                let (file, hasher) = (BufWriter::new(file), hasher(&shard.hash));
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

    fn path(&self, shard: u64) -> PathBuf {
        self.directory.join(format!("{NAME}{shard}"))
    }
}

/// Whether a file of this name has features.
pub fn is_feature_file(name: &str) -> bool {
    name.starts_with(NAME)
}

fn hasher(hash: &ShardHash) -> blake3::Hasher {
    let mut hasher = blake3::Hasher::new();
    hasher.update(hash);
    hasher
}

/// Reads a file.
pub struct FeatureReader {
    file: BufReader<File>,
    hasher: blake3::Hasher,
    bytes: Vec<u8>,
    features: Vec<f64>,
}

impl FeatureReader {
    /// The next so many numbers. `None` if the file cannot be read.
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
        self.file.read_to_end(&mut found).is_ok() && found == self.hasher.finalize().as_bytes()
    }
}

/// Writes a file. After an error, as of a full disk, it takes nothing more, and leaves no file.
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
        self.failed = self.file.write_all(&bytes).is_err();
    }

    /// Makes the file appear.
    pub fn finish(mut self) {
        let checksum = self.hasher.finalize();
        let mut end = || -> io::Result<()> {
            self.file.write_all(checksum.as_bytes())?;
            self.file.flush()?;
            fs::rename(&self.unfinished, &self.path)
        };
        self.failed = self.failed || end().is_err();
        // Dropping it removes what is not finished.
        if !self.failed {
            self.size = 0;
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
