//! Layout of the file.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;

use calm::Mixture;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

use super::error::SharedMixtureError;

const MAGIC: [u8; 8] = *b"CALMMIXT";
const FORMAT: u32 = 1;

/// Alignment of sections and blocks, so that memory is reserved and released in whole pages.
const PAGE: u64 = 4096;
/// Words of different readers are in separate cache lines to avoid false sharing.
pub(super) const CACHE_LINE: u64 = 64;
/// Number of free blocks that keep their memory.
pub(super) const SPARE: u32 = 16;
/// Number of live versions in addition to one per walker.
const SPARE_ROWS: u32 = 64;

/// The start of the file, followed by the number of components of each element (u32).
#[derive(Debug, Clone, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct SharedMixtureHeader {
    magic: [u8; 8],
    format: u32,
    /// CRC-32 of the following header fields and of the shape.
    checksum: u32,
    dimension: u32,
    elements: u32,
    readers: u32,
    rows: u32,
    extent_blocks: u32,
    reserved: u32,
}

/// Header of a block, followed by S, `[D × D]`, and **μ**, `[D]`.
#[derive(Debug, Clone, IntoBytes, Immutable)]
#[repr(C)]
pub(super) struct BlockHeader {
    pub element: u64,
    pub slot: u64,
    /// The version that introduced the component.
    pub version: u64,
    /// θ.
    pub threshold: f64,
    /// Number of environments behind the component, NaN if unknown.
    pub count: f64,
    /// Sum of their weights, NaN if unknown.
    pub effective_count: f64,
    pub reserved: [u64; 2],
}

/// A whole cache line, so that S is aligned to one.
pub(super) const BLOCK_HEADER: u64 = size_of::<BlockHeader>() as u64;

const HEADER: usize = size_of::<SharedMixtureHeader>();
const CHECKED_FROM: usize = 16;

/// Sizes and offsets, in bytes from the start of the file unless stated otherwise.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct SharedMixtureLayout {
    /// Features, D.
    pub dimension: u32,
    /// Number of components of each element.
    pub shape: Vec<u32>,
    /// Total number of components: the length of a row.
    pub components: u32,
    /// Number of reader slots.
    pub readers: u32,
    /// Number of rows.
    pub rows: u32,
    /// Blocks per extent.
    pub extent_blocks: u32,
    /// Start of the index.
    pub index_at: u64,
    /// Length of the index.
    pub index_bytes: u64,
    /// Version words, from the start of the index.
    pub versions_at: u64,
    /// Rows, from the start of the index.
    pub rows_at: u64,
    /// Distance between rows.
    pub row_bytes: u64,
    /// Start of the first extent.
    pub extents_at: u64,
    /// Length of one reader's reference counts in an extent.
    pub reader_refcount_bytes: u64,
    /// Length of all reference counts in an extent, which are its first part.
    pub refcount_bytes: u64,
    /// Length of a block.
    pub block_bytes: u64,
    /// Length of an extent.
    pub extent_bytes: u64,
}

impl SharedMixtureLayout {
    /// The layout for mixtures with the shape of `mixture`. An extent has room for two versions of each component, and
    /// at least for one of each and the spare blocks, which are reserved at the start.
    pub fn for_mixture(mixture: &Mixture, readers: u32) -> Result<Self, SharedMixtureError> {
        let (elements, dimension) = (mixture.element_count(), mixture.dimension());
        let components = |element| mixture.components(element).unwrap_or_default().len().try_into().ok();
        let layout = || {
            let shape: Vec<u32> = (0..elements).map(components).collect::<Option<_>>()?;
            let count = shape.iter().try_fold(0_u32, |sum, &count| sum.checked_add(count))?;
            let rows = readers.checked_mul(4)?.checked_add(SPARE_ROWS)?;
            let blocks = count.checked_mul(2)?.max(count.checked_add(SPARE)?);
            Self::new(dimension.try_into().ok()?, shape, readers, rows, blocks)
        };
        layout().ok_or(SharedMixtureError::TooLarge { elements, dimension, readers })
    }

    /// `None` if a size overflows or there is nothing to store.
    fn new(dimension: u32, shape: Vec<u32>, readers: u32, rows: u32, extent_blocks: u32) -> Option<Self> {
        let up = |bytes: u64, to: u64| bytes.checked_next_multiple_of(to);
        let components = shape.iter().try_fold(0_u32, |sum, &count| sum.checked_add(count))?;
        if dimension == 0 || components == 0 || extent_blocks == 0 {
            return None;
        }
        let index_at = up(HEADER as u64 + 4 * shape.len() as u64, PAGE)?;
        let versions_at = CACHE_LINE * (1 + u64::from(readers));
        let rows_at = up(versions_at + 8 * u64::from(rows), CACHE_LINE)?;
        let row_bytes = up(4 * u64::from(components), CACHE_LINE)?;
        let index_bytes = up(row_bytes.checked_mul(rows.into())?.checked_add(rows_at)?, PAGE)?;
        let reader_refcount_bytes = up(4 * u64::from(extent_blocks), CACHE_LINE)?;
        let refcount_bytes = up(reader_refcount_bytes.checked_mul(readers.into())?.max(1), PAGE)?;
        let numbers = u64::from(dimension) * (u64::from(dimension) + 1);
        let block_bytes = up(numbers.checked_mul(8)?.checked_add(BLOCK_HEADER)?, PAGE)?;
        let extent_bytes = block_bytes.checked_mul(extent_blocks.into())?.checked_add(refcount_bytes)?;
        let extents_at = index_at.checked_add(index_bytes)?;
        Some(Self {
            dimension,
            shape,
            components,
            readers,
            rows,
            extent_blocks,
            index_at,
            index_bytes,
            versions_at,
            rows_at,
            row_bytes,
            extents_at,
            reader_refcount_bytes,
            refcount_bytes,
            block_bytes,
            extent_bytes,
        })
    }

    /// Reads and validates the header of a file.
    pub fn read(file: &File, path: &Path) -> Result<Self, SharedMixtureError> {
        let damaged = |what: &str| SharedMixtureError::Damaged { path: path.into(), what: what.into() };
        let cannot =
            |source| SharedMixtureError::File { path: path.into(), doing: "read the header", source };
        let length = file.metadata().map_err(cannot)?.len();
        let mut bytes = [0; HEADER];
        if length < HEADER as u64 {
            return Err(damaged("it is shorter than its header"));
        }
        file.read_exact_at(&mut bytes, 0).map_err(cannot)?;
        let header = SharedMixtureHeader::read_from_bytes(&bytes)
            .map_err(|_| damaged("it is shorter than its header"))?;
        if header.magic != MAGIC {
            return Err(SharedMixtureError::Magic { path: path.into(), found: header.magic });
        }
        if header.format != FORMAT {
            let (found, expected) = (header.format, FORMAT);
            return Err(SharedMixtureError::Format { path: path.into(), found, expected });
        }
        if length < HEADER as u64 + 4 * u64::from(header.elements) {
            return Err(damaged("it is shorter than its element list"));
        }
        let mut shape = vec![0_u32; header.elements as usize];
        file.read_exact_at(shape.as_mut_bytes(), HEADER as u64).map_err(cannot)?;
        if checksum(&header, &shape) != header.checksum {
            return Err(damaged("its header has a wrong checksum"));
        }
        let SharedMixtureHeader { dimension, readers, rows, extent_blocks, .. } = header;
        let layout = Self::new(dimension, shape, readers, rows, extent_blocks)
            .ok_or_else(|| damaged("its sizes overflow"))?;
        if layout.end(1).is_none_or(|end| length < end) {
            return Err(damaged("it is shorter than its header says"));
        }
        Ok(layout)
    }

    /// Writes the header, which makes the file valid for readers.
    pub fn write(&self, file: &File) -> std::io::Result<()> {
        let mut header = SharedMixtureHeader {
            magic: MAGIC,
            format: FORMAT,
            checksum: 0,
            dimension: self.dimension,
            elements: self.shape.len() as u32,
            readers: self.readers,
            rows: self.rows,
            extent_blocks: self.extent_blocks,
            reserved: 0,
        };
        header.checksum = checksum(&header, &self.shape);
        file.write_all_at(self.shape.as_bytes(), HEADER as u64)?;
        file.write_all_at(header.as_bytes(), 0)
    }

    /// Element and slot of every component, in the order of a row.
    pub fn component_keys(&self) -> impl Iterator<Item = (u32, u32)> {
        (0..).zip(&self.shape).flat_map(|(element, &count)| (0..count).map(move |slot| (element, slot)))
    }

    /// Count of numbers in a block: S and **μ**.
    pub fn numbers(&self) -> usize {
        let dimension = self.dimension as usize;
        dimension * (dimension + 1)
    }

    /// The extent of a block, and the block's index in it.
    pub fn extent_of(&self, block: u32) -> (u32, u32) {
        (block / self.extent_blocks, block % self.extent_blocks)
    }

    /// Start of an extent; `None` if it overflows.
    pub fn extent_at(&self, extent: u32) -> Option<u64> {
        self.extent_bytes.checked_mul(extent.into())?.checked_add(self.extents_at)
    }

    /// Length of a file with this number of extents.
    pub fn end(&self, extents: u32) -> Option<u64> {
        self.extent_at(extents).filter(|&end| i64::try_from(end).is_ok())
    }

    /// Offset of a block from the start of the blocks of its extent.
    pub fn block_at(&self, index: u32) -> u64 {
        u64::from(index) * self.block_bytes
    }

    /// Offset of a reader's reference count of a block, from the start of its extent.
    pub fn refcount_at(&self, reader: u32, index: u32) -> u64 {
        u64::from(reader) * self.reader_refcount_bytes + 4 * u64::from(index)
    }
}

fn checksum(header: &SharedMixtureHeader, shape: &[u32]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(header.as_bytes().get(CHECKED_FROM..).unwrap_or_default());
    hasher.update(shape.as_bytes());
    hasher.finalize()
}
