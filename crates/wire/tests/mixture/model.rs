//! Arbitrary sequences of events, compared with a model of the readable versions and of the memory in use.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use calm::Mixture;
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use wire::{MixtureReader, SharedMixture, SharedMixtureError};

use super::helpers::{DIMENSION, check, first, next, stamp};

const READERS: u32 = 3;
const COMPONENTS: usize = 6;
/// Length of a block, and of the reference counts of an extent.
const BLOCK: u64 = (64 + 8 * DIMENSION as u64 * (DIMENSION as u64 + 1)).next_multiple_of(4096);
const HOLDS: u64 = 4096;
/// Number of free blocks that may keep their memory.
const SPARE: usize = 16;

#[derive(Debug, Clone)]
enum Event {
    /// Publishes a new version, and keeps its `Arc` or not.
    Publish { keep: bool },
    /// Publishes a kept version again.
    Again(usize),
    /// Drops a kept version.
    Forget(usize),
    /// A reader pins a version, `back` versions before the newest.
    Pin { reader: u32, back: u64 },
    /// A reader drops its oldest version.
    Drop { reader: u32 },
    /// A reader's process dies and another takes its number.
    Die { reader: u32 },
}

fn event() -> impl Strategy<Value = Event> {
    let reader = 0..READERS;
    prop_oneof![
        4 => any::<bool>().prop_map(|keep| Event::Publish { keep }),
        1 => any::<usize>().prop_map(Event::Again),
        2 => any::<usize>().prop_map(Event::Forget),
        5 => (reader.clone(), 0..12_u64).prop_map(|(reader, back)| Event::Pin { reader, back }),
        2 => reader.clone().prop_map(|reader| Event::Drop { reader }),
        1 => reader.prop_map(|reader| Event::Die { reader }),
    ]
}

struct Model {
    path: PathBuf,
    base: u64,
    shared: SharedMixture,
    newest: Arc<Mixture>,
    /// Versions whose `Arc` is kept by the writer.
    kept: BTreeMap<u64, Arc<Mixture>>,
    /// Versions that can be pinned: the newest one, and those kept at the last publication.
    living: BTreeSet<u64>,
    readers: Vec<Option<Reader>>,
}

struct Reader {
    reader: MixtureReader,
    current: Option<u64>,
    held: Vec<Arc<Mixture>>,
}

impl Reader {
    fn open(path: &Path, number: u32) -> Self {
        Self { reader: MixtureReader::open(path, number).unwrap(), current: None, held: Vec::new() }
    }
}

impl Model {
    fn new(path: PathBuf) -> Self {
        let newest = first();
        let shared = SharedMixture::create(&path, &newest, READERS).unwrap();
        let base = SharedMixture::space_needed(&newest, READERS).unwrap() - BLOCK * 2 * COMPONENTS as u64;
        let readers = (0..READERS).map(|number| Some(Reader::open(&path, number))).collect();
        Self { path, base, shared, newest, kept: BTreeMap::new(), living: BTreeSet::from([0]), readers }
    }

    fn happen(&mut self, event: Event) {
        match event {
            Event::Publish { keep } => {
                self.newest = next(&self.newest);
                let (version, kept) = (self.newest.version(), &self.kept);
                self.living.retain(|old| kept.contains_key(old) || old + 1 == version);
                self.living.insert(version);
                // The model's own reference must not count.
                let published = Arc::new(Mixture::clone(&self.newest));
                self.shared.publish(&published).unwrap();
                if keep {
                    self.kept.insert(version, published);
                }
                self.check_memory();
            }
            Event::Again(which) => {
                if let Some(mixture) = self.kept.values().nth(which % self.kept.len().max(1)) {
                    self.shared.publish(mixture).unwrap();
                }
            }
            Event::Forget(which) => {
                if let Some(&version) = self.kept.keys().nth(which % self.kept.len().max(1)) {
                    self.kept.remove(&version);
                }
            }
            Event::Pin { reader, back } => {
                self.pin(reader as usize, self.newest.version().saturating_sub(back))
            }
            Event::Drop { reader } => {
                let held = &mut self.readers[reader as usize].as_mut().unwrap().held;
                held.drain(..held.len().min(1));
            }
            Event::Die { reader } => {
                let place = &mut self.readers[reader as usize];
                // A killed process frees nothing.
                std::mem::forget(place.take());
                self.shared.release(reader);
                *place = Some(Reader::open(&self.path, reader));
            }
        }
        self.readers.iter().flatten().flat_map(|reader| &reader.held).for_each(|mixture| check(mixture));
    }

    fn pin(&mut self, number: usize, version: u64) {
        let reader = self.readers[number].as_mut().unwrap();
        let there = self.living.contains(&version) || reader.current == Some(version);
        match reader.reader.pin(version) {
            Ok(mixture) => {
                assert!(there, "version {version} should be gone");
                check(&mixture);
                assert_eq!(mixture.version(), version);
                reader.current = Some(version);
                reader.held.push(mixture);
            }
            Err(SharedMixtureError::VersionNotFound { newest, .. }) => {
                assert!(!there, "version {version} should be there");
                assert_eq!(newest, self.newest.version());
            }
            Err(error) => panic!("{error}"),
        }
    }

    /// Memory is reserved only for used and spare blocks.
    fn check_memory(&self) {
        let readers = self.readers.iter().flatten();
        let held = readers.clone().flat_map(|reader| &reader.held).map(|mixture| mixture.version());
        let versions =
            self.living.iter().copied().chain(readers.filter_map(|reader| reader.current)).chain(held);
        let in_use: BTreeSet<(usize, u64)> = versions
            .flat_map(|version| (0..COMPONENTS).map(move |place| (place, stamp(version, place))))
            .collect();
        let data = fs::metadata(&self.path).unwrap();
        let extents = data.len().div_ceil(HOLDS + 2 * COMPONENTS as u64 * BLOCK);
        let limit = self.base + HOLDS * extents + BLOCK * (in_use.len() + SPARE) as u64;
        let taken = 512 * data.blocks();
        assert!(taken <= limit, "{taken} bytes are taken, {limit} should do for {} blocks", in_use.len());
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 96, failure_persistence: None, rng_seed: RngSeed::Fixed(3), ..ProptestConfig::default()
    })]

    #[test]
    fn assigned_versions_exist_and_used_blocks_never_change(events in vec(event(), 1..120)) {
        let folder = tempfile::tempdir_in("/dev/shm").unwrap();
        let mut model = Model::new(folder.path().join("mixture"));
        events.into_iter().for_each(|event| model.happen(event));
    }
}
