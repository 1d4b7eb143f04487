//! The reader, used by walkers.

use std::fmt;
use std::fs::OpenOptions;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use calm::{ChangedComponent, Component, Mixture};

use super::block_reader::{BlockReader, ReaderSlot};
use super::error::SharedMixtureError;
use super::index::MixtureIndex;
use super::layout::SharedMixtureLayout;
use super::pinning::{NONE, Pinned, Word};

/// The shared mixture as seen by one reader.
///
/// Keeps the last pinned version, so that pinning the next one reads only the changed components.
#[derive(Debug)]
pub struct MixtureReader {
    block_reader: BlockReader,
    current: Option<Current>,
}

/// A version and its row.
struct Current {
    mixture: Arc<Mixture>,
    row: Vec<u32>,
}

/// Omits the numbers.
impl fmt::Debug for Current {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Current").field("version", &self.mixture.version()).finish_non_exhaustive()
    }
}

impl MixtureReader {
    /// Opens the shared mixture as reader number `reader`, counted from 0. Only one reader can use a number at a time.
    ///
    /// # Errors
    /// The file does not exist, is damaged or another kind of file; or the number has no slot or is in use.
    pub fn open(path: &Path, reader: u32) -> Result<Self, SharedMixtureError> {
        let failed = |doing, source| SharedMixtureError::File { path: path.into(), doing, source };
        let file = OpenOptions::new().read(true).write(true).open(path);
        let file = file.map_err(|source| failed("open", source))?;
        let layout = SharedMixtureLayout::read(&file, path)?;
        if reader >= layout.readers {
            return Err(SharedMixtureError::NoSlot { reader, readers: layout.readers });
        }
        let index = MixtureIndex::map(&file, &layout).map_err(|source| failed("map", source))?;
        let (own, owner) = (std::process::id().into(), index.owner(reader));
        if let Err(process) = owner.compare_exchange(0, own, Ordering::AcqRel, Ordering::Acquire) {
            return Err(SharedMixtureError::SlotTaken { reader, process });
        }
        let slot = Arc::new(ReaderSlot { index, reader });
        let block_reader = BlockReader { path: path.into(), file, layout, slot, extents: Vec::new() };
        Ok(Self { block_reader, current: None })
    }

    /// The newest version.
    pub fn newest(&self) -> u64 {
        self.block_reader.slot.index.newest().load_acquire()
    }

    /// A version, evaluated in place. It remains unchanged while the mixture or one of its components is in use.
    ///
    /// # Errors
    /// The version does not exist (any more), or the file is damaged.
    pub fn pin(&mut self, version: u64) -> Result<Arc<Mixture>, SharedMixtureError> {
        if let Some(current) = &self.current
            && current.mixture.version() == version
        {
            return Ok(Arc::clone(&current.mixture));
        }
        let slot = Arc::clone(&self.block_reader.slot);
        let not_found =
            || SharedMixtureError::VersionNotFound { version, newest: slot.index.newest().load_acquire() };
        let row =
            (0..self.block_reader.layout.rows).find(|&row| slot.index.version(row).load_acquire() == version);
        // An empty row has no version.
        let row = row.filter(|_| version != NONE).ok_or_else(not_found)?;
        let pin = slot.index.pin(slot.reader);
        let _pinned = Pinned::new(pin, slot.index.version(row), version).ok_or_else(not_found)?;
        let row: Vec<u32> = slot.index.row(row).map(|block| block.load(Ordering::Relaxed)).collect();
        let mixture = match &self.current {
            Some(current) => following(&mut self.block_reader, current, &row)?.at_version(version),
            None => Mixture::new(version, elements(&mut self.block_reader, &row)?)?,
        };
        let mixture = Arc::new(mixture);
        self.current = Some(Current { mixture: Arc::clone(&mixture), row });
        Ok(mixture)
    }
}

/// All components of a pinned row.
fn elements(
    block_reader: &mut BlockReader,
    row: &[u32],
) -> Result<Vec<Vec<Arc<Component>>>, SharedMixtureError> {
    let mut blocks = row.iter();
    let shape = block_reader.layout.shape.clone();
    let elements = (0..).zip(shape).map(|(element, count)| {
        let components = (0..count).zip(blocks.by_ref());
        components.map(|(slot, &block)| block_reader.component((element, slot), block)).collect()
    });
    elements.collect()
}

/// The current mixture with the components whose blocks differ in a pinned row.
///
/// A block in use by the current version cannot have been reused, so an equal number means the same component.
fn following(
    block_reader: &mut BlockReader,
    current: &Current,
    row: &[u32],
) -> Result<Mixture, SharedMixtureError> {
    let blocks = row.iter().zip(&current.row).zip(block_reader.layout.component_keys());
    let other = blocks.filter(|((new, old), _)| new != old).map(|((&block, _), key)| (key, block));
    let other: Vec<_> = other.collect();
    let changed = other.into_iter().map(|((element, slot), block)| {
        let component = block_reader.component((element, slot), block)?;
        Ok(ChangedComponent { element: element as usize, slot: slot as usize, component })
    });
    let changed = changed.collect::<Result<Vec<_>, SharedMixtureError>>()?;
    Ok(current.mixture.with_changes(&changed)?)
}
