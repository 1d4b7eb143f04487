//! A reader: a walker's process.

use std::fmt;
use std::fs::OpenOptions;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use calm::{ChangedComponent, Component, Mixture};

use super::control::Control;
use super::error::SharedMixtureError;
use super::layout::Layout;
use super::lender::{Lender, Slot};
use super::protocol::{NONE, Pinned, Word};

/// The shared mixture as one reader sees it.
///
/// The reader itself keeps the version it pinned last, so that the next one needs only what changed.
#[derive(Debug)]
pub struct MixtureReader {
    lender: Lender,
    current: Option<Current>,
}

/// A version as it was made from its row.
struct Current {
    mixture: Arc<Mixture>,
    row: Vec<u32>,
}

/// Without its numbers.
impl fmt::Debug for Current {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Current").field("version", &self.mixture.version()).finish_non_exhaustive()
    }
}

impl MixtureReader {
    /// Opens the shared mixture as reader number `reader`, counted from 0. Each number is for one reader at a time.
    ///
    /// # Errors
    /// No such file, another kind of file, a damaged one, a number without a slot or in use.
    pub fn open(path: &Path, reader: u32) -> Result<Self, SharedMixtureError> {
        let failed = |doing, source| SharedMixtureError::File { path: path.into(), doing, source };
        let file = OpenOptions::new().read(true).write(true).open(path);
        let file = file.map_err(|source| failed("open", source))?;
        let layout = Layout::read(&file, path)?;
        if reader >= layout.readers {
            return Err(SharedMixtureError::NoSlot { reader, readers: layout.readers });
        }
        let control = Control::map(&file, &layout).map_err(|source| failed("map", source))?;
        let (own, owner) = (std::process::id().into(), control.owner(reader));
        if let Err(process) = owner.compare_exchange(0, own, Ordering::AcqRel, Ordering::Acquire) {
            return Err(SharedMixtureError::Taken { reader, process });
        }
        let slot = Arc::new(Slot { control, reader });
        let lender = Lender { path: path.into(), file, layout, slot, extents: Vec::new() };
        Ok(Self { lender, current: None })
    }

    /// The highest version published.
    pub fn newest(&self) -> u64 {
        self.lender.slot.control.newest().look()
    }

    /// A version, evaluated in place. It stays as it is while anybody has it or a component of it.
    ///
    /// # Errors
    /// The version is not there (any more), or the file is damaged.
    pub fn pin(&mut self, version: u64) -> Result<Arc<Mixture>, SharedMixtureError> {
        if let Some(current) = &self.current
            && current.mixture.version() == version
        {
            return Ok(Arc::clone(&current.mixture));
        }
        let slot = Arc::clone(&self.lender.slot);
        let gone = || SharedMixtureError::Gone { version, newest: slot.control.newest().look() };
        let row = (0..self.lender.layout.rows).find(|&row| slot.control.version(row).look() == version);
        // A row without a version is not a version.
        let row = row.filter(|_| version != NONE).ok_or_else(gone)?;
        let pin = slot.control.pin(slot.reader);
        let _pinned = Pinned::new(pin, slot.control.version(row), version).ok_or_else(gone)?;
        let row: Vec<u32> = slot.control.row(row).map(|block| block.load(Ordering::Relaxed)).collect();
        let mixture = match &self.current {
            Some(current) => following(&mut self.lender, current, &row)?.at_version(version),
            None => Mixture::new(version, elements(&mut self.lender, &row)?)?,
        };
        let mixture = Arc::new(mixture);
        self.current = Some(Current { mixture: Arc::clone(&mixture), row });
        Ok(mixture)
    }
}

/// All components of a pinned row.
fn elements(lender: &mut Lender, row: &[u32]) -> Result<Vec<Vec<Arc<Component>>>, SharedMixtureError> {
    let mut blocks = row.iter();
    let shape = lender.layout.shape.clone();
    let elements = (0..).zip(shape).map(|(element, count)| {
        let components = (0..count).zip(blocks.by_ref());
        components.map(|(slot, &block)| lender.lend((element, slot), block)).collect()
    });
    elements.collect()
}

/// The current mixture with the components that have other blocks in a pinned row.
///
/// A block that the current version holds cannot have been used anew, so the same number is the same component.
fn following(lender: &mut Lender, current: &Current, row: &[u32]) -> Result<Mixture, SharedMixtureError> {
    let blocks = row.iter().zip(&current.row).zip(lender.layout.places());
    let other = blocks.filter(|((new, old), _)| new != old).map(|((&block, _), place)| (place, block));
    let other: Vec<_> = other.collect();
    let changed = other.into_iter().map(|((element, slot), block)| {
        let component = lender.lend((element, slot), block)?;
        Ok(ChangedComponent { element: element as usize, slot: slot as usize, component })
    });
    let changed = changed.collect::<Result<Vec<_>, SharedMixtureError>>()?;
    Ok(current.mixture.with_changes(&changed)?)
}
