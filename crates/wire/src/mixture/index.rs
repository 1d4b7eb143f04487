//! The index: the atomic words that writer and readers share.

use std::fs::File;
use std::io;
use std::sync::atomic::{AtomicU32, AtomicU64};

use super::layout::{CACHE_LINE, SharedMixtureLayout};
use super::memory::Mapping;
use super::pinning::{NONE, Word};

/// Newest version, reader slots, version words and rows.
#[derive(Debug)]
pub(super) struct MixtureIndex {
    map: Mapping,
    layout: SharedMixtureLayout,
}

impl MixtureIndex {
    pub fn map(file: &File, layout: &SharedMixtureLayout) -> io::Result<Self> {
        let map = Mapping::shared(file, layout.index_at, layout.index_bytes)?;
        Ok(Self { map, layout: layout.clone() })
    }

    /// The newest version.
    pub fn newest(&self) -> &AtomicU64 {
        self.map.word64(0)
    }

    /// Process id of the slot's owner, 0 if free.
    pub fn owner(&self, reader: u32) -> &AtomicU64 {
        self.map.word64(CACHE_LINE * (1 + u64::from(reader)))
    }

    /// The version that a reader is currently copying.
    pub fn pin(&self, reader: u32) -> &AtomicU64 {
        self.map.word64(CACHE_LINE * (1 + u64::from(reader)) + 8)
    }

    pub fn pins(&self) -> impl Iterator<Item = &AtomicU64> {
        (0..self.layout.readers).map(|reader| self.pin(reader))
    }

    /// The version in a row.
    pub fn version(&self, row: u32) -> &AtomicU64 {
        self.map.word64(self.layout.versions_at + 8 * u64::from(row))
    }

    /// Block number of each component. A row is written before its version word, and read under a pin.
    pub fn row(&self, row: u32) -> impl Iterator<Item = &AtomicU32> {
        let start = self.layout.rows_at + self.layout.row_bytes * u64::from(row);
        (0..self.layout.components).map(move |component| self.map.word32(start + 4 * u64::from(component)))
    }

    /// Removes all versions and pins.
    pub fn clear(&self) {
        self.pins().for_each(|pin| pin.store_release(NONE));
        (0..self.layout.rows).for_each(|row| self.version(row).store_release(NONE));
    }
}
