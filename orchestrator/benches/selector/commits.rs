//! How long single commits take. The write-ahead log of SQLite is copied into the database when it is long, while a commit waits.

use std::fs;
use std::path::Path;
use std::time::{Duration, Instant};

use orchestrator::reactor::commit_batch;
use store::{Commit, Location};

use crate::campaign::create_store;

/// Bytes of a page of the database in its log, with the header of a frame.
const FRAME: u64 = (1 << 14) + 24;

/// Commits of groups of the same size.
#[derive(Default)]
pub struct Commits {
    pub times: Vec<Duration>,
    /// Pages that each adds to the log, as far as it has grown: afterwards it is written from its begin.
    pages: Vec<u64>,
}

impl Commits {
    /// Writes commits to a database in groups of this size. `log` is the write-ahead log, if there is one.
    pub async fn measure(
        commits: Vec<Commit>,
        walks: usize,
        size: usize,
        location: Location,
        log: &Path,
    ) -> Self {
        let store = create_store(location, walks).await;
        let (mut commits, mut measured) = (commits.into_iter().peekable(), Self::default());
        let length = || fs::metadata(log).map_or(0, |file| file.len());
        while commits.peek().is_some() {
            let mut whole = Commit::default();
            commits.by_ref().take(size).for_each(|commit| commit_batch::append(&mut whole, commit));
            let (begun, before) = (Instant::now(), length());
            store.commit(&whole).await.unwrap();
            measured.times.push(begun.elapsed());
            measured.pages.extend(Some((length() - before) / FRAME).filter(|pages| *pages > 0));
        }
        store.close().await;
        measured
    }

    /// Quantile of the times, ms.
    pub fn quantile(&mut self, share: f64) -> f64 {
        self.times.sort();
        let place = (share * (self.times.len() - 1) as f64).round() as usize;
        1e3 * self.times[place].as_secs_f64()
    }

    /// Mean number of pages that a commit writes.
    pub fn pages(&self) -> f64 {
        self.pages.iter().sum::<u64>() as f64 / self.pages.len().max(1) as f64
    }
}
