//! Allocation of blocks by the writer.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

use calm::Component;
use rustix::fs::{FallocateFlags, fallocate, fstatvfs};
use rustix::io::{Errno, retry_on_intr};
use zerocopy::IntoBytes;

use super::error::SharedMixtureError;
use super::layout::{BlockHeader, SPARE, SharedMixtureLayout};
use super::memory::Mapping;

/// The blocks of the file.
#[derive(Debug)]
pub(super) struct BlockAllocator {
    layout: SharedMixtureLayout,
    file: File,
    path: PathBuf,
    /// The reference counts of each extent.
    refcounts: Vec<Mapping>,
    /// Number of live versions that use each block.
    references: Vec<u32>,
    /// Free blocks with reserved memory.
    backed: Vec<u32>,
    /// Free blocks without memory.
    unbacked: Vec<u32>,
    /// Blocks that no live version uses, but that a reader may still use.
    retired: Vec<u32>,
}

impl BlockAllocator {
    /// An allocator for a file without extents.
    pub fn new(layout: SharedMixtureLayout, file: File, path: PathBuf) -> Self {
        let (refcounts, references) = (Vec::new(), Vec::new());
        let (backed, unbacked, retired) = (Vec::new(), Vec::new(), Vec::new());
        Self { layout, file, path, refcounts, references, backed, unbacked, retired }
    }

    /// Adds an extent, and reserves memory for its reference counts and its first `blocks` blocks.
    pub fn grow(&mut self, blocks: u32) -> Result<(), SharedMixtureError> {
        let extent = self.refcounts.len() as u32;
        let (first, end) = (extent.checked_mul(self.layout.extent_blocks), self.layout.end(extent + 1));
        let (Some(first), Some(end), Some(start)) = (first, end, self.layout.extent_at(extent)) else {
            return Err(self.failed("grow", Errno::FBIG.into()));
        };
        self.file.set_len(end).map_err(|source| self.failed("grow", source))?;
        self.reserve(start, self.layout.refcount_bytes + self.layout.block_at(blocks))?;
        let refcounts = Mapping::shared(&self.file, start, self.layout.refcount_bytes);
        self.refcounts.push(refcounts.map_err(|source| self.failed("map", source))?);
        self.references.resize(self.references.len() + self.layout.extent_blocks as usize, 0);
        self.backed.extend((first..first + blocks).rev());
        self.unbacked.extend((first + blocks..first + self.layout.extent_blocks).rev());
        Ok(())
    }

    /// Writes a component to a free block.
    ///
    /// Uses file I/O instead of the mapping: a lack of memory is then an error and not a signal.
    pub fn write(
        &mut self,
        (element, slot): (u32, u32),
        version: u64,
        component: &Component,
    ) -> Result<u32, SharedMixtureError> {
        let block = self.allocate()?;
        let (count, effective_count) =
            component.statistics().map_or((f64::NAN, f64::NAN), |known| (known.count, known.effective_count));
        let header = BlockHeader {
            element: element.into(),
            slot: slot.into(),
            version,
            threshold: component.threshold(),
            count,
            effective_count,
            reserved: [0; 2],
        };
        let mut offset = self.offset_of(block);
        for part in [header.as_bytes(), component.inverse().as_bytes(), component.centroid().as_bytes()] {
            if let Err(source) = self.file.write_all_at(part, offset) {
                self.backed.push(block);
                return Err(self.failed("write a component", source));
            }
            offset += part.len() as u64;
        }
        Ok(block)
    }

    /// Counts a live version that uses these blocks.
    pub fn incref(&mut self, blocks: &[u32]) {
        for &block in blocks {
            if let Some(count) = self.references.get_mut(block as usize) {
                *count += 1;
            }
        }
    }

    /// Counts the end of a version that used these blocks.
    pub fn decref(&mut self, blocks: &[u32]) {
        for &block in blocks {
            if let Some(count) = self.references.get_mut(block as usize) {
                *count -= 1;
                if *count == 0 {
                    self.retired.push(block);
                }
            }
        }
    }

    /// Frees blocks that were written but never used by a version.
    pub fn discard(&mut self, blocks: impl Iterator<Item = u32>) {
        self.retired.extend(blocks);
        self.reclaim();
    }

    /// Frees retired blocks that no reader uses.
    pub fn reclaim(&mut self) {
        let retired = std::mem::take(&mut self.retired);
        let (held, free): (Vec<u32>, Vec<u32>) =
            retired.into_iter().partition(|&block| self.is_in_use(block));
        self.retired = held;
        for block in free {
            let spare = self.backed.len() >= SPARE as usize;
            if spare && self.punch_hole(block) { &mut self.unbacked } else { &mut self.backed }.push(block);
        }
    }

    /// Clears the reference counts of a reader whose process is dead.
    pub fn release(&self, reader: u32) {
        for refcounts in &self.refcounts {
            for index in 0..self.layout.extent_blocks {
                refcounts.word32(self.layout.refcount_at(reader, index)).store(0, Ordering::Release);
            }
        }
    }

    fn is_in_use(&self, block: u32) -> bool {
        let (extent, index) = self.layout.extent_of(block);
        self.refcounts.get(extent as usize).is_some_and(|refcounts| {
            let count =
                |reader| refcounts.word32(self.layout.refcount_at(reader, index)).load(Ordering::Acquire);
            (0..self.layout.readers).any(|reader| count(reader) > 0)
        })
    }

    /// Takes a free block with memory.
    fn allocate(&mut self) -> Result<u32, SharedMixtureError> {
        if let Some(block) = self.backed.pop() {
            return Ok(block);
        }
        if self.unbacked.is_empty() {
            self.grow(0)?;
        }
        let Some(&block) = self.unbacked.last() else { return Err(self.failed("grow", Errno::FBIG.into())) };
        self.reserve(self.offset_of(block), self.layout.block_bytes)?;
        self.unbacked.pop();
        Ok(block)
    }

    /// Offset of a block in the file.
    fn offset_of(&self, block: u32) -> u64 {
        let (extent, index) = self.layout.extent_of(block);
        let extent = self.layout.extent_at(extent).expect("checked when the extent was added");
        extent + self.layout.refcount_bytes + self.layout.block_at(index)
    }

    /// Reserves memory for a part of the file, completely or not at all.
    pub fn reserve(&self, start: u64, length: u64) -> Result<(), SharedMixtureError> {
        match retry_on_intr(|| fallocate(&self.file, FallocateFlags::empty(), start, length)) {
            Ok(()) => Ok(()),
            Err(Errno::NOSPC) => Err(self.full(length)),
            Err(source) => Err(self.failed("reserve memory", source.into())),
        }
    }

    /// Releases the memory of a block; `false` if the system refuses.
    fn punch_hole(&self, block: u32) -> bool {
        let flags = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
        retry_on_intr(|| fallocate(&self.file, flags, self.offset_of(block), self.layout.block_bytes)).is_ok()
    }

    fn full(&self, needed: u64) -> SharedMixtureError {
        let free = fstatvfs(&self.file).map_or(0, |system| system.f_bavail.saturating_mul(system.f_frsize));
        SharedMixtureError::Full { path: self.path.clone(), needed, free }
    }

    fn failed(&self, doing: &'static str, source: std::io::Error) -> SharedMixtureError {
        SharedMixtureError::File { path: self.path.clone(), doing, source }
    }
}
