//! Threads that take whole shards, in order, through a pass.

use std::panic::resume_unwind;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError, SyncSender};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use calm::build::BuildError;
use tokio_util::sync::CancellationToken;

use super::feature_cache::FeatureCache;
use super::part::BuildPart;
use super::passes::{ElementPass, FeatureSource, ShardResult, run_shard};
use super::stream::{Shard, ShardReader};
use crate::exit_status::CommandError;
use crate::feature_variant::FeatureModel;
use crate::features::FeatureCalculator;
use crate::structure_files::StructureFiles;

/// Time between two looks at the progress.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(200);

/// What all passes share.
pub struct PassContext {
    /// With the features of the mixture.
    pub model: FeatureModel,
    pub files: StructureFiles,
    pub shard_size: u64,
    /// The part of this process; `None` if it makes the whole build.
    pub part: Option<BuildPart>,
    pub seed: u64,
    pub threads: usize,
    /// Disk space for the features of shards, bytes.
    pub max_feature_bytes: u64,
    pub stop: CancellationToken,
}

impl PassContext {
    /// The shards of this process.
    pub fn shards(&self) -> BuildPart {
        self.part.unwrap_or(BuildPart::WHOLE)
    }
}

/// What has been done in a pass since this process began it.
#[derive(Default)]
pub struct Counters {
    /// Bytes of the files that were read.
    pub bytes: Arc<AtomicU64>,
    /// Structures whose features were computed or read.
    pub computed: AtomicU64,
    /// Structures of shards that were finished before.
    pub skipped: AtomicU64,
    /// Finished shards, those of before included.
    pub shards: AtomicU64,
    /// Structures that the filter left out, once all files were read.
    pub left_out: AtomicU64,
}

/// What the threads of a pass share.
struct Shared<'a, F, B> {
    context: &'a PassContext,
    cache: &'a FeatureCache,
    reader: Mutex<Option<ShardReader>>,
    is_finished: F,
    begin: B,
    counters: &'a Counters,
    /// The first of them is the one that a single thread would have met.
    failures: Mutex<Vec<(u64, CommandError)>>,
}

/// Takes all shards of the part but those that `is_finished` knows through a pass, and gives their results to `receive` in the order in which
/// they end. Shards that other threads have begun are finished before a failure is returned, but not after the cancellation of
/// `stop`. Memory holds one shard for each thread.
///
/// Returns the number of structures in the files; `None` after a cancellation.
pub fn run_pass<P: ElementPass>(
    (context, cache): (&PassContext, &FeatureCache),
    is_finished: impl Fn(&Shard) -> Result<bool, CommandError> + Sync,
    begin: impl Fn(u64) -> Result<Vec<Option<P>>, BuildError> + Sync,
    counters: &Counters,
    mut receive: impl FnMut(ShardResult<P::Partial>) -> Result<(), CommandError>,
    progress: impl Fn(),
) -> Result<Option<u64>, CommandError> {
    let reader =
        ShardReader::new(&context.files, context.shard_size, context.shards(), Arc::clone(&counters.bytes));
    let shared = Shared {
        context,
        cache,
        reader: Mutex::new(Some(reader)),
        is_finished,
        begin,
        counters,
        failures: Mutex::default(),
    };
    let structures = thread::scope(|scope| {
        let (send, results) = mpsc::sync_channel(context.threads);
        let threads: Vec<_> = (0..context.threads)
            .map(|_| {
                let (send, shared) = (send.clone(), &shared);
                scope.spawn(move || shared.take_shards(&send))
            })
            .collect();
        drop(send);
        loop {
            match results.recv_timeout(PROGRESS_INTERVAL) {
                Ok(result) => {
                    let result: ShardResult<P::Partial> = result;
                    let index = result.index;
                    counters.shards.fetch_add(1, Ordering::Relaxed);
                    if let Err(failure) = receive(result) {
                        shared.fail(index, failure);
                    }
                }
                Err(RecvTimeoutError::Timeout) => (),
                Err(RecvTimeoutError::Disconnected) => break,
            }
            progress();
        }
        let ends =
            threads.into_iter().map(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)));
        ends.flatten().max()
    });
    let failures = shared.failures.into_inner().unwrap_or_else(PoisonError::into_inner);
    if let Some((_, failure)) = failures.into_iter().min_by_key(|(shard, _)| *shard) {
        return Err(failure);
    }
    Ok(structures.filter(|_| !context.stop.is_cancelled()))
}

impl<F, B> Shared<'_, F, B> {
    /// Returns the number of structures if this thread came to the end of the files.
    fn take_shards<P>(&self, results: &SyncSender<ShardResult<P::Partial>>) -> Option<u64>
    where
        P: ElementPass,
        F: Fn(&Shard) -> Result<bool, CommandError>,
        B: Fn(u64) -> Result<Vec<Option<P>>, BuildError>,
    {
        let mut calculator = self.context.model.calculator();
        let context = self.context;
        while !context.stop.is_cancelled() {
            let shard = {
                let mut place = self.reader.lock().unwrap_or_else(PoisonError::into_inner);
                let reader = place.as_mut()?;
                match reader.next_shard() {
                    Ok(Some(shard)) => shard,
                    Ok(None) => {
                        self.counters.left_out.store(reader.left_out(), Ordering::Relaxed);
                        return Some(reader.count());
                    }
                    Err(failure) => {
                        let index = reader.next_index();
                        drop(place);
                        self.fail(index, failure);
                        return None;
                    }
                }
            };
            match (self.is_finished)(&shard) {
                Ok(false) => (),
                Ok(true) => {
                    self.counters.skipped.fetch_add(shard.structures.len() as u64, Ordering::Relaxed);
                    self.counters.shards.fetch_add(1, Ordering::Relaxed);
                    continue;
                }
                Err(failure) => {
                    self.fail(shard.index, failure);
                    return None;
                }
            }
            match self.take(&mut calculator, &shard) {
                Ok(Some(result)) => results.send(result).ok()?,
                Ok(None) => return None,
                Err(failure) => self.fail(shard.index, failure),
            }
        }
        None
    }

    /// Takes a shard through the pass, with the features of an earlier pass if they are there.
    fn take<P>(
        &self,
        calculator: &mut FeatureCalculator,
        shard: &Shard,
    ) -> Result<Option<ShardResult<P::Partial>>, CommandError>
    where
        P: ElementPass,
        B: Fn(u64) -> Result<Vec<Option<P>>, BuildError>,
    {
        let context = self.context;
        let run = |source: &mut FeatureSource<'_>| {
            let passes = (self.begin)(shard.index).map_err(CommandError::failed)?;
            let each = || {
                self.counters.computed.fetch_add(1, Ordering::Relaxed);
            };
            run_shard(source, shard, context.seed, passes, &context.stop, each)
        };
        if let Some(reader) = self.cache.reader(shard) {
            let mut source = FeatureSource::Stored { reader, model: &context.model };
            let found = run(&mut source);
            if source.finish() {
                return found;
            }
            // Results and errors from damaged features do not count.
            if context.stop.is_cancelled() {
                return Ok(None);
            }
        }
        let mut source = FeatureSource::Computed { calculator, writer: self.cache.writer(shard) };
        let found = run(&mut source)?;
        if found.is_some() {
            source.finish();
        }
        Ok(found)
    }

    /// Hands out no more shards.
    fn fail(&self, shard: u64, failure: CommandError) {
        self.reader.lock().unwrap_or_else(PoisonError::into_inner).take();
        self.failures.lock().unwrap_or_else(PoisonError::into_inner).push((shard, failure));
    }
}
