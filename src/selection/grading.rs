//! Reads the structures of a pool and grades their atoms, a block at a time on several threads.

use std::panic::resume_unwind;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use calm::selection::{Pool, Window};
use calm::{Grades, Mixture};
use potentials::ModelWithFeatures;
use tokio_util::sync::CancellationToken;
use wire::ContentHash;

use super::campaign::CampaignCandidates;
use super::compositions::Compositions;
use super::{GradedPool, ItemPlace, PoolItem, PoolStructure, StructureSource};
use crate::exit_status::CommandError;
use crate::features::{FeatureCalculator, FeatureError};
use crate::left_out::LeftOutStructures;
use crate::output::{self, Bar};
use crate::structure_files::{StructureFiles, StructureReader};

/// Structures of a block for each thread.
const BLOCK: usize = 16;

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

/// Where the structures of a pool are.
pub struct PoolFiles {
    pub files: StructureFiles,
    pub campaigns: Vec<CampaignCandidates>,
}

/// How a pool is graded, and what is kept of it.
pub struct PoolGrading {
    pub model: Arc<dyn ModelWithFeatures>,
    pub mixture: Arc<Mixture>,
    pub window: Window,
    /// Keep the features of atoms outside the window.
    pub all_atoms: bool,
    /// Bytes of features in memory; the others are in a temporary file in `directory`.
    pub memory: usize,
    pub directory: PathBuf,
    pub threads: usize,
    pub stop: CancellationToken,
}

/// A thread's work arrays.
struct Worker {
    calculator: FeatureCalculator,
    grades: Grades,
}

/// What was found of an item.
enum GradedItem {
    Graded(GradedStructure),
    /// Why the structure cannot be graded.
    Ungraded(String),
}

/// What was found of a structure.
struct GradedStructure {
    elements: Vec<usize>,
    slots: Vec<usize>,
    gamma: Vec<f64>,
    features: Vec<f64>,
    evaluated: bool,
}

impl PoolGrading {
    /// Grades every structure of the files, then of the campaigns; `None` after a cancellation of `stop`. Warns of structures that
    /// cannot be graded, and leaves them out.
    ///
    /// # Errors
    /// A file that cannot be read, a model that does not answer, no structure that can be graded.
    pub fn run(&self, pool: &mut PoolFiles) -> Result<Option<GradedPool>, CommandError> {
        let bytes = Arc::new(AtomicU64::new(0));
        let total = pool.files.total_bytes()?;
        let bar = Bar::new((total > 0).then_some(total), BAR);
        let mut reader = PoolReader {
            files: (!pool.files.files.is_empty()).then(|| pool.files.reader(Arc::clone(&bytes))),
            campaigns: &mut pool.campaigns,
            waiting: Vec::new(),
        };
        let mut workers: Vec<Worker> = (0..self.threads)
            .map(|_| Worker {
                calculator: FeatureCalculator::new(Arc::clone(&self.model)),
                grades: Grades::default(),
            })
            .collect();
        let dimension = self.mixture.dimension();
        let atoms = Pool::new(dimension, self.window, self.all_atoms, self.memory, self.directory.clone());
        let mut found = GradedPool {
            pool: atoms,
            structures: Vec::new(),
            elements: self.model.elements().len(),
            compositions: Compositions::default(),
            evaluated: 0,
            left_out: LeftOutStructures::default(),
        };
        loop {
            let block = reader.block(BLOCK * self.threads)?;
            if block.is_empty() {
                drop(bar);
                found.left_out.warn(found.structures.len() as u64)?;
                return Ok(Some(found));
            }
            if self.stop.is_cancelled() {
                return Ok(None);
            }
            let graded = self.grade(&mut workers, &block);
            for (item, graded) in block.iter().zip(graded) {
                match graded? {
                    GradedItem::Graded(graded) => found.add(item, &graded)?,
                    GradedItem::Ungraded(reason) => found.left_out.add(&item.place, reason),
                }
            }
            let count = found.structures.len();
            bar.set(bytes.load(Ordering::Relaxed), || output::count(count, "structure"));
        }
    }

    /// In the order of the block.
    fn grade(&self, workers: &mut [Worker], block: &[PoolItem]) -> Vec<Result<GradedItem, CommandError>> {
        let items = Mutex::new(block.iter().enumerate());
        let next = || items.lock().unwrap_or_else(PoisonError::into_inner).next();
        let share = |worker: &mut Worker| {
            let mut graded = Vec::new();
            while let Some((number, item)) = next() {
                graded.push((number, worker.grade(&self.mixture, item)));
            }
            graded
        };
        let share = &share;
        let mut graded: Vec<_> = match workers {
            [worker] => share(worker),
            workers => thread::scope(|scope| {
                let threads: Vec<_> =
                    workers.iter_mut().map(|worker| scope.spawn(move || share(worker))).collect();
                let results = threads.into_iter();
                results
                    .flat_map(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)))
                    .collect()
            }),
        };
        graded.sort_unstable_by_key(|(number, _)| *number);
        graded.into_iter().map(|(_, result)| result).collect()
    }
}

impl Worker {
    fn grade(&mut self, mixture: &Mixture, item: &PoolItem) -> Result<GradedItem, CommandError> {
        let (elements, features) = match self.features(item) {
            Ok(found) => found,
            Err(error) if error.is_of_structure() => return Ok(GradedItem::Ungraded(error.to_string())),
            Err(error) => return Err(CommandError::Failed(format!("{}: {error}", item.place))),
        };
        if let Err(error) = self.grades.evaluate(mixture, &elements, &features, None) {
            return Ok(GradedItem::Ungraded(error.to_string()));
        }
        let (slots, gamma) = (self.grades.component.clone(), self.grades.gamma.clone());
        let evaluated = item.features.is_none();
        Ok(GradedItem::Graded(GradedStructure { elements, slots, gamma, features, evaluated }))
    }

    /// Element indices and features of the atoms, `[n]` and `[n × D]`.
    fn features(&mut self, item: &PoolItem) -> Result<(Vec<usize>, Vec<f64>), FeatureError> {
        match &item.features {
            Some(features) => {
                let model = self.calculator.potential.model();
                Ok((model.element_indices(&item.structure.species)?, features.clone()))
            }
            None => {
                let elements = self.calculator.compute(&item.structure)?;
                Ok((elements, self.calculator.features().to_vec()))
            }
        }
    }
}

impl GradedPool {
    fn add(&mut self, item: &PoolItem, graded: &GradedStructure) -> Result<(), CommandError> {
        let GradedStructure { elements, slots, gamma, features, evaluated } = graded;
        self.pool
            .push(elements, slots, gamma, features)
            .map_err(|error| CommandError::Failed(format!("the temporary file of the features: {error}")))?;
        self.evaluated += u64::from(*evaluated);
        self.structures.push(PoolStructure {
            source: item.source,
            hash: hash(&item.structure),
            composition: self.compositions.number(elements),
            gamma_max: calm::grade::maximum(gamma),
        });
        Ok(())
    }
}

/// The first eight bytes of a structure's hash.
pub(super) fn hash(structure: &atoms::Structure) -> u64 {
    let ContentHash(bytes) = ContentHash::from_structure(structure);
    bytes.first_chunk().map_or(0, |first| u64::from_le_bytes(*first))
}

/// Reads blocks of structures.
struct PoolReader<'a> {
    files: Option<StructureReader>,
    campaigns: &'a mut Vec<CampaignCandidates>,
    /// Structures of a page that did not fit the last block, in reverse order.
    waiting: Vec<PoolItem>,
}

impl PoolReader<'_> {
    /// At most `size` structures; none at the end.
    fn block(&mut self, size: usize) -> Result<Vec<PoolItem>, CommandError> {
        let mut block = Vec::with_capacity(size);
        while block.len() < size {
            match self.next()? {
                Some(item) => block.push(item),
                None => break,
            }
        }
        Ok(block)
    }

    fn next(&mut self) -> Result<Option<PoolItem>, CommandError> {
        if let Some(reader) = &mut self.files {
            if let Some((frame, file)) = reader.next()? {
                let index = u32::try_from(reader.frame_index()).map_err(CommandError::failed)?;
                let source = StructureSource::File { file: reader.file_index() as u32, frame: index };
                let place = ItemPlace::Line(file.path, frame.line);
                return Ok(Some(PoolItem { structure: frame.structure, source, features: None, place }));
            }
            self.files = None;
        }
        while self.waiting.is_empty() {
            let Some(campaign) = self.campaigns.iter_mut().find(|campaign| !campaign.is_read) else {
                return Ok(None);
            };
            self.waiting = campaign.next_page()?;
            self.waiting.reverse();
            campaign.is_read = self.waiting.is_empty();
        }
        Ok(self.waiting.pop())
    }
}
