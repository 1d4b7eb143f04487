//! How a reader and the writer agree on a row without a lock.
//!
//! Each row has a *version word*, each reader a *pin*; [`NONE`] in either means nothing. The reader stores its pin and then
//! looks whether the row still has the version. The writer takes the version word away and then looks at all pins.
//! Both put a sequentially consistent fence between the two steps, and of two such fences one comes first:
//!
//! * the reader's first: the writer, looking after its own fence, sees the pin (or what the reader stored later) and
//!   leaves row and blocks as they are;
//! * the writer's first: the reader, looking after its own fence, sees the version word gone and reads nothing.
//!
//! If the writer sees what the reader stored *later*, then the pin was set and cleared again in between. Clearing is a release
//! and the writer's look an acquire, so it also sees the holds that the reader raised while it had the pin. A block is
//! used anew only when no living version refers to it, which makes new holds impossible, and all holds are zero;
//! lowering a hold is a release, the writer's look at it an acquire, so the reader's last look at the block comes
//! before it is overwritten.
//!
//! A reader that reads the version word sees all that was written before it was stored: row and blocks (release, acquire).

use std::sync::atomic::{AtomicU64, Ordering, fence};

/// No version. Versions are counted from 0, so none gets here.
pub(super) const NONE: u64 = u64::MAX;

/// A word of memory shared between the parties; a model checker has its own.
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

/// A version while its row is read.
pub(super) struct Pinned<'a, W: Word> {
    pin: &'a W,
}

impl<'a, W: Word> Pinned<'a, W> {
    /// Pins `version`, of which `word` is the version word; `None` when it is gone. A pin serves one reader, one version at
    /// a time.
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

/// Takes `version` away from its row; false, and all is as before, when a reader has it pinned.
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
    //! Every order in which the steps of a reader and the writer can happen, and every value that the memory model lets
    //! them see.
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

    /// One row, one reader, one block. The checker ends the test when the block is read and written at once.
    struct Memory {
        version: AtomicU64,
        pin: AtomicU64,
        hold: AtomicU64,
        block: UnsafeCell<u64>,
    }

    impl Memory {
        fn with_version(version: u64) -> Arc<Self> {
            let [hold, pin, word] = [0, NONE, version].map(AtomicU64::new);
            Arc::new(Self { version: word, pin, hold, block: UnsafeCell::new(version) })
        }

        /// Pins, holds, unpins, reads the block, lets go; whether the version was there.
        fn read(&self, version: u64) -> bool {
            let Some(pinned) = Pinned::new(&self.pin, &self.version, version) else { return false };
            self.hold.fetch_add(1, Ordering::Relaxed);
            drop(pinned);
            // SAFETY: this is what is checked.
            self.block.with(|block| assert_eq!(unsafe { *block }, version));
            self.hold.fetch_sub(1, Ordering::Release);
            true
        }

        /// Uses the block anew if it is free; whether it was.
        fn replace(&self, old: u64, new: u64) -> bool {
            let free = retire_version(&self.version, old, std::iter::once(&self.pin))
                && self.hold.load(Ordering::Acquire) == 0;
            if free {
                // SAFETY: this is what is checked.
                self.block.with_mut(|block| unsafe { *block = new });
                self.version.store_release(new);
            }
            free
        }
    }

    #[test]
    fn a_block_in_use_is_left_alone() {
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
