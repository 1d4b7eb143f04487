//! What a reader has in its hands: its slot, the extents it has mapped, its holds on blocks.

use std::fs::File;
use std::mem::offset_of;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use calm::Component;

use super::error::SharedMixtureError;
use super::index::MixtureIndex;
use super::layout::{BLOCK_HEADER, BlockHeader, Layout};
use super::memory::Mapping;

/// Makes components of blocks.
#[derive(Debug)]
pub(super) struct BlockReader {
    pub path: PathBuf,
    pub file: File,
    pub layout: Layout,
    pub slot: Arc<Slot>,
    pub extents: Vec<Option<Arc<Extent>>>,
}

/// The slot of a reader; free again when the reader and all that it was lent are gone.
#[derive(Debug)]
pub(super) struct Slot {
    pub index: MixtureIndex,
    pub reader: u32,
}

/// A part of the blocks, with the holds of all readers.
#[derive(Debug)]
pub(super) struct Extent {
    holds: Mapping,
    blocks: Mapping,
}

/// A block in use by a component of this reader. While it lives the writer leaves the block as it is.
#[derive(Debug)]
struct BlockGuard {
    extent: Arc<Extent>,
    /// Nobody else may have the slot as long as there is a hold in its name.
    _slot: Arc<Slot>,
    /// Places in the two maps of the extent.
    hold_at: u64,
    numbers_at: u64,
    numbers: usize,
}

impl BlockReader {
    /// The component of a block in a pinned row.
    pub fn component(&mut self, place: (u32, u32), block: u32) -> Result<Arc<Component>, SharedMixtureError> {
        let (extent, index) = self.layout.extent_of(block);
        let extent = self.extent(extent)?;
        let at = self.layout.block_at(index);
        let word = |field: usize| extent.blocks.word64(at + field as u64).load(Ordering::Relaxed);
        let found = (word(offset_of!(BlockHeader, element)), word(offset_of!(BlockHeader, slot)));
        if found != (place.0.into(), place.1.into()) {
            let what = format!("block {block} is of component {found:?}, expected {place:?}");
            return Err(SharedMixtureError::Damaged { path: self.path.clone(), what });
        }
        let threshold = f64::from_bits(word(offset_of!(BlockHeader, threshold)));
        let hold = BlockGuard::new(
            &extent,
            &self.slot,
            self.layout.hold_at(self.slot.reader, index),
            at,
            &self.layout,
        );
        Ok(Arc::new(Component::lent(Arc::new(hold), self.layout.dimension as usize, threshold)?))
    }

    /// An extent, mapped when it is first needed.
    fn extent(&mut self, number: u32) -> Result<Arc<Extent>, SharedMixtureError> {
        if let Some(Some(extent)) = self.extents.get(number as usize) {
            return Ok(Arc::clone(extent));
        }
        let damaged = |what| SharedMixtureError::Damaged { path: self.path.clone(), what };
        let start = self.layout.extent_at(number);
        let start = start.ok_or_else(|| damaged(format!("a version refers to extent {number}")))?;
        let extent = Extent::map(&self.file, start, &self.layout)
            .map_err(|error| damaged(format!("extent {number} cannot be mapped: {error}")))?;
        let extent = Arc::new(extent);
        self.extents.resize(self.extents.len().max(number as usize + 1), None);
        if let Some(place) = self.extents.get_mut(number as usize) {
            *place = Some(Arc::clone(&extent));
        }
        Ok(extent)
    }
}

impl Extent {
    fn map(file: &File, start: u64, layout: &Layout) -> std::io::Result<Self> {
        let blocks_bytes = layout.block_at(layout.extent_blocks);
        Ok(Self {
            holds: Mapping::shared(file, start, layout.holds_bytes)?,
            blocks: Mapping::read_only(file, start + layout.holds_bytes, blocks_bytes)?,
        })
    }
}

impl BlockGuard {
    /// To be made under a pin on a version that refers to the block.
    fn new(extent: &Arc<Extent>, slot: &Arc<Slot>, hold_at: u64, block_at: u64, layout: &Layout) -> Self {
        extent.holds.word32(hold_at).fetch_add(1, Ordering::Relaxed);
        let (extent, _slot) = (Arc::clone(extent), Arc::clone(slot));
        Self { extent, _slot, hold_at, numbers_at: block_at + BLOCK_HEADER, numbers: layout.numbers() }
    }
}

impl AsRef<[f64]> for BlockGuard {
    fn as_ref(&self) -> &[f64] {
        // SAFETY: the block was written before its version could be pinned, the hold was raised under that pin, and the
        // writer does not touch a block that is held.
        unsafe { self.extent.blocks.numbers(self.numbers_at, self.numbers) }
    }
}

impl Drop for BlockGuard {
    fn drop(&mut self) {
        self.extent.holds.word32(self.hold_at).fetch_sub(1, Ordering::Release);
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.index.owner(self.reader).store(0, Ordering::Release);
    }
}
