//! The writer's account of the blocks: which are free, which are in use and by whom.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

use calm::Component;
use rustix::fs::{FallocateFlags, fallocate, fstatvfs};
use rustix::io::{Errno, retry_on_intr};
use zerocopy::IntoBytes;

use super::error::SharedMixtureError;
use super::layout::{BlockHeader, Layout};
use super::memory::Map;

/// Free blocks beyond this give their memory back to the system.
pub(super) const SPARE: u32 = 16;

/// All blocks of the file.
#[derive(Debug)]
pub(super) struct Blocks {
    layout: Layout,
    file: File,
    path: PathBuf,
    /// The holds of each extent.
    holds: Vec<Map>,
    /// How many living versions refer to each block.
    references: Vec<u32>,
    /// Free, with memory reserved.
    ready: Vec<u32>,
    /// Free, without memory.
    bare: Vec<u32>,
    /// No living version refers to them, but a reader may.
    lingering: Vec<u32>,
}

impl Blocks {
    /// The account of a file without extents.
    pub fn new(layout: Layout, file: File, path: PathBuf) -> Self {
        let (holds, references) = (Vec::new(), Vec::new());
        let (ready, bare, lingering) = (Vec::new(), Vec::new(), Vec::new());
        Self { layout, file, path, holds, references, ready, bare, lingering }
    }

    /// Adds an extent, and reserves memory for its holds and its first `blocks` blocks.
    pub fn grow(&mut self, blocks: u32) -> Result<(), SharedMixtureError> {
        let extent = self.holds.len() as u32;
        let (first, end) = (extent.checked_mul(self.layout.extent_blocks), self.layout.end(extent + 1));
        let (Some(first), Some(end), Some(start)) = (first, end, self.layout.extent_at(extent)) else {
            return Err(self.failed("grow", Errno::FBIG.into()));
        };
        self.file.set_len(end).map_err(|source| self.failed("grow", source))?;
        self.reserve(start, self.layout.holds_bytes + self.layout.block_at(blocks))?;
        let holds = Map::shared(&self.file, start, self.layout.holds_bytes);
        self.holds.push(holds.map_err(|source| self.failed("map", source))?);
        self.references.resize(self.references.len() + self.layout.extent_blocks as usize, 0);
        self.ready.extend((first..first + blocks).rev());
        self.bare.extend((first + blocks..first + self.layout.extent_blocks).rev());
        Ok(())
    }

    /// Writes a component into a free block.
    ///
    /// The bytes go through the file and not through a map: where no memory is left this gives an error and not a signal.
    pub fn write(
        &mut self,
        (element, slot): (u32, u32),
        version: u64,
        component: &Component,
    ) -> Result<u32, SharedMixtureError> {
        let block = self.free()?;
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
        let mut place = self.place(block);
        for part in [header.as_bytes(), component.inverse().as_bytes(), component.centroid().as_bytes()] {
            if let Err(source) = self.file.write_all_at(part, place) {
                self.ready.push(block);
                return Err(self.failed("write a component", source));
            }
            place += part.len() as u64;
        }
        Ok(block)
    }

    /// One more living version refers to these blocks.
    pub fn refer(&mut self, blocks: &[u32]) {
        for &block in blocks {
            if let Some(count) = self.references.get_mut(block as usize) {
                *count += 1;
            }
        }
    }

    /// A version that refers to these blocks is no more.
    pub fn let_go(&mut self, blocks: &[u32]) {
        for &block in blocks {
            if let Some(count) = self.references.get_mut(block as usize) {
                *count -= 1;
                if *count == 0 {
                    self.lingering.push(block);
                }
            }
        }
    }

    /// Blocks that were written but that no version came to refer to.
    pub fn give_back(&mut self, blocks: impl Iterator<Item = u32>) {
        self.lingering.extend(blocks);
        self.collect();
    }

    /// Frees what nobody refers to and no reader holds.
    pub fn collect(&mut self) {
        let lingering = std::mem::take(&mut self.lingering);
        let (held, free): (Vec<u32>, Vec<u32>) = lingering.into_iter().partition(|&block| self.held(block));
        self.lingering = held;
        for block in free {
            let spare = self.ready.len() >= SPARE as usize;
            if spare && self.punch(block) { &mut self.bare } else { &mut self.ready }.push(block);
        }
    }

    /// A reader's process is dead: so are its holds.
    pub fn release(&self, reader: u32) {
        for holds in &self.holds {
            for index in 0..self.layout.extent_blocks {
                holds.half_word(self.layout.hold_at(reader, index)).store(0, Ordering::Release);
            }
        }
    }

    fn held(&self, block: u32) -> bool {
        let (extent, index) = self.layout.extent_of(block);
        self.holds.get(extent as usize).is_some_and(|holds| {
            let count = |reader| holds.half_word(self.layout.hold_at(reader, index)).load(Ordering::Acquire);
            (0..self.layout.readers).any(|reader| count(reader) > 0)
        })
    }

    /// A free block with memory.
    fn free(&mut self) -> Result<u32, SharedMixtureError> {
        if let Some(block) = self.ready.pop() {
            return Ok(block);
        }
        if self.bare.is_empty() {
            self.grow(0)?;
        }
        let Some(&block) = self.bare.last() else { return Err(self.failed("grow", Errno::FBIG.into())) };
        self.reserve(self.place(block), self.layout.block_bytes)?;
        self.bare.pop();
        Ok(block)
    }

    /// Place of a block in the file.
    fn place(&self, block: u32) -> u64 {
        let (extent, index) = self.layout.extent_of(block);
        let extent = self.layout.extent_at(extent).expect("checked when the extent was made");
        extent + self.layout.holds_bytes + self.layout.block_at(index)
    }

    /// Reserves memory for a part of the file: all of it or nothing.
    pub fn reserve(&self, start: u64, length: u64) -> Result<(), SharedMixtureError> {
        match retry_on_intr(|| fallocate(&self.file, FallocateFlags::empty(), start, length)) {
            Ok(()) => Ok(()),
            Err(Errno::NOSPC) => Err(self.full(length)),
            Err(source) => Err(self.failed("reserve memory", source.into())),
        }
    }

    /// Gives the memory of a block back; false if the system will not have it.
    fn punch(&self, block: u32) -> bool {
        let flags = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
        retry_on_intr(|| fallocate(&self.file, flags, self.place(block), self.layout.block_bytes)).is_ok()
    }

    fn full(&self, needed: u64) -> SharedMixtureError {
        let free = fstatvfs(&self.file).map_or(0, |system| system.f_bavail.saturating_mul(system.f_frsize));
        SharedMixtureError::Full { path: self.path.clone(), needed, free }
    }

    fn failed(&self, doing: &'static str, source: std::io::Error) -> SharedMixtureError {
        SharedMixtureError::File { path: self.path.clone(), doing, source }
    }
}
