//! A later version of an artifact's mixture as files: copies of the artifact and of the model's export in which the
//! components that changed are replaced.

use std::io::{self, Read, Seek, Write};
use std::path::Path;

use npz::{NpzFile, Writer};

use super::artifact::{UNUSED, single, unused_inverse};
use super::components::{Inverted, inverted};
use super::export::embed;
use super::histogram::BINS;
use crate::artifact::{ArtifactError, Projection};
use crate::component::Component;
use crate::linear::LinearError;
use crate::mixture::Mixture;

const RAW_THRESHOLDS: &str = "interp_thresholds";
const WEIGHTED_THRESHOLDS: &str = "eff_interp_thresholds";
const SEED: &str = "uq_rp_seed";
const EDGES: &str = "hist_bin_edges";

/// Why a later version of a mixture has no files.
#[derive(Debug, thiserror::Error)]
pub enum ArtifactVersionError {
    /// The artifact cannot be read.
    #[error(transparent)]
    Artifact(#[from] ArtifactError),
    /// A covariance whose eigenvalues do not converge.
    #[error("covariance of component {slot} of element {element}: {source}")]
    Linear {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
        /// What failed.
        source: LinearError,
    },
}

impl From<npz::Error> for ArtifactVersionError {
    fn from(error: npz::Error) -> Self {
        Self::Artifact(error.into())
    }
}

/// A later version of the mixture of an artifact, as its files have it: all numbers are rounded to single precision.
///
/// Inverse covariances are those of the version, rounded, not inverses of the rounded scatter. Centroids and thresholds never
/// change, and the histograms of σ remain those of the build.
#[derive(Debug)]
pub struct ArtifactVersion {
    version: u64,
    dimension: usize,
    /// Slots of each element, K.
    slots: usize,
    projection: Projection,
    projection_seed: Option<i64>,
    elements: Vec<Option<ElementArrays>>,
    /// θ that grade, `[elements × K]`.
    thresholds: Vec<f32>,
    /// θ from the raw histograms, `[elements × K]`.
    raw_thresholds: Vec<f32>,
    histograms: bool,
}

/// The arrays of an element, filled up to K slots.
#[derive(Debug)]
struct ElementArrays {
    /// `[K × D]`.
    centroids: Vec<f32>,
    /// `[K × D × D]`.
    inverses: Vec<f32>,
    /// The other arrays, if a component has changed.
    changed: Option<Changed>,
    /// Whether the artifact does not hold the element, so that an update was the first to see atoms of it.
    new: bool,
}

/// The arrays of all slots of an element.
#[derive(Debug)]
struct Changed {
    scatters: Vec<f32>,
    counts: Vec<f64>,
    effective_counts: Vec<f64>,
    condition_numbers: Vec<f32>,
    effective_ranks: Vec<i32>,
    truncated: Vec<i32>,
}

impl ArtifactVersion {
    /// `original` is the mixture of the artifact, as loaded, and `mixture` a later version of it.
    ///
    /// # Errors
    /// As [`Artifact::load`](crate::Artifact::load); covariances whose eigenvalues do not converge.
    pub fn new(artifact: &Path, original: &Mixture, mixture: &Mixture) -> Result<Self, ArtifactVersionError> {
        let file = &NpzFile::open(artifact)?;
        let weighted = file.contains(WEIGHTED_THRESHOLDS);
        let key = if weighted { WEIGHTED_THRESHOLDS } else { RAW_THRESHOLDS };
        let ([count, slots], thresholds) = file.numbers(key)?.tensor()?;
        let raw_thresholds = match file.contains(RAW_THRESHOLDS) {
            true => file.numbers(RAW_THRESHOLDS)?.with_shape(&[count, slots])?,
            false => thresholds.clone(),
        };
        let mut found = Self {
            version: mixture.version(),
            dimension: mixture.dimension(),
            slots,
            projection: Projection::load(artifact)?,
            projection_seed: file
                .contains(SEED)
                .then(|| file.integers(SEED))
                .transpose()?
                .and_then(|seed| seed.data.first().copied()),
            elements: (0..count).map(|_| None).collect(),
            thresholds: single(&thresholds).collect(),
            raw_thresholds: single(&raw_thresholds).collect(),
            histograms: file.contains(EDGES),
        };
        let held = file.indices("elements", count)?;
        for element in 0..count {
            found.add(file, element, held.contains(&element), original, mixture)?;
        }
        Ok(found)
    }

    fn add(
        &mut self,
        file: &NpzFile,
        element: usize,
        held: bool,
        original: &Mixture,
        mixture: &Mixture,
    ) -> Result<(), ArtifactVersionError> {
        let components = mixture.components(element).unwrap_or_default();
        let before = original.components(element).unwrap_or_default();
        let changed: Vec<usize> =
            (0..components.len()).filter(|&slot| before.get(slot) != components.get(slot)).collect();
        let (slots, dimension) = (self.slots, self.dimension);
        if !held {
            let threshold = components.first().map_or(1.0, |component| component.threshold() as f32);
            for thresholds in [&mut self.thresholds, &mut self.raw_thresholds] {
                thresholds.chunks_exact_mut(slots).nth(element).unwrap_or_default().fill(threshold);
            }
            if changed.is_empty() {
                return Ok(());
            }
        }
        let mut arrays = match held {
            true => ElementArrays::read(file, element, slots, dimension)?,
            false => ElementArrays::unused(slots, dimension),
        };
        if !changed.is_empty() {
            let mut others = match held {
                true => Changed::read(file, element, slots, dimension)?,
                false => Changed::unused(slots, dimension),
            };
            for slot in changed {
                let component = &components[slot];
                arrays.replace(slot, component);
                others.replace(slot, component).map_err(|source| ArtifactVersionError::Linear {
                    element,
                    slot,
                    source,
                })?;
            }
            arrays.changed = Some(others);
        }
        self.elements[element] = Some(arrays);
        Ok(())
    }

    /// Writes a copy of the artifact with this version, which [`Artifact::load`](crate::Artifact::load) reads. Arrays without
    /// changed components are copied byte by byte. `campaign` and `mixture_version` record where it is from.
    ///
    /// # Errors
    /// If reading or writing fails.
    pub fn write_artifact<R: Read + Seek, W: Write + Seek>(
        &self,
        artifact: R,
        out: W,
        campaign: &str,
    ) -> io::Result<W> {
        let mut file = Writer::new(out);
        let changed = || {
            self.elements.iter().enumerate().filter_map(|(index, element)| {
                let element = element.as_ref()?;
                Some((index, element, element.changed.as_ref()?))
            })
        };
        let new = changed().any(|(_, element, _)| element.new);
        let mut replaced: Vec<String> = ["campaign", "mixture_version"].map(str::to_owned).to_vec();
        if new {
            replaced.extend(["elements", RAW_THRESHOLDS, WEIGHTED_THRESHOLDS].map(str::to_owned));
        }
        for (index, ..) in changed() {
            replaced.extend(ARRAYS.map(|name| format!("{name}_{index}")));
        }
        file.copy(artifact, |key| replaced.iter().any(|replaced| replaced == key))?;
        file.strings("campaign", &[], &[campaign])?;
        file.scalar("mixture_version", i64::try_from(self.version).unwrap_or(i64::MAX))?;
        if new {
            let held = (0..).zip(&self.elements).filter(|(_, element)| element.is_some());
            let held: Vec<i32> = held.map(|(index, _)| index).collect();
            file.array("elements", &[held.len()], held)?;
            let shape = [self.elements.len(), self.slots];
            file.array(RAW_THRESHOLDS, &shape, self.raw_thresholds.iter().copied())?;
            file.array(WEIGHTED_THRESHOLDS, &shape, self.thresholds.iter().copied())?;
        }
        for (index, element, changed) in changed() {
            self.write_element(&mut file, index, element, changed)?;
        }
        file.finish()
    }

    fn write_element<W: Write + Seek>(
        &self,
        file: &mut Writer<W>,
        index: usize,
        element: &ElementArrays,
        changed: &Changed,
    ) -> io::Result<()> {
        let (slots, dimension) = (self.slots, self.dimension);
        let square = [slots, dimension, dimension];
        let key = |name: &str| format!("{name}_{index}");
        file.array(&key("centroids"), &square[..2], element.centroids.iter().copied())?;
        file.array(&key("inv_cov"), &square, element.inverses.iter().copied())?;
        file.array(&key("scatter"), &square, changed.scatters.iter().copied())?;
        file.array(&key("counts"), &[slots], changed.counts.iter().copied())?;
        file.array(&key("effective_count"), &[slots], changed.effective_counts.iter().copied())?;
        file.array(&key("cond_number"), &[slots], changed.condition_numbers.iter().copied())?;
        file.array(&key("effective_rank"), &[slots], changed.effective_ranks.iter().copied())?;
        file.array(&key("n_truncated"), &[slots], changed.truncated.iter().copied())?;
        if element.new && self.histograms {
            file.array(&key("hist"), &[slots, BINS], vec![0_i64; slots * BINS])?;
            file.array(&key("eff_hist"), &[slots, BINS], vec![0.0_f32; slots * BINS])?;
        }
        Ok(())
    }

    /// Writes a copy of the model's export with this version, which
    /// [`Artifact::load_export`](crate::Artifact::load_export) reads. All other arrays, which include the projection, are copied
    /// byte by byte.
    ///
    /// # Errors
    /// If reading or writing fails.
    pub fn write_export<R: Read + Seek, W: Write + Seek>(&self, model: R, out: W) -> io::Result<W> {
        let (slots, dimension) = (self.slots, self.dimension);
        let centroids = self.elements.iter().flat_map(|element| match element {
            Some(element) => element.centroids.clone(),
            None => vec![0.0; slots * dimension],
        });
        let inverses = self.elements.iter().flat_map(|element| match element {
            Some(element) => element.inverses.clone(),
            None => (0..slots).flat_map(|_| unused_inverse(dimension)).collect(),
        });
        let shape = [self.elements.len(), slots, dimension];
        embed(
            model,
            out,
            (&self.projection, self.projection_seed),
            shape,
            self.thresholds.iter().copied(),
            centroids,
            inverses,
        )
    }
}

/// The arrays of an element that an update changes.
const ARRAYS: [&str; 8] = [
    "centroids",
    "inv_cov",
    "scatter",
    "counts",
    "effective_count",
    "cond_number",
    "effective_rank",
    "n_truncated",
];

impl ElementArrays {
    fn unused(slots: usize, dimension: usize) -> Self {
        Self {
            centroids: vec![UNUSED; slots * dimension],
            inverses: (0..slots).flat_map(|_| unused_inverse(dimension)).collect(),
            changed: None,
            new: true,
        }
    }

    fn read(
        file: &NpzFile,
        element: usize,
        slots: usize,
        dimension: usize,
    ) -> Result<Self, ArtifactVersionError> {
        let mut arrays = Self { new: false, ..Self::unused(slots, dimension) };
        overwrite(&mut arrays.centroids, &numbers(file, "centroids", element)?);
        overwrite(&mut arrays.inverses, &numbers(file, "inv_cov", element)?);
        Ok(arrays)
    }

    fn replace(&mut self, slot: usize, component: &Component) {
        set(&mut self.centroids, slot, component.centroid());
        set(&mut self.inverses, slot, component.inverse());
    }
}

impl Changed {
    fn unused(slots: usize, dimension: usize) -> Self {
        Self {
            scatters: vec![0.0; slots * dimension * dimension],
            counts: vec![0.0; slots],
            effective_counts: vec![0.0; slots],
            condition_numbers: vec![1.0; slots],
            effective_ranks: vec![0; slots],
            truncated: vec![0; slots],
        }
    }

    /// What the artifact has of them; the last three are for information only, and early artifacts lack some.
    fn read(
        file: &NpzFile,
        element: usize,
        slots: usize,
        dimension: usize,
    ) -> Result<Self, ArtifactVersionError> {
        let mut arrays = Self::unused(slots, dimension);
        overwrite(&mut arrays.scatters, &numbers(file, "scatter", element)?);
        arrays.counts.splice(.., filled(numbers(file, "counts", element)?, slots));
        let optional = |name: &str, default: &[f64]| match file.contains(&format!("{name}_{element}")) {
            true => numbers(file, name, element).map(|found| filled(found, slots)),
            false => Ok(default.to_vec()),
        };
        arrays.effective_counts = optional("effective_count", &arrays.counts)?;
        let none = vec![0.0; slots];
        arrays.condition_numbers = single(&optional("cond_number", &vec![1.0; slots])?).collect();
        let whole = |values: Vec<f64>| values.into_iter().map(|value| value as i32).collect();
        arrays.effective_ranks = whole(optional("effective_rank", &none)?);
        arrays.truncated = whole(optional("n_truncated", &none)?);
        Ok(arrays)
    }

    fn replace(&mut self, slot: usize, component: &Component) -> Result<(), LinearError> {
        let Some(statistics) = component.statistics() else { return Ok(()) };
        let Inverted { condition_number, effective_rank, truncated, .. } =
            inverted(&statistics.covariance(), component.dimension())?;
        set(&mut self.scatters, slot, &statistics.scatter);
        self.counts[slot] = statistics.count;
        self.effective_counts[slot] = statistics.effective_count;
        self.condition_numbers[slot] = condition_number as f32;
        self.effective_ranks[slot] = effective_rank as i32;
        self.truncated[slot] = truncated as i32;
        Ok(())
    }
}

fn numbers(file: &NpzFile, name: &str, element: usize) -> Result<Vec<f64>, ArtifactVersionError> {
    Ok(file.numbers(&format!("{name}_{element}"))?.data)
}

fn filled(mut values: Vec<f64>, slots: usize) -> Vec<f64> {
    values.resize(slots, 0.0);
    values
}

/// Replaces the first numbers.
fn overwrite(place: &mut [f32], values: &[f64]) {
    place.iter_mut().zip(single(values)).for_each(|(place, value)| *place = value);
}

/// Replaces the numbers of a slot.
fn set(arrays: &mut [f32], slot: usize, values: &[f64]) {
    if let Some(place) = arrays.chunks_exact_mut(values.len()).nth(slot) {
        overwrite(place, values);
    }
}
