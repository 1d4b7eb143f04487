//! The writer: the process that holds the campaign's lock.

use std::fs::{self, File, OpenOptions};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Weak};
use std::{fmt, io};

use calm::Mixture;

use super::ORIGINAL;
use super::allocator::BlockAllocator;
use super::error::SharedMixtureError;
use super::index::MixtureIndex;
use super::layout::{SPARE, SharedMixtureLayout};
use super::pinning::{NONE, Word, retire_version};

/// The writer's end of the mixture in shared memory. There must be only one for a file.
///
/// Dropping it keeps the file, which readers may have open; the owner of the directory removes it.
pub struct SharedMixture {
    layout: SharedMixtureLayout,
    index: MixtureIndex,
    blocks: BlockAllocator,
    /// The version in each row.
    living: Vec<Option<LiveVersion>>,
    /// The newest version and its row; new versions are compared with it.
    latest: Option<(Mixture, Vec<u32>)>,
    /// Keeps the original mixture available.
    original: Option<Arc<Mixture>>,
}

/// A version that readers can pin.
#[derive(Debug)]
struct LiveVersion {
    version: u64,
    /// Block of each component.
    blocks: Vec<u32>,
    /// The published `Arc`s; their holders may have assigned the version to a reader.
    owners: Vec<Weak<Mixture>>,
}

/// Omits the numbers.
impl fmt::Debug for SharedMixture {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let living: Vec<u64> = self.living.iter().flatten().map(|known| known.version).collect();
        f.debug_struct("SharedMixture").field("living", &living).finish_non_exhaustive()
    }
}

impl SharedMixture {
    /// Initial shared memory for a mixture and a number of readers, bytes. Components that change while readers use
    /// older ones need about 8 D² bytes each in addition.
    ///
    /// # Errors
    /// The size overflows.
    pub fn space_needed(mixture: &Mixture, readers: u32) -> Result<u64, SharedMixtureError> {
        SharedMixtureLayout::for_mixture(mixture, readers).map(|layout| reserved(&layout))
    }

    /// Creates the file, accessible only to the user (mode 0600), with `mixture` as its newest version and slots for
    /// `readers` readers. Replaces an existing file; processes that have it open keep the old one.
    ///
    /// # Errors
    /// Too little shared memory, sizes that overflow, or a path that cannot be written.
    pub fn create(path: &Path, mixture: &Mixture, readers: u32) -> Result<Self, SharedMixtureError> {
        let layout = SharedMixtureLayout::for_mixture(mixture, readers)?;
        let failed = |doing, source| SharedMixtureError::File { path: path.into(), doing, source };
        match fs::remove_file(path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(failed("remove what is there", error));
            }
            _ => {}
        }
        let file = OpenOptions::new().read(true).write(true).create_new(true).mode(0o600).open(path);
        let file = file.map_err(|source| failed("create", source))?;
        let created = Self::fill(&file, path, layout, mixture);
        if created.is_err() {
            let _ = fs::remove_file(path);
        }
        created
    }

    fn fill(
        file: &File,
        path: &Path,
        layout: SharedMixtureLayout,
        mixture: &Mixture,
    ) -> Result<Self, SharedMixtureError> {
        let failed = |doing, source| SharedMixtureError::File { path: path.into(), doing, source };
        let copy = file.try_clone().map_err(|source| failed("open", source))?;
        file.set_len(reserved(&layout)).map_err(|source| failed("grow", source))?;
        let mut blocks = BlockAllocator::new(layout.clone(), copy, path.into());
        blocks.reserve(0, reserved(&layout))?;
        blocks.grow(initial_blocks(&layout))?;
        let index = MixtureIndex::map(file, &layout).map_err(|source| failed("map", source))?;
        index.clear();
        let mut living = Vec::new();
        living.resize_with(layout.rows as usize, || None);
        let mut shared = Self { layout, index, blocks, living, latest: None, original: None };
        let blocks = shared.write(mixture)?;
        shared.publish_row(0, mixture, blocks, Vec::new());
        shared.layout.write(file).map_err(|source| failed("write the header", source))?;
        Ok(shared)
    }

    /// Publishes `mixture` to all readers. It stays available while it is the newest or this `Arc` lives: send its
    /// version to a reader only afterwards, and keep the `Arc` until the reader no longer needs to pin it. Versions are
    /// identified by number: publishing an existing one does not write it again.
    ///
    /// # Errors
    /// Too little shared memory (existing versions stay available), a mixture of another shape, or more live versions
    /// than rows.
    pub fn publish(&mut self, mixture: &Arc<Mixture>) -> Result<(), SharedMixtureError> {
        let version = mixture.version();
        if let Some(known) = self.living.iter_mut().flatten().find(|known| known.version == version) {
            known.owners.retain(|owner| owner.strong_count() > 0);
            if !known.owners.iter().any(|owner| owner.as_ptr() == Arc::as_ptr(mixture)) {
                known.owners.push(Arc::downgrade(mixture));
            }
            return Ok(());
        }
        if version == NONE || !has_shape(mixture, &self.layout) {
            return Err(SharedMixtureError::Shape { version });
        }
        self.retire();
        let row = self.living.iter().position(Option::is_none);
        let living = self.living.len();
        let row = row.ok_or(SharedMixtureError::TooManyVersions { version, living })?;
        let blocks = self.write(mixture)?;
        self.publish_row(row, mixture, blocks, vec![Arc::downgrade(mixture)]);
        Ok(())
    }

    /// Publishes the original mixture, for good, as [`ORIGINAL`]. It shares the blocks of the components that the newest version has not changed;
    /// each of the others needs about 8 D² bytes.
    ///
    /// # Errors
    /// See [`SharedMixture::publish`].
    pub fn publish_original(&mut self, original: &Mixture) -> Result<(), SharedMixtureError> {
        let original = Arc::new(original.at_version(ORIGINAL));
        self.publish(&original)?;
        self.original = Some(original);
        Ok(())
    }

    /// Frees a reader's slot and all its reference counts. Its process must be dead, or must not use the mixture any
    /// more: what it reads may change afterwards.
    pub fn release(&mut self, reader: u32) {
        if reader < self.layout.readers {
            self.index.pin(reader).store_release(NONE);
            self.blocks.release(reader);
            self.index.owner(reader).store(0, Ordering::Release);
        }
    }

    /// The row of a version: blocks of the latest version for unchanged components, new blocks for the others.
    fn write(&mut self, mixture: &Mixture) -> Result<Vec<u32>, SharedMixtureError> {
        let (mut row, mut written) = (Vec::with_capacity(self.layout.components as usize), Vec::new());
        let mut latest = self.latest.iter().flat_map(|(latest, blocks)| latest.iter().zip(blocks));
        for (key, (.., component)) in self.layout.component_keys().zip(mixture.iter()) {
            let block = match latest.next() {
                Some(((.., same), &block)) if Arc::ptr_eq(same, component) => block,
                _ => match self.blocks.write(key, mixture.version(), component) {
                    Ok(block) => *written.push_mut(block),
                    Err(error) => {
                        self.blocks.discard(written.into_iter());
                        return Err(error);
                    }
                },
            };
            row.push(block);
        }
        Ok(row)
    }

    /// Makes a version whose blocks are written visible to readers, in a free row.
    fn publish_row(&mut self, row: usize, mixture: &Mixture, blocks: Vec<u32>, owners: Vec<Weak<Mixture>>) {
        let version = mixture.version();
        self.blocks.incref(&blocks);
        for (word, &block) in self.index.row(row as u32).zip(&blocks) {
            word.store(block, Ordering::Relaxed);
        }
        self.index.version(row as u32).store_release(version);
        if self.latest.is_none() || (version != ORIGINAL && version > self.newest()) {
            self.index.newest().store_release(version);
            self.latest = Some((mixture.clone(), blocks.clone()));
        }
        if let Some(entry) = self.living.get_mut(row) {
            *entry = Some(LiveVersion { version, blocks, owners });
        }
    }

    /// Removes the versions that are no longer in use in this process, and frees blocks.
    fn retire(&mut self) {
        let newest = self.newest();
        for (row, entry) in self.living.iter_mut().enumerate() {
            let unowned = |known: &LiveVersion| known.owners.iter().all(|owner| owner.strong_count() == 0);
            let old = entry.take_if(|known| {
                known.version != newest
                    && unowned(known)
                    && retire_version(self.index.version(row as u32), known.version, self.index.pins())
            });
            if let Some(old) = old {
                self.blocks.decref(&old.blocks);
            }
        }
        self.blocks.reclaim();
    }

    fn newest(&self) -> u64 {
        self.index.newest().load_acquire()
    }
}

/// Initial number of blocks: one for each component, and spare ones for changes. An extent has room for them.
fn initial_blocks(layout: &SharedMixtureLayout) -> u32 {
    layout.components.saturating_add(SPARE)
}

/// Initial size of the file, which is reserved.
fn reserved(layout: &SharedMixtureLayout) -> u64 {
    layout.extents_at + layout.refcount_bytes + layout.block_at(initial_blocks(layout))
}

fn has_shape(mixture: &Mixture, layout: &SharedMixtureLayout) -> bool {
    let count = |element| mixture.components(element).map(<[_]>::len);
    let mut shape = layout.shape.iter().enumerate();
    mixture.dimension() == layout.dimension as usize
        && mixture.element_count() == layout.shape.len()
        && shape.all(|(element, &components)| count(element) == Some(components as usize))
}
