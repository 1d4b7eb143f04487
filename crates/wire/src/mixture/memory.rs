//! A part of a file mapped into memory. The only place where pointers are turned into references.

use std::fs::File;
use std::io;
use std::sync::atomic::{AtomicU32, AtomicU64};

use memmap2::{MmapOptions, MmapRaw};

/// Bytes of a file that other processes may see and write at the same time.
#[derive(Debug)]
pub(super) struct Mapping(MmapRaw);

impl Mapping {
    /// Maps `length` bytes from `offset` on, to be read and written.
    ///
    /// # Errors
    /// The file is shorter than that, or the system refuses.
    pub fn shared(file: &File, offset: u64, length: u64) -> io::Result<Self> {
        options(file, offset, length)?.map_raw(file).map(Self)
    }

    /// As [`Mapping::shared`], but a write through it would end the process. Atomic words of it may only be loaded relaxed.
    pub fn read_only(file: &File, offset: u64, length: u64) -> io::Result<Self> {
        options(file, offset, length)?.map_raw_read_only(file).map(Self)
    }

    /// The word at `offset`, which must lie within the map at a multiple of 8.
    pub fn word64(&self, offset: u64) -> &AtomicU64 {
        let place = self.place(offset, 8, 8);
        // SAFETY: `place` is within the mapping, which lives as long as `self`, and aligned; every process accesses
        // these words by atomic operations only.
        unsafe { AtomicU64::from_ptr(place.cast()) }
    }

    /// The half word at `offset`, which must lie within the map at a multiple of 4.
    pub fn word32(&self, offset: u64) -> &AtomicU32 {
        let place = self.place(offset, 4, 4);
        // SAFETY: as for `word`.
        unsafe { AtomicU32::from_ptr(place.cast()) }
    }

    /// `count` numbers at `offset`, which must lie within the map at a multiple of 8.
    ///
    /// # Safety
    /// No process may write them while the slice lives.
    pub unsafe fn numbers(&self, offset: u64, count: usize) -> &[f64] {
        let place = self.place(offset, 8 * count, 8);
        // SAFETY: `place` is the start of `count` aligned numbers within the mapping, which lives as long as `self`;
        // any bits are a number; that nobody writes them is the caller's promise.
        unsafe { std::slice::from_raw_parts(place.cast(), count) }
    }

    /// Panics beyond the map: offsets come from the layout, which was checked against the file.
    fn place(&self, offset: u64, length: usize, alignment: usize) -> *mut u8 {
        let start = usize::try_from(offset).ok();
        let end = start.and_then(|start| start.checked_add(length));
        assert!(end.is_some_and(|end| end <= self.0.len()), "{length} bytes at {offset} are beyond the map");
        let place = self.0.as_mut_ptr().wrapping_add(offset as usize);
        assert!(place.addr().is_multiple_of(alignment), "{offset} is not a multiple of {alignment}");
        place
    }
}

/// Memory beyond the end of a file can be mapped but not touched, so the length is looked at first.
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
