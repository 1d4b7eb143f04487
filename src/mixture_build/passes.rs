//! One shard in one pass: the features of its structures, in random order, go to the passes of their elements.

use calm::build::{BuildError, CalibrationPass, ElementHistograms, ElementSums, ScatterPass, shuffled};
use calm::build::{ShardClustering, ShardClusters};
use tokio_util::sync::CancellationToken;

use super::feature_cache::{FeatureReader, FeatureWriter};
use super::stream::{Shard, ShardHash, TrainingStructure};
use crate::exit_status::CommandError;
use crate::feature_variant::FeatureModel;
use crate::features::FeatureCalculator;

/// Atoms of an element that are passed on together: they stay in the cache.
const BATCH_ATOMS: usize = 256;

/// What a pass does with the atoms of one element of a shard.
pub trait ElementPass {
    /// What it finds.
    type Partial: Send;

    /// Adds atoms: features `[atoms × D]` and weights.
    fn add(&mut self, features: &[f64], weights: &[f64]) -> Result<(), BuildError>;

    /// Ends the shard.
    fn finish(self) -> Self::Partial;
}

impl ElementPass for ShardClustering {
    type Partial = ShardClusters;

    fn add(&mut self, features: &[f64], weights: &[f64]) -> Result<(), BuildError> {
        self.add(features, weights)
    }

    fn finish(self) -> ShardClusters {
        self.finish()
    }
}

impl ElementPass for ScatterPass {
    type Partial = ElementSums;

    fn add(&mut self, features: &[f64], weights: &[f64]) -> Result<(), BuildError> {
        self.add(features, weights)
    }

    fn finish(self) -> ElementSums {
        self.finish()
    }
}

impl ElementPass for CalibrationPass {
    type Partial = ElementHistograms;

    fn add(&mut self, features: &[f64], weights: &[f64]) -> Result<(), BuildError> {
        self.add(features, weights)
    }

    fn finish(self) -> ElementHistograms {
        self.finish()
    }
}

/// What a pass found in a shard.
pub struct ShardResult<T> {
    pub index: u64,
    pub hash: ShardHash,
    /// By element index; `None` for an element that takes no part in the pass.
    pub elements: Vec<Option<T>>,
}

/// The atoms of an element that wait to be passed on.
struct PendingAtoms<P> {
    pass: Option<P>,
    features: Vec<f64>,
    weights: Vec<f64>,
}

impl<P: ElementPass> PendingAtoms<P> {
    fn flush(&mut self) -> Result<(), BuildError> {
        if let Some(pass) = &mut self.pass {
            pass.add(&self.features, &self.weights)?;
        }
        self.features.clear();
        self.weights.clear();
        Ok(())
    }
}

/// Element indices and features of the atoms of a structure, `[n]` and `[n × D]`.
type AtomFeatures<'a> = (Vec<usize>, &'a [f64]);

/// Where the features of a shard come from.
pub enum FeatureSource<'a> {
    /// They are computed, and written for later passes.
    Computed { calculator: &'a mut FeatureCalculator, writer: Option<FeatureWriter<'a>> },
    /// They are those of an earlier pass.
    Stored { reader: FeatureReader, model: &'a FeatureModel },
}

impl FeatureSource<'_> {
    /// The features of the next structure; `None` if stored ones cannot be read.
    fn next(&mut self, training: &TrainingStructure) -> Result<Option<AtomFeatures<'_>>, CommandError> {
        match self {
            Self::Computed { calculator, writer } => {
                let elements = calculator.compute(&training.structure);
                let elements = elements.map_err(|error| training.position.wrong(error))?;
                let features = calculator.features();
                if let Some(writer) = writer {
                    writer.add(features);
                }
                Ok(Some((elements, features)))
            }
            Self::Stored { reader, model } => {
                let elements = model.model.shared().element_indices(&training.structure.species);
                let elements = elements.map_err(|error| training.position.wrong(error))?;
                let features = reader.next(elements.len() * model.dimension());
                Ok(features.map(|features| (elements, features)))
            }
        }
    }

    /// Ends the shard. Whether its features were those that were written, if they were read.
    pub fn finish(self) -> bool {
        match self {
            Self::Computed { writer, .. } => {
                writer.into_iter().for_each(FeatureWriter::finish);
                true
            }
            Self::Stored { reader, .. } => reader.finish(),
        }
    }
}

/// Takes the structures of a shard through a pass. `passes` has that of each element, and `each` is called after each structure.
/// `None` once `stop` is cancelled, or if stored features cannot be read.
pub fn run_shard<P: ElementPass>(
    source: &mut FeatureSource<'_>,
    shard: &Shard,
    seed: u64,
    passes: Vec<Option<P>>,
    stop: &CancellationToken,
    each: impl Fn(),
) -> Result<Option<ShardResult<P::Partial>>, CommandError> {
    let empty = |pass| PendingAtoms { pass, features: Vec::new(), weights: Vec::new() };
    let mut elements: Vec<PendingAtoms<P>> = passes.into_iter().map(empty).collect();
    let broken = |error: BuildError| CommandError::Failed(format!("shard {}: {error}", shard.index));
    for number in shuffled(seed, shard.index, shard.structures.len()) {
        if stop.is_cancelled() {
            return Ok(None);
        }
        let structure = &shard.structures[number];
        let Some((indices, features)) = source.next(structure)? else { return Ok(None) };
        add(structure, &indices, features, &mut elements)?;
        for element in elements.iter_mut().filter(|element| element.weights.len() >= BATCH_ATOMS) {
            element.flush().map_err(broken)?;
        }
        each();
    }
    elements.iter_mut().try_for_each(PendingAtoms::flush).map_err(broken)?;
    Ok(Some(ShardResult {
        index: shard.index,
        hash: shard.hash,
        elements: elements.into_iter().map(|element| element.pass.map(P::finish)).collect(),
    }))
}

fn add<P>(
    structure: &TrainingStructure,
    indices: &[usize],
    features: &[f64],
    elements: &mut [PendingAtoms<P>],
) -> Result<(), CommandError> {
    let dimension = features.len() / indices.len().max(1);
    let rows = features.chunks_exact(dimension.max(1));
    for (atom, (row, &index)) in rows.zip(indices).enumerate() {
        if !row.iter().map(|value| value * value).sum::<f64>().is_finite() {
            return Err(structure.position.wrong(format_args!("the features of atom {atom} are not finite")));
        }
        let element = &mut elements[index];
        if element.pass.is_none() && structure.weight == 0.0 {
            // Pass 1 leaves atoms without weight out.
            continue;
        }
        if element.pass.is_none() {
            let message =
                "pass 1 found no atom of its element; did the file change? Start over with --restart";
            return Err(structure.position.wrong(format_args!("atom {atom}: {message}")));
        }
        element.features.extend_from_slice(row);
        element.weights.push(structure.weight);
    }
    Ok(())
}
