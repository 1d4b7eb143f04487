//! Resources of a reader: its slot, the extents it has mapped, and its references to blocks.

use std::fs::File;
use std::mem::offset_of;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use calm::Component;

use super::error::SharedMixtureError;
use super::index::MixtureIndex;
use super::layout::{BLOCK_HEADER, BlockHeader, SharedMixtureLayout};
use super::memory::Mapping;

/// Reads blocks as components.
#[derive(Debug)]
pub(super) struct BlockReader {
    pub path: PathBuf,
    pub file: File,
    pub layout: SharedMixtureLayout,
    pub slot: Arc<ReaderSlot>,
    pub extents: Vec<Option<Arc<Extent>>>,
}

/// A reader's slot; freed when the reader and all its components are dropped.
#[derive(Debug)]
pub(super) struct ReaderSlot {
    pub index: MixtureIndex,
    pub reader: u32,
}

/// A group of blocks, with the reference counts of all readers.
#[derive(Debug)]
pub(super) struct Extent {
    refcounts: Mapping,
    blocks: Mapping,
}

/// A reference of this reader to a block. While it lives, the writer does not change the block.
#[derive(Debug)]
struct BlockGuard {
    extent: Arc<Extent>,
    /// The slot stays taken while it has references.
    _slot: Arc<ReaderSlot>,
    /// Offsets in the two mappings of the extent.
    refcount_at: u64,
    numbers_at: u64,
    numbers: usize,
}

impl BlockReader {
    /// The component in a block of a pinned row.
    pub fn component(&mut self, key: (u32, u32), block: u32) -> Result<Arc<Component>, SharedMixtureError> {
        let (extent, index) = self.layout.extent_of(block);
        let extent = self.extent(extent)?;
        let at = self.layout.block_at(index);
        let word = |field: usize| extent.blocks.word64(at + field as u64).load(Ordering::Relaxed);
        let found = (word(offset_of!(BlockHeader, element)), word(offset_of!(BlockHeader, slot)));
        if found != (key.0.into(), key.1.into()) {
            let what = format!("block {block} contains component {found:?}, expected {key:?}");
            return Err(SharedMixtureError::Damaged { path: self.path.clone(), what });
        }
        let threshold = f64::from_bits(word(offset_of!(BlockHeader, threshold)));
        let guard = BlockGuard::new(
            &extent,
            &self.slot,
            self.layout.refcount_at(self.slot.reader, index),
            at,
            &self.layout,
        );
        Ok(Arc::new(Component::from_shared(Arc::new(guard), self.layout.dimension as usize, threshold)?))
    }

    /// An extent; mapped when first used.
    fn extent(&mut self, number: u32) -> Result<Arc<Extent>, SharedMixtureError> {
        if let Some(Some(extent)) = self.extents.get(number as usize) {
            return Ok(Arc::clone(extent));
        }
        let damaged = |what| SharedMixtureError::Damaged { path: self.path.clone(), what };
        let start = self.layout.extent_at(number);
        let start =
            start.ok_or_else(|| damaged(format!("a version refers to the invalid extent {number}")))?;
        let extent = Extent::map(&self.file, start, &self.layout)
            .map_err(|error| damaged(format!("cannot map extent {number}: {error}")))?;
        let extent = Arc::new(extent);
        self.extents.resize(self.extents.len().max(number as usize + 1), None);
        if let Some(entry) = self.extents.get_mut(number as usize) {
            *entry = Some(Arc::clone(&extent));
        }
        Ok(extent)
    }
}

impl Extent {
    fn map(file: &File, start: u64, layout: &SharedMixtureLayout) -> std::io::Result<Self> {
        let blocks_bytes = layout.block_at(layout.extent_blocks);
        Ok(Self {
            refcounts: Mapping::shared(file, start, layout.refcount_bytes)?,
            blocks: Mapping::read_only(file, start + layout.refcount_bytes, blocks_bytes)?,
        })
    }
}

impl BlockGuard {
    /// Must be called under a pin on a version that uses the block.
    fn new(
        extent: &Arc<Extent>,
        slot: &Arc<ReaderSlot>,
        refcount_at: u64,
        block_at: u64,
        layout: &SharedMixtureLayout,
    ) -> Self {
        extent.refcounts.word32(refcount_at).fetch_add(1, Ordering::Relaxed);
        let (extent, _slot) = (Arc::clone(extent), Arc::clone(slot));
        Self { extent, _slot, refcount_at, numbers_at: block_at + BLOCK_HEADER, numbers: layout.numbers() }
    }
}

impl AsRef<[f64]> for BlockGuard {
    fn as_ref(&self) -> &[f64] {
        // SAFETY: the block was written before its version could be pinned, the reference count was incremented under
        // that pin, and the writer does not change a block that is in use.
        unsafe { self.extent.blocks.numbers(self.numbers_at, self.numbers) }
    }
}

impl Drop for BlockGuard {
    fn drop(&mut self) {
        self.extent.refcounts.word32(self.refcount_at).fetch_sub(1, Ordering::Release);
    }
}

impl Drop for ReaderSlot {
    fn drop(&mut self) {
        self.index.owner(self.reader).store(0, Ordering::Release);
    }
}
