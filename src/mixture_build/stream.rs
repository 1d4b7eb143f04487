//! Reads the training data in shards: structure number i of all files together belongs to shard i / shard size.

use std::sync::Arc;
use std::sync::atomic::AtomicU64;

use atoms::Structure;

use super::part::BuildPart;
use crate::exit_status::CommandError;
use crate::structure_files::{FileLine, StructureFiles, StructureReader};

/// A structure with its position in the files.
pub struct TrainingStructure {
    pub structure: Structure,
    /// Of its atoms.
    pub weight: f64,
    pub position: FileLine,
}

/// The structures of a shard, in the order of the files.
pub struct Shard {
    pub index: u64,
    /// Hash of all that its results depend on.
    pub hash: ShardHash,
    pub structures: Vec<TrainingStructure>,
}

/// BLAKE3 of the structures of a shard and their weights.
pub type ShardHash = [u8; 32];

/// Reads the shards of a part, one after another.
pub struct ShardReader {
    structures: StructureReader,
    shard_size: u64,
    part: BuildPart,
    next: u64,
    count: u64,
}

impl ShardReader {
    /// Begins with the first file; `bytes` counts what is read of all of them.
    pub fn new(files: &StructureFiles, shard_size: u64, part: BuildPart, bytes: Arc<AtomicU64>) -> Self {
        Self { structures: files.reader(bytes), shard_size, part, next: 0, count: 0 }
    }

    /// The next shard of the part, `None` at the end of the last file.
    pub fn next_shard(&mut self) -> Result<Option<Shard>, CommandError> {
        loop {
            let index = self.next;
            let mut structures = Vec::new();
            let before = self.count;
            while self.count < before + self.shard_size {
                let Some((frame, file)) = self.structures.next()? else { break };
                self.count += 1;
                if self.part.has(index) {
                    let weight = file.weight_of(&frame)?;
                    let position = FileLine { file: file.path, line: frame.line };
                    structures.push(TrainingStructure { structure: frame.structure, weight, position });
                }
            }
            if self.count == before {
                return Ok(None);
            }
            self.next += 1;
            if self.part.has(index) {
                return Ok(Some(Shard { index, hash: hash(&structures), structures }));
            }
        }
    }

    /// Index of the shard that comes next.
    pub fn next_index(&self) -> u64 {
        self.next
    }

    /// Number of structures in all shards so far, those of other parts included.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Number of structures that did not match the filter so far.
    pub fn left_out(&self) -> u64 {
        self.structures.left_out()
    }
}

fn hash(structures: &[TrainingStructure]) -> ShardHash {
    let mut hasher = blake3::Hasher::new();
    for TrainingStructure { structure, weight, .. } in structures {
        let Structure { species, positions, cell, periodic } = structure;
        hasher.update(&(species.len() as u64).to_le_bytes());
        for species in species {
            hasher.update(&[species.atomic_number()]);
        }
        let numbers = positions.iter().chain(&cell.0).flatten().chain([weight]);
        for number in numbers {
            hasher.update(&number.to_le_bytes());
        }
        hasher.update(&periodic.map(u8::from));
    }
    *hasher.finalize().as_bytes()
}
