//! Memory-mapped parts of a file. The only place that converts pointers to references.

use std::fs::File;
use std::io;
use std::sync::atomic::{AtomicU32, AtomicU64};

use memmap2::{MmapOptions, MmapRaw};

/// A mapping that other processes may read and write concurrently.
#[derive(Debug)]
pub(super) struct Mapping(MmapRaw);

impl Mapping {
    /// Maps `length` bytes from `offset`, for reading and writing.
    ///
    /// # Errors
    /// The file is shorter, or the system refuses.
    pub fn shared(file: &File, offset: u64, length: u64) -> io::Result<Self> {
        options(file, offset, length)?.map_raw(file).map(Self)
    }

    /// Like [`Mapping::shared`], but read-only: a write would kill the process. Its atomic words may only be loaded
    /// relaxed.
    pub fn read_only(file: &File, offset: u64, length: u64) -> io::Result<Self> {
        options(file, offset, length)?.map_raw_read_only(file).map(Self)
    }

    /// The 64-bit word at `offset`, which must lie within the mapping and be a multiple of 8.
    pub fn word64(&self, offset: u64) -> &AtomicU64 {
        let pointer = self.pointer(offset, 8, 8);
        // SAFETY: `pointer` is within the mapping, which lives as long as `self`, and aligned; all processes access these
        // words only atomically.
        unsafe { AtomicU64::from_ptr(pointer.cast()) }
    }

    /// The 32-bit word at `offset`, which must lie within the mapping and be a multiple of 4.
    pub fn word32(&self, offset: u64) -> &AtomicU32 {
        let pointer = self.pointer(offset, 4, 4);
        // SAFETY: as for `word64`.
        unsafe { AtomicU32::from_ptr(pointer.cast()) }
    }

    /// `count` numbers at `offset`, which must lie within the mapping and be a multiple of 8.
    ///
    /// # Safety
    /// No process may write them while the slice lives.
    pub unsafe fn numbers(&self, offset: u64, count: usize) -> &[f64] {
        let pointer = self.pointer(offset, 8 * count, 8);
        // SAFETY: `pointer` is the start of `count` aligned numbers within the mapping, which lives as long as `self`;
        // any bits are a valid number; the caller guarantees that no process writes them.
        unsafe { std::slice::from_raw_parts(pointer.cast(), count) }
    }

    /// Panics outside the mapping: offsets come from the layout, which was checked against the file.
    fn pointer(&self, offset: u64, length: usize, alignment: usize) -> *mut u8 {
        let start = usize::try_from(offset).ok();
        let end = start.and_then(|start| start.checked_add(length));
        assert!(end.is_some_and(|end| end <= self.0.len()), "{length} bytes at {offset} are beyond the map");
        let pointer = self.0.as_mut_ptr().wrapping_add(offset as usize);
        assert!(pointer.addr().is_multiple_of(alignment), "{offset} is not a multiple of {alignment}");
        pointer
    }
}

/// Checks the length first, since accessing a mapping beyond the end of the file would raise SIGBUS.
fn options(file: &File, offset: u64, length: u64) -> io::Result<MmapOptions> {
    let end = offset.checked_add(length);
    let (Some(end), Ok(size)) = (end, usize::try_from(length)) else {
        return Err(io::ErrorKind::FileTooLarge.into());
    };
    if file.metadata()?.len() < end {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    let mut options = MmapOptions::new();
    options.offset(offset).len(size);
    Ok(options)
}
