//! Threads that evaluate a structure together.

use std::ops::Range;
use std::sync::Arc;

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

use super::batches::Chunk;
use super::chunked_slices::SplitByChunk;

/// The calling thread alone, or a pool of threads. Results have the same bits whatever it is.
#[derive(Clone, Debug, Default)]
pub struct Threads(Option<Arc<ThreadPool>>);

impl Threads {
    /// `n` threads of their own; for less than two the calling thread.
    ///
    /// # Errors
    /// The system gives no more threads.
    pub fn new(n: usize) -> Result<Self, ThreadPoolBuildError> {
        if n < 2 {
            return Ok(Self::default());
        }
        let builder = ThreadPoolBuilder::new().num_threads(n).thread_name(|k| format!("grace {k}"));
        Ok(Self(Some(Arc::new(builder.build()?))))
    }

    /// How many they are.
    pub fn count(&self) -> usize {
        self.0.as_ref().map_or(1, |pool| pool.current_num_threads())
    }

    /// Does some work as one of them, so that the others are there to help.
    pub(super) fn run<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        match &self.0 {
            Some(pool) => pool.install(work),
            None => work(),
        }
    }

    /// Deals `work` out by chunks; to be called within [`Threads::run`]. `act` is told which thread does it.
    pub(super) fn for_each_chunk<W: SplitByChunk>(
        &self,
        chunks: &[Chunk],
        work: W,
        act: &(impl Fn(&Chunk, W, usize) + Sync),
    ) {
        match chunks {
            [] => {}
            [chunk] => {
                act(chunk, work, rayon::current_thread_index().filter(|_| self.0.is_some()).unwrap_or(0))
            }
            _ => {
                let (before, after) = chunks.split_at(chunks.len() / 2);
                let (first, second) = work.split(&after[0]);
                let (first, second) =
                    (|| self.for_each_chunk(before, first, act), || self.for_each_chunk(after, second, act));
                match &self.0 {
                    Some(_) => drop(rayon::join(first, second)),
                    None => (first(), second()).0,
                }
            }
        }
    }

    /// As [`Threads::for_each_chunk`], in as many pieces of about the same size as there are threads, so that each is as large as can be.
    pub(super) fn for_each_share<W: SplitByChunk>(
        &self,
        chunks: &[Chunk],
        work: W,
        act: &(impl Fn(&Range<usize>, W) + Sync),
    ) {
        self.split_into_shares(self.count(), chunks, work, act);
    }

    fn split_into_shares<W: SplitByChunk>(
        &self,
        pieces: usize,
        chunks: &[Chunk],
        work: W,
        act: &(impl Fn(&Range<usize>, W) + Sync),
    ) {
        match chunks {
            [] => {}
            [first, .., last] if pieces < 2 => act(&(first.places.start..last.places.end), work),
            [only] => act(&only.places, work),
            _ => {
                let (before, after) = chunks.split_at(chunks.len() * (pieces / 2) / pieces);
                let (first, second) = work.split(&after[0]);
                rayon::join(
                    || self.split_into_shares(pieces / 2, before, first, act),
                    || self.split_into_shares(pieces - pieces / 2, after, second, act),
                );
            }
        }
    }
}
