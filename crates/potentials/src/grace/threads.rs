//! Threads that evaluate one structure in parallel.

use std::ops::Range;
use std::sync::Arc;

use rayon::iter::{IntoParallelRefMutIterator, ParallelIterator};
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

use super::batches::Chunk;
use super::chunked_slices::SplitByChunk;

/// The calling thread or a thread pool. Results have the same bits with either.
#[derive(Clone, Debug, Default)]
pub struct Threads(Option<Arc<ThreadPool>>);

impl Threads {
    /// A pool of `n` threads; the calling thread if `n` is less than two.
    ///
    /// # Errors
    /// The system cannot create the threads.
    pub fn new(n: usize) -> Result<Self, ThreadPoolBuildError> {
        if n < 2 {
            return Ok(Self::default());
        }
        let builder = ThreadPoolBuilder::new().num_threads(n).thread_name(|k| format!("grace {k}"));
        Ok(Self(Some(Arc::new(builder.build()?))))
    }

    /// Number of threads.
    pub fn count(&self) -> usize {
        self.0.as_ref().map_or(1, |pool| pool.current_num_threads())
    }

    /// Runs `work` on a thread of the pool, so that the others can help.
    pub(super) fn run<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        match &self.0 {
            Some(pool) => pool.install(work),
            None => work(),
        }
    }

    /// Calls `act` once for each item, in any order.
    pub fn for_each<T: Send>(&self, items: &mut [T], act: impl Fn(&mut T) + Sync + Send) {
        match &self.0 {
            Some(pool) => pool.install(|| items.par_iter_mut().for_each(act)),
            None => items.iter_mut().for_each(act),
        }
    }

    /// Splits `work` by chunks and runs `act` on each; call it within [`Threads::run`]. `act` receives the
    /// index of its thread.
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

    /// As [`Threads::for_each_chunk`], but in as many parts of about equal size as there are threads, so that
    /// parts are as large as possible.
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
