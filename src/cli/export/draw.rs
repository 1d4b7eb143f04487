//! Draws structures from each walk at random.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::num::NonZeroUsize;

use store::{ExportCursor, ExportRow, ExportSource};
use wire::WalkId;

use crate::output::count;

/// Walks that are listed by themselves.
const LISTED: usize = 20;

/// The structures of each walk, with the random keys of those that are drawn so far.
pub struct WalkDraw {
    per_walk: usize,
    random_seed: u64,
    walks: BTreeMap<WalkId, DrawnOfWalk>,
}

#[derive(Default)]
struct DrawnOfWalk {
    /// The smallest keys.
    drawn: BTreeSet<([u8; 32], ExportCursor)>,
    all: usize,
}

/// What was drawn.
pub struct Drawn {
    /// Positions of the drawn structures.
    pub cursors: BTreeSet<ExportCursor>,
    /// Number of drawn structures of each walk, and of all.
    numbers: Vec<(WalkId, usize, usize)>,
}

impl WalkDraw {
    /// At most `per_walk` structures of each walk.
    pub fn new(per_walk: NonZeroUsize, random_seed: u64) -> Self {
        Self { per_walk: per_walk.get(), random_seed, walks: BTreeMap::new() }
    }

    /// Takes note of a structure of the export. Imported structures have no walk and are not drawn.
    pub fn offer(&mut self, row: &ExportRow) {
        let ExportSource::Candidate { id, block, .. } = &row.source else { return };
        let walk = self.walks.entry(block.view().id().walk).or_default();
        walk.all += 1;
        walk.drawn.insert((key(self.random_seed, id), row.cursor));
        if walk.drawn.len() > self.per_walk {
            walk.drawn.pop_last();
        }
    }

    /// The structures with the smallest keys of each walk.
    pub fn finish(self) -> Drawn {
        let number = |(id, walk): (&WalkId, &DrawnOfWalk)| (*id, walk.drawn.len(), walk.all);
        let numbers = self.walks.iter().map(number).collect();
        let cursors = self.walks.into_values().flat_map(|walk| walk.drawn).map(|(_, cursor)| cursor);
        Drawn { cursors: cursors.collect(), numbers }
    }
}

impl Drawn {
    /// Whether a structure is exported.
    pub fn has(&self, row: &ExportRow) -> bool {
        matches!(row.source, ExportSource::Import { .. }) || self.cursors.contains(&row.cursor)
    }

    /// How many structures of each walk were drawn, or of all walks together if there are many.
    pub fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        if self.numbers.len() <= LISTED {
            return self.numbers.iter().try_for_each(|(walk, drawn, all)| {
                writeln!(out, "drawn: {drawn} of {} of walk {walk}", count(*all, "structure"))
            });
        }
        let sum =
            |number: fn(&(WalkId, usize, usize)) -> usize| self.numbers.iter().map(number).sum::<usize>();
        let (drawn, all) = (sum(|walk| walk.1), sum(|walk| walk.2));
        writeln!(out, "drawn: {drawn} of {} of {} walks", count(all, "structure"), self.numbers.len())
    }
}

/// A number that is uniform over random seeds, by which the structures of a walk are ordered.
fn key(random_seed: u64, candidate: &str) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(b"calmwalk draw 1");
    hasher.update(&random_seed.to_le_bytes());
    hasher.update(candidate.as_bytes());
    *hasher.finalize().as_bytes()
}
