//! Reads the training data in shards: structure number i of all files together belongs to shard i / shard size.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use atoms::extxyz::{self, Frame};
use atoms::{FileError, Structure, poscar};
use flate2::read::MultiGzDecoder;

use crate::exit_status::Failure;

/// A file of training data.
#[derive(Debug, Clone)]
pub struct DataFile {
    pub path: Arc<Path>,
    /// Weight of the atoms of its structures.
    pub weight: f64,
}

/// A structure with its place in the files.
pub struct TrainingStructure {
    pub structure: Structure,
    pub weight: f64,
    file: Arc<Path>,
    line: usize,
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

/// Reads one shard after another.
pub struct ShardReader {
    files: VecDeque<DataFile>,
    current: Option<(DataFile, Frames)>,
    shard_size: u64,
    next: u64,
    structures: u64,
    bytes: Arc<AtomicU64>,
}

type Frames = Box<dyn Iterator<Item = Result<Frame, FileError>> + Send>;

impl TrainingStructure {
    /// `file:line`
    pub fn place(&self) -> String {
        format!("{}:{}", self.file.display(), self.line)
    }

    /// Wrong input, which names file and line.
    pub fn wrong(&self, reason: impl std::fmt::Display) -> Failure {
        Failure::Input(format!("{}: {reason}", self.place()))
    }
}

impl ShardReader {
    /// Begins with the first file; `bytes` counts what is read of all of them.
    pub fn new(files: &[DataFile], shard_size: u64, bytes: Arc<AtomicU64>) -> Self {
        let files = files.iter().cloned().collect();
        Self { files, current: None, shard_size, next: 0, structures: 0, bytes }
    }

    /// The next shard, `None` at the end of the last file.
    pub fn next_shard(&mut self) -> Result<Option<Shard>, Failure> {
        let mut structures = Vec::new();
        while (structures.len() as u64) < self.shard_size {
            let Some(structure) = self.next_structure()? else { break };
            structures.push(structure);
        }
        if structures.is_empty() {
            return Ok(None);
        }
        let index = self.next;
        self.next += 1;
        self.structures += structures.len() as u64;
        Ok(Some(Shard { index, hash: hash(&structures), structures }))
    }

    /// Index of the shard that comes next.
    pub fn next_index(&self) -> u64 {
        self.next
    }

    /// Number of structures in all shards so far.
    pub fn structures(&self) -> u64 {
        self.structures
    }

    fn next_structure(&mut self) -> Result<Option<TrainingStructure>, Failure> {
        loop {
            if let Some((file, frames)) = &mut self.current
                && let Some(frame) = frames.next()
            {
                let Frame { structure, line, .. } = frame.map_err(Failure::input)?;
                let (weight, file) = (file.weight, Arc::clone(&file.path));
                return Ok(Some(TrainingStructure { structure, weight, file, line }));
            }
            let Some(file) = self.files.pop_front() else { return Ok(None) };
            let mut frames = open(&file.path, &self.bytes).map_err(Failure::input)?.peekable();
            if frames.peek().is_none() {
                return Err(Failure::input(FileError::Empty(file.path.to_path_buf())));
            }
            self.current = Some((file, Box::new(frames)));
        }
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

/// Format of a file.
enum Format {
    Extxyz,
    Poscar,
}

/// The format that the name shows, with or without the extension of a compression.
fn format(path: &Path) -> Option<Format> {
    let name = path.file_name()?.to_string_lossy().to_lowercase();
    let name = name.strip_suffix(".gz").or_else(|| name.strip_suffix(".zst")).unwrap_or(&name);
    let ends = |endings: &[&str]| endings.iter().any(|ending| name.ends_with(ending));
    if ends(&[".xyz", ".extxyz"]) {
        return Some(Format::Extxyz);
    }
    let poscar = ends(&[".poscar", ".vasp"]) || name.starts_with("poscar") || name.starts_with("contcar");
    poscar.then_some(Format::Poscar)
}

/// Checks that the name of a file shows a format that can be read.
pub fn check_format(path: &Path) -> Result<(), Failure> {
    if format(path).is_some() {
        return Ok(());
    }
    Err(Failure::Input(format!(
        "{}: unknown format: expected a name that ends in .extxyz, .xyz, .poscar or .vasp or begins with POSCAR or CONTCAR, each \
         with or without .gz or .zst",
        path.display()
    )))
}

fn open(path: &Path, bytes: &Arc<AtomicU64>) -> Result<Frames, FileError> {
    let owned = path.to_path_buf();
    let input = unpacked(path, bytes).map_err(|source| FileError::Open { path: owned.clone(), source })?;
    match format(path) {
        Some(Format::Extxyz) => Ok(Box::new(extxyz::Reader::new(input).map(move |frame| {
            frame.map_err(|error| FileError::Extxyz {
                path: owned.clone(),
                line: error.line,
                fault: error.kind,
            })
        }))),
        Some(Format::Poscar) => {
            let frame = poscar::read_poscar(input).map_err(|error| FileError::Poscar {
                path: owned,
                line: error.line,
                fault: error.kind,
            })?;
            Ok(Box::new(std::iter::once(Ok(frame))))
        }
        None => Err(FileError::Format(owned)),
    }
}

fn unpacked(path: &Path, bytes: &Arc<AtomicU64>) -> io::Result<Box<dyn BufRead + Send>> {
    let file = BufReader::new(Counting(File::open(path)?, Arc::clone(bytes)));
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    Ok(match extension.as_str() {
        "gz" => Box::new(BufReader::new(MultiGzDecoder::new(file))),
        "zst" => Box::new(BufReader::new(zstd::Decoder::with_buffer(file)?)),
        _ => Box::new(file),
    })
}

/// Counts the bytes read.
struct Counting(File, Arc<AtomicU64>);

impl Read for Counting {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let count = self.0.read(buffer)?;
        self.1.fetch_add(count as u64, Ordering::Relaxed);
        Ok(count)
    }
}

/// The files in the order given, with their weights.
///
/// # Errors
/// A file that is no regular file, has an unknown format or is given twice; a weight of another file.
pub fn data_files(paths: &[PathBuf], weights: &[(PathBuf, f64)]) -> Result<Vec<DataFile>, Failure> {
    let mut files: Vec<DataFile> = Vec::new();
    for path in paths {
        check_format(path)?;
        let found = std::fs::metadata(path)
            .map_err(|error| Failure::Input(format!("{}: cannot be opened: {error}", path.display())))?;
        if !found.is_file() {
            return Err(Failure::Input(format!(
                "{}: expected a regular file, which can be read several times",
                path.display()
            )));
        }
        if files.iter().any(|file| *file.path == **path) {
            return Err(Failure::Input(format!(
                "{} is given twice; use --weight {}=2 for atoms that count twice",
                path.display(),
                path.display()
            )));
        }
        files.push(DataFile { path: path.as_path().into(), weight: 1.0 });
    }
    for (number, (path, weight)) in weights.iter().enumerate() {
        if weights[..number].iter().any(|(other, _)| other == path) {
            return Err(Failure::Input(format!("--weight {}: given twice", path.display())));
        }
        let file = files.iter_mut().find(|file| *file.path == **path);
        let unknown =
            || Failure::Input(format!("--weight {}: expected one of the files of DATA", path.display()));
        file.ok_or_else(unknown)?.weight = *weight;
    }
    Ok(files)
}

/// Total size of the files, bytes.
pub fn total_bytes(files: &[DataFile]) -> Result<u64, Failure> {
    let size = |file: &DataFile| std::fs::metadata(&file.path).map(|found| found.len());
    files.iter().map(size).sum::<io::Result<u64>>().map_err(Failure::failed)
}
