//! The state of a build on disk, from which it continues after any interruption.
//!
//! The directory `A.npz.build` beside the artifact has `build.json`, which identifies the build; the log `pass-1` of the clusters
//! of shards; `partition`, which ends pass 1; one file each for the running sums of passes 2 and 3; an empty `end-2` once `pass-2` has all shards;
//! and those of the `feature_cache`. Each part of a build by several processes has its own files, with its name (`pass-2-3of8`), and an
//! `end-1-3of8` when it is through pass 1. Every file but the log appears complete, by renaming; all that have contents carry checksums.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use calm::build::{ElementPartition, ExactSums};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::cluster_log::KnownShards;
use super::feature_cache::is_feature_file;
use super::identity::Identity;
use super::part::BuildPart;
use super::stream::ShardHash;
use crate::atomic_file::{AtomicFile, cannot_create, cannot_write};
use crate::exit_status::CommandError;

const IDENTITY: &str = "build.json";
const LOCK: &str = "lock";
const PARTITION: &str = "partition";
const CLUSTERS: &str = "pass-1";
const END: &str = "end-1-";
/// `configs/slurm/calm-build.sh` looks for it.
const END_OF_PASS_2: &str = "end-2";

/// The state is saved again once this many times the duration of the last time has passed: it costs at most 5 % of the time.
const PAUSE: u32 = 19;

/// The directory, which this process alone uses; or the files of a part in it.
pub struct BuildState {
    directory: PathBuf,
    /// `None` for the whole.
    part: Option<BuildPart>,
    _locks: Vec<File>,
    /// When it was last saved, and how long that took.
    saved: Instant,
    cost: Duration,
}

/// That a part is through pass 1.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PartEnd {
    /// Number of structures in all files.
    pub structures: u64,
    /// Of its shards, by index.
    pub hashes: BTreeMap<u64, ShardHash>,
}

/// The result of pass 1.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Partition {
    /// Number of structures in all files.
    pub structures: u64,
    /// Of each shard.
    pub hashes: Vec<ShardHash>,
    /// By element index.
    pub elements: Vec<ElementPartition>,
}

/// The sums of pass 2 or 3 over the finished shards: of bounded size, whatever their number.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct RunningSums {
    pub finished: BTreeSet<u64>,
    /// By element index; `None` for an element without atoms. Empty before the first shard.
    pub elements: Vec<Option<ExactSums>>,
}

impl BuildState {
    /// Opens the state of the build of `output`, or begins one. Returns it with whether it existed.
    ///
    /// # Errors
    /// Another process uses it; it belongs to another build (unless `restart`, which removes it first).
    pub fn open(output: &Path, identity: &Identity, restart: bool) -> Result<(Self, bool), CommandError> {
        let directory = directory(output);
        fs::create_dir_all(&directory).map_err(|error| cannot_create(&directory, error))?;
        let lock = lock(&directory.join(LOCK), output, File::try_lock)?;
        let state = Self::new(directory, None, vec![lock]);
        let path = state.path(IDENTITY);
        // Nothing is lost with a state without results.
        if path.exists() && !restart && state.names()?.iter().any(|name| is_result(name)) {
            let found = state.identity()?;
            identity.check_same(&found).map_err(|difference| state.other_build(&difference))?;
            return Ok((state, true));
        }
        // Results without an identity are left of a state that was removed.
        state.clear()?;
        state.write_identity(identity)?;
        Ok((state, false))
    }

    /// Opens a part of the state of the build of `output`, or begins it. Other processes may use other parts.
    ///
    /// # Errors
    /// A process uses this part or the whole; the state belongs to another build.
    pub fn open_part(
        output: &Path,
        identity: &Identity,
        part: BuildPart,
    ) -> Result<(Self, bool), CommandError> {
        let directory = directory(output);
        fs::create_dir_all(&directory).map_err(|error| cannot_create(&directory, error))?;
        let whole = lock(&directory.join(LOCK), output, File::try_lock_shared)?;
        let own = lock(&directory.join(format!("{LOCK}-{}", part.file_name())), output, File::try_lock)?;
        let state = Self::new(directory, Some(part), vec![whole, own]);
        if !state.path(IDENTITY).exists() {
            if state.names()?.iter().any(|name| is_result(name)) {
                return Err(unreadable(
                    &state.directory,
                    format_args!("it has results but no {IDENTITY}; remove it and start over"),
                ));
            }
            // Parts that begin together write the same.
            state.write_identity(identity)?;
        }
        let found = state.identity()?;
        identity.check_same(&found).map_err(|difference| state.other_build(&difference))?;
        let names = state.names()?;
        let end = format!("-{}", part.file_name());
        let exists = names.iter().any(|name| is_result(name) && name.ends_with(&end));
        Ok((state, exists))
    }

    /// Opens the state that parts have left, to merge them.
    ///
    /// # Errors
    /// There is none; a process uses it.
    pub fn open_existing(output: &Path) -> Result<(Self, Identity), CommandError> {
        let directory = directory(output);
        if !directory.join(IDENTITY).is_file() {
            return Err(CommandError::Input(format!(
                "{}: expected the directory of a build in parts (calmwalk calm build … --pass 1 --part 1/2)",
                directory.display()
            )));
        }
        let lock = lock(&directory.join(LOCK), output, File::try_lock)?;
        let state = Self::new(directory, None, vec![lock]);
        let identity = state.identity()?;
        Ok((state, identity))
    }

    fn new(directory: PathBuf, part: Option<BuildPart>, locks: Vec<File>) -> Self {
        Self { directory, part, _locks: locks, saved: Instant::now(), cost: Duration::ZERO }
    }

    fn identity(&self) -> Result<Identity, CommandError> {
        let path = self.path(IDENTITY);
        let text = fs::read(&path).map_err(|error| unreadable(&path, error))?;
        serde_json::from_slice(&text).map_err(|error| unreadable(&path, error))
    }

    fn write_identity(&self, identity: &Identity) -> Result<(), CommandError> {
        let path = self.path(IDENTITY);
        let mut file = AtomicFile::create(&path)?;
        let text = serde_json::to_vec_pretty(identity).map_err(CommandError::failed)?;
        file.write_all(&text).map_err(|error| cannot_write(&path, error))?;
        file.finish()
    }

    /// Where it is.
    pub fn directory(&self) -> &Path {
        &self.directory
    }

    /// Whether saving now costs little compared with the time since it was last saved.
    pub fn is_due(&self) -> bool {
        self.saved.elapsed() > PAUSE * self.cost
    }

    /// The shards whose clusters are known.
    pub fn known_shards(&self) -> Result<KnownShards, CommandError> {
        let is_log = |name: &&String| {
            let of_part = || BuildPart::from_file_name(name.strip_prefix(CLUSTERS)?.strip_prefix('-')?);
            name.as_str() == CLUSTERS || of_part().is_some()
        };
        let names = self.names()?;
        let logs: Vec<PathBuf> = names.iter().filter(is_log).map(|name| self.path(name)).collect();
        KnownShards::open(self.path(&self.own_name(CLUSTERS)), &logs)
    }

    /// Saves the log of this process.
    pub fn save_known_shards(&mut self, known: &KnownShards) -> Result<(), CommandError> {
        let begun = Instant::now();
        known.sync().map_err(|error| cannot_write(known.path(), error))?;
        self.has_saved(begun);
        Ok(())
    }

    /// Ends pass 1 of the part.
    pub fn save_part_end(&mut self, end: &PartEnd) -> Result<(), CommandError> {
        self.write(&format!("{END}{}", self.part.unwrap_or(BuildPart::WHOLE).file_name()), end)
    }

    /// The parts that are through pass 1.
    pub fn part_ends(&self) -> Result<BTreeMap<BuildPart, PartEnd>, CommandError> {
        self.parts(END)
    }

    /// The sums of all parts in pass 2 or 3.
    pub fn part_sums(&self, pass: usize) -> Result<BTreeMap<BuildPart, RunningSums>, CommandError> {
        self.parts(&format!("pass-{pass}-"))
    }

    /// The files of parts whose names begin with `prefix`.
    fn parts<T: DeserializeOwned>(&self, prefix: &str) -> Result<BTreeMap<BuildPart, T>, CommandError> {
        let mut found = BTreeMap::new();
        for name in self.names()? {
            if let Some(part) = name.strip_prefix(prefix).and_then(BuildPart::from_file_name)
                && let Some(value) = self.read(&name)?
            {
                found.insert(part, value);
            }
        }
        Ok(found)
    }

    /// The result of pass 1, if it is finished.
    pub fn partition(&self) -> Result<Option<Partition>, CommandError> {
        self.read(PARTITION)
    }

    /// Ends pass 1.
    pub fn save_partition(&mut self, partition: &Partition) -> Result<(), CommandError> {
        self.write(PARTITION, partition)
    }

    /// The sums of pass 2 or 3 over the shards of this process.
    pub fn sums(&self, pass: usize) -> Result<RunningSums, CommandError> {
        Ok(self.read(&self.own_name(&format!("pass-{pass}")))?.unwrap_or_default())
    }

    /// The sums of pass 2 or 3 over all shards, or over those that are merged.
    pub fn merged_sums(&self, pass: usize) -> Result<RunningSums, CommandError> {
        Ok(self.read(&format!("pass-{pass}"))?.unwrap_or_default())
    }

    /// Ends pass 2 of the whole, whose sums over all shards are saved.
    pub fn end_pass_2(&self) -> Result<(), CommandError> {
        AtomicFile::create(&self.path(END_OF_PASS_2))?.finish()
    }

    /// Whether pass 2 of the whole was ended.
    pub fn has_ended_pass_2(&self) -> bool {
        self.path(END_OF_PASS_2).exists()
    }

    /// Replaces the sums of pass 2 or 3.
    pub fn save_sums(&mut self, pass: usize, sums: &RunningSums) -> Result<(), CommandError> {
        self.write(&self.own_name(&format!("pass-{pass}")), sums)
    }

    /// The name of a file of this process.
    fn own_name(&self, name: &str) -> String {
        match self.part {
            None => name.to_owned(),
            Some(part) => format!("{name}-{}", part.file_name()),
        }
    }

    /// Removes the directory, but leaves files that are none of the state's.
    pub fn remove(self) -> Result<(), CommandError> {
        self.clear()?;
        for name in self.names()?.iter().filter(|name| name.starts_with(LOCK)) {
            let lock = self.path(name);
            fs::remove_file(&lock).map_err(|error| cannot_remove(&lock, error))?;
        }
        match fs::remove_dir(&self.directory) {
            Err(error) if error.kind() != std::io::ErrorKind::DirectoryNotEmpty => {
                Err(cannot_remove(&self.directory, error))
            }
            _ => Ok(()),
        }
    }

    /// Removes the identity first: a directory without it has no state. (Stored features carry the identity in their checksums.)
    fn clear(&self) -> Result<(), CommandError> {
        let own = |name: &String| {
            is_result(name) || is_feature_file(name) || (name.starts_with('.') && name.ends_with(".part"))
        };
        let rest = self.names()?.into_iter().filter(own);
        for name in std::iter::once(IDENTITY.to_owned()).chain(rest) {
            let path = self.path(&name);
            match fs::remove_file(&path) {
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    return Err(cannot_remove(&path, error));
                }
                _ => (),
            }
        }
        Ok(())
    }

    fn names(&self) -> Result<Vec<String>, CommandError> {
        let entries = fs::read_dir(&self.directory).map_err(|error| unreadable(&self.directory, error))?;
        Ok(entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    fn write(&mut self, name: &str, value: &impl Serialize) -> Result<(), CommandError> {
        let begun = Instant::now();
        let path = self.path(name);
        let bytes = postcard::to_stdvec(value).map_err(|error| cannot_write(&path, error))?;
        let mut file = AtomicFile::create(&path)?;
        let checksum = blake3::hash(&bytes);
        file.write_all(checksum.as_bytes())
            .and_then(|()| file.write_all(&bytes))
            .map_err(|error| cannot_write(&path, error))?;
        file.finish()?;
        self.has_saved(begun);
        Ok(())
    }

    fn has_saved(&mut self, begun: Instant) {
        self.saved = Instant::now();
        self.cost = self.saved - begun;
    }

    fn read<T: DeserializeOwned>(&self, name: &str) -> Result<Option<T>, CommandError> {
        let path = self.path(name);
        let bytes = match fs::read(&path) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(unreadable(&path, error)),
        };
        let damaged = || unreadable(&path, "the file is damaged; start over with --restart");
        let (checksum, content) = bytes.split_at_checked(blake3::OUT_LEN).ok_or_else(damaged)?;
        if blake3::hash(content).as_bytes() != checksum {
            return Err(damaged());
        }
        postcard::from_bytes(content).map(Some).map_err(|_| damaged())
    }

    /// The failure to continue the state of another build.
    pub fn other_build(&self, difference: &str) -> CommandError {
        CommandError::Input(format!(
            "{} has the state of another build: {difference}; repeat the command that began it, or start over with --restart",
            self.directory.display()
        ))
    }
}

fn is_result(name: &str) -> bool {
    name == PARTITION || name == END_OF_PASS_2 || name.starts_with("pass-") || name.starts_with(END)
}

/// Where the state of the build of `output` is.
fn directory(output: &Path) -> PathBuf {
    let mut name = output.file_name().unwrap_or_default().to_owned();
    name.push(".build");
    output.with_file_name(name)
}

fn lock(
    path: &Path,
    output: &Path,
    lock: impl Fn(&File) -> Result<(), TryLockError>,
) -> Result<File, CommandError> {
    let file = File::create(path).map_err(|error| cannot_create(path, error))?;
    match lock(&file) {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            Err(CommandError::Failed(format!("another process is building {}", output.display())))
        }
        Err(TryLockError::Error(error)) => Err(cannot_write(path, error)),
    }
}

fn unreadable(path: &Path, error: impl std::fmt::Display) -> CommandError {
    CommandError::Failed(format!("cannot read {}: {error}", path.display()))
}

fn cannot_remove(path: &Path, error: impl std::fmt::Display) -> CommandError {
    CommandError::Failed(format!("cannot remove {}: {error}", path.display()))
}
