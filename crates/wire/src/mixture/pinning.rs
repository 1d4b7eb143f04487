//! Lock-free synchronization of readers and the writer on a row.
//!
//! Each row has a *version word*, each reader a *pin*; [`NONE`] in either means empty. The reader stores its pin and
//! then checks that the row still has the version. The writer clears the version word and then checks all pins. Both
//! execute a sequentially consistent fence between the two steps, and one of two such fences comes first:
//!
//! * The reader's fence is first: the writer sees the pin (or what the reader stored later) when it checks after its
//!   own fence, and leaves row and blocks unchanged.
//! * The writer's fence is first: the reader sees that the version word is cleared when it checks after its own fence,
//!   and reads nothing.
//!
//! If the writer sees what the reader stored *later*, the pin was set and cleared again in between. Clearing is a
//! release and the writer's check an acquire, so the writer also sees the reference counts that the reader incremented
//! under the pin. A block is reused only if no live version uses it, which rules out new references, and all its
//! reference counts are zero. A decrement is a release and the writer's check of the count an acquire, so the reader's
//! last access to the block happens before the block is overwritten.
//!
//! A reader that reads the version word sees everything written before it: row and blocks (release, acquire).

use std::sync::atomic::{AtomicU64, Ordering, fence};

/// No version. Versions are counted from 0 and never reach this value.
pub(super) const NONE: u64 = u64::MAX;

/// A shared word of memory; the model checker has its own implementation.
pub(super) trait Word {
    /// Loads with acquire.
    fn load_acquire(&self) -> u64;
    /// Stores with release.
    fn store_release(&self, value: u64);
    /// A sequentially consistent fence.
    fn fence();
}

impl Word for AtomicU64 {
    fn load_acquire(&self) -> u64 {
        self.load(Ordering::Acquire)
    }

    fn store_release(&self, value: u64) {
        self.store(value, Ordering::Release);
    }

    fn fence() {
        fence(Ordering::SeqCst);
    }
}

/// Keeps a version pinned while its row is read.
pub(super) struct Pinned<'a, W: Word> {
    pin: &'a W,
}

impl<'a, W: Word> Pinned<'a, W> {
    /// Pins `version`, whose version word is `word`; `None` if the version was removed. A pin belongs to one reader and
    /// holds one version at a time.
    pub fn new(pin: &'a W, word: &W, version: u64) -> Option<Self> {
        pin.store_release(version);
        W::fence();
        let pinned = Self { pin };
        (word.load_acquire() == version).then_some(pinned)
    }
}

impl<W: Word> Drop for Pinned<'_, W> {
    fn drop(&mut self) {
        self.pin.store_release(NONE);
    }
}

/// Removes `version` from its row. Returns `false` and changes nothing if a reader has pinned it.
pub(super) fn retire_version<'a, W: Word + 'a>(
    word: &W,
    version: u64,
    mut pins: impl Iterator<Item = &'a W>,
) -> bool {
    word.store_release(NONE);
    W::fence();
    let pinned = pins.any(|pin| pin.load_acquire() == version);
    if pinned {
        word.store_release(version);
    }
    !pinned
}

#[cfg(test)]
mod tests {
    //! Explores every interleaving of the steps of a reader and the writer, and every value that the memory model
    //! allows.
    #![allow(unsafe_code)]

    use loom::cell::UnsafeCell;
    use loom::sync::Arc;
    use loom::sync::atomic::{AtomicU64, Ordering, fence};
    use loom::thread;

    use super::{NONE, Pinned, Word, retire_version};

    impl Word for AtomicU64 {
        fn load_acquire(&self) -> u64 {
            self.load(Ordering::Acquire)
        }

        fn store_release(&self, value: u64) {
            self.store(value, Ordering::Release);
        }

        fn fence() {
            fence(Ordering::SeqCst);
        }
    }

    /// One row, one reader, one block. The checker fails the test on concurrent access to the block.
    struct Memory {
        version: AtomicU64,
        pin: AtomicU64,
        refcount: AtomicU64,
        block: UnsafeCell<u64>,
    }

    impl Memory {
        fn with_version(version: u64) -> Arc<Self> {
            let [refcount, pin, word] = [0, NONE, version].map(AtomicU64::new);
            Arc::new(Self { version: word, pin, refcount, block: UnsafeCell::new(version) })
        }

        /// Pins, increments, unpins, reads the block, decrements. Returns whether the version existed.
        fn read(&self, version: u64) -> bool {
            let Some(pinned) = Pinned::new(&self.pin, &self.version, version) else { return false };
            self.refcount.fetch_add(1, Ordering::Relaxed);
            drop(pinned);
            // SAFETY: this is what the test checks.
            self.block.with(|block| assert_eq!(unsafe { *block }, version));
            self.refcount.fetch_sub(1, Ordering::Release);
            true
        }

        /// Reuses the block if it is free. Returns whether it was.
        fn replace(&self, old: u64, new: u64) -> bool {
            let free = retire_version(&self.version, old, std::iter::once(&self.pin))
                && self.refcount.load(Ordering::Acquire) == 0;
            if free {
                // SAFETY: this is what the test checks.
                self.block.with_mut(|block| unsafe { *block = new });
                self.version.store_release(new);
            }
            free
        }
    }

    #[test]
    fn blocks_in_use_are_not_reused() {
        loom::model(|| {
            let memory = Memory::with_version(7);
            let reader = {
                let memory = Arc::clone(&memory);
                thread::spawn(move || memory.read(7))
            };
            memory.replace(7, 8);
            reader.join().unwrap();
        });
    }

    #[test]
    fn a_reader_goes_from_version_to_version() {
        loom::model(|| {
            let memory = Memory::with_version(7);
            let reader = {
                let memory = Arc::clone(&memory);
                thread::spawn(move || [7, 8].map(|version| memory.read(version)))
            };
            let replaced = memory.replace(7, 8);
            let [_, second] = reader.join().unwrap();
            assert!(replaced || !second, "a version was there before it was published");
        });
    }
}
