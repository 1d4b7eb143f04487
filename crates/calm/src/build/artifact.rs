//! The built mixture as an [`Artifact`] and as a file.

use std::io::{self, Seek, Write};
use std::path::Path;
use std::sync::Arc;

use npz::{NpzFile, Writer};

use super::components::BuiltComponent;
use super::error::{BuildError, expect_length};
use super::histogram::{BINS, BinEdges, ElementHistograms, SigmaHistogram};
use super::settings::BuildSettings;
use super::thresholds::{ThresholdRule, Thresholds};
use crate::artifact::{Artifact, ArtifactError, Projection};
use crate::component::{Component, Statistics};
use crate::linear::REGULARISATION;
use crate::mixture::Mixture;

/// Centroids of unused slots are filled with this.
pub(super) const UNUSED: f32 = 1e10;

/// Largest relative deviation of stored edges of bins from the grid.
const EDGE_ROUNDING: f64 = 1e-6;

/// What the three passes found for an element.
#[derive(Debug, Clone, PartialEq)]
pub struct BuiltElement {
    /// Its components, in order.
    pub components: Vec<BuiltComponent>,
    /// The histograms of σ of each component.
    pub histograms: ElementHistograms,
}

/// A mixture with everything that its artifact records.
#[derive(Debug, Clone, PartialEq)]
pub struct BuiltMixture {
    symbols: Vec<String>,
    projection: Projection,
    projection_seed: Option<i64>,
    settings: BuildSettings,
    elements: Vec<Option<BuiltElement>>,
    /// The largest number of components of an element.
    slots: usize,
    /// Of every slot of each element.
    thresholds: Vec<Thresholds>,
}

impl BuiltMixture {
    /// Calibrates the thresholds of a mixture.
    ///
    /// `symbols` and `elements` are in the order of the element indices; an element without training atoms is `None`.
    /// `projection_seed` is the random seed of the projection matrix, if known.
    ///
    /// # Errors
    /// Lists of unequal lengths, features of unequal dimensions, no element with atoms.
    pub fn new(
        symbols: Vec<String>,
        projection: Projection,
        projection_seed: Option<i64>,
        settings: BuildSettings,
        elements: Vec<Option<BuiltElement>>,
    ) -> Result<Self, BuildError> {
        settings.check()?;
        let dimension = settings.dimension;
        expect_length("elements", elements.len(), symbols.len())?;
        expect_length("features of the projection", projection.feature_dimension, dimension)?;
        expect_length("projection matrix", projection.matrix.len(), projection.rows * projection.columns)?;
        for element in elements.iter().flatten() {
            let count = element.components.len();
            expect_length("histograms of an element", element.histograms.components.len(), count)?;
            for component in &element.components {
                expect_length("centroid", component.centroid.len(), dimension)?;
                expect_length("inverse covariance", component.inverse.len(), dimension * dimension)?;
                expect_length("scatter", component.scatter.len(), dimension * dimension)?;
            }
            if count == 0 {
                return Err(BuildError::NoCentroid);
            }
        }
        let slots = elements.iter().flatten().map(|element| element.components.len()).max();
        let slots = slots.ok_or(BuildError::NoCentroid)?;
        let thresholds =
            elements.iter().map(|element| thresholds(element.as_ref(), slots, dimension)).collect();
        Ok(Self { symbols, projection, projection_seed, settings, elements, slots, thresholds })
    }

    /// What each pass found for each element.
    pub fn elements(&self) -> &[Option<BuiltElement>] {
        &self.elements
    }

    /// The largest number of components of an element.
    pub(super) fn slots(&self) -> usize {
        self.slots
    }

    pub(super) fn projection(&self) -> (&Projection, Option<i64>) {
        (&self.projection, self.projection_seed)
    }

    pub(super) fn dimension(&self) -> usize {
        self.settings.dimension
    }

    /// Thresholds of each element, one for every slot: as many slots as the largest number of components of an element.
    pub fn thresholds(&self) -> &[Thresholds] {
        &self.thresholds
    }

    /// The artifact, with all numbers rounded to single precision as in its file, so that it is the one that
    /// [`Artifact::load`] reads.
    ///
    /// # Errors
    /// Numbers that are not finite in single precision.
    pub fn artifact(&self) -> Result<Artifact, BuildError> {
        let dimension = self.settings.dimension;
        let mut elements = Vec::new();
        for (index, (element, thresholds)) in self.elements.iter().zip(&self.thresholds).enumerate() {
            let Some(element) = element else {
                elements.push(vec![Arc::new(Component::unknown_element(dimension))]);
                continue;
            };
            let slots = element.components.iter().zip(&thresholds.weighted).enumerate();
            let components = slots.map(|(slot, (component, &threshold))| {
                stored(component, threshold).map_err(|source| BuildError::Component {
                    element: index,
                    slot,
                    source,
                })
            });
            elements.push(components.collect::<Result<_, _>>()?);
        }
        let mixture = Mixture::new(0, elements)?;
        Ok(Artifact { symbols: self.symbols.clone(), mixture, projection: self.projection.clone() })
    }

    /// Writes `gmm_artifacts.npz`, which [`Artifact::load`] reads. The same mixture gives the same bytes.
    ///
    /// Beside the arrays of the format, it holds the settings of the build: `build_seed`, `build_candidates` and
    /// `build_shard_size`.
    ///
    /// # Errors
    /// If writing fails.
    pub fn write<W: Write + Seek>(&self, out: W) -> io::Result<W> {
        let mut file = Writer::new(out);
        self.write_header(&mut file)?;
        for (index, element) in self.elements.iter().enumerate() {
            if let Some(element) = element {
                self.write_element(&mut file, index, element)?;
            }
        }
        file.finish()
    }

    fn write_header<W: Write + Seek>(&self, file: &mut Writer<W>) -> io::Result<()> {
        let Self { projection, settings, symbols, .. } = self;
        file.scalar("__schema_version__", schema(projection))?;
        let present: Vec<i32> =
            (0..).zip(&self.elements).filter(|(_, found)| found.is_some()).map(|(index, _)| index).collect();
        file.array("elements", &[present.len()], present)?;
        let names: Vec<&str> = symbols.iter().map(String::as_str).collect();
        file.strings("element_map", &[names.len()], &names)?;

        let shape = [symbols.len(), self.slots];
        let raw = self.thresholds.iter().flat_map(|thresholds| &thresholds.raw);
        file.array("interp_thresholds", &shape, raw.map(|&value| value as f32))?;
        let weighted = self.thresholds.iter().flat_map(|thresholds| &thresholds.weighted);
        file.array("eff_interp_thresholds", &shape, weighted.map(|&value| value as f32))?;
        file.strings("threshold_mode", &[], &["robust_mad"])?;
        let grid = BinEdges::default();
        file.array("hist_bin_edges", &[BINS + 1], grid.edges().iter().map(|&edge| edge as f32))?;

        file.strings("uq_feature_mode", &[], &["basis_rp"])?;
        let matrix = projection.matrix.iter().copied();
        file.array("uq_rp_matrix", &[projection.rows, projection.columns], matrix)?;
        file.scalar("uq_rp_dim", projection.columns as i64)?;
        if let Some(seed) = self.projection_seed {
            file.scalar("uq_rp_seed", seed)?;
        }
        if projection.asinh {
            file.strings("uq_feature_transform", &[], &["asinh"])?;
        }
        file.scalar("uq_rp_normalize", projection.normalised)?;
        file.scalar("uq_rp_add_density_channel", projection.density_channels)?;
        file.scalar("uq_rp_density_scale", f64::from(projection.density_scale))?;

        file.scalar("build_seed", settings.seed)?;
        let candidates = settings.candidates.iter().map(|&k| k as u64);
        file.array("build_candidates", &[settings.candidates.len()], candidates)?;
        file.scalar("build_shard_size", settings.shard_size)
    }

    /// The arrays of an element, filled up to the number of slots.
    fn write_element<W: Write + Seek>(
        &self,
        file: &mut Writer<W>,
        index: usize,
        element: &BuiltElement,
    ) -> io::Result<()> {
        let (slots, dimension) = (self.slots, self.settings.dimension);
        let components = || element.components.iter();
        let unused = slots - element.components.len();
        let square = [slots, dimension, dimension];
        let single = |value: &f64| *value as f32;

        let fill = std::iter::repeat_n(UNUSED, unused * dimension);
        let centroids = components().flat_map(|c| c.centroid.iter().map(single));
        file.array(&format!("centroids_{index}"), &[slots, dimension], centroids.chain(fill))?;
        let empty = (0..unused).flat_map(|_| unused_inverse(dimension));
        let inverses = components().flat_map(|c| c.inverse.iter().map(single));
        file.array(&format!("inv_cov_{index}"), &square, inverses.chain(empty))?;
        let fill = std::iter::repeat_n(0.0_f32, unused * dimension * dimension);
        let scatters = components().flat_map(|c| c.scatter.iter().map(single));
        file.array(&format!("scatter_{index}"), &square, scatters.chain(fill))?;

        let fill = |value: f64| std::iter::repeat_n(value, unused);
        let counts = components().map(|c| c.count).chain(fill(0.0));
        file.array(&format!("counts_{index}"), &[slots], counts)?;
        let effective = components().map(|c| c.effective_count).chain(fill(0.0));
        file.array(&format!("effective_count_{index}"), &[slots], effective)?;
        let conditions = components().map(|c| c.condition_number).chain(fill(1.0));
        file.array(&format!("cond_number_{index}"), &[slots], conditions.map(|value| value as f32))?;
        let fill = || std::iter::repeat_n(0_i32, unused);
        let ranks = components().map(|c| c.effective_rank as i32).chain(fill());
        file.array(&format!("effective_rank_{index}"), &[slots], ranks)?;
        let truncated = components().map(|c| c.truncated as i32).chain(fill());
        file.array(&format!("n_truncated_{index}"), &[slots], truncated)?;

        let histograms = || element.histograms.components.iter();
        let raw = histograms().flat_map(|histogram| histogram.raw.iter().map(|&count| count as i64));
        let fill = std::iter::repeat_n(0_i64, unused * BINS);
        file.array(&format!("hist_{index}"), &[slots, BINS], raw.chain(fill))?;
        let weighted = histograms().flat_map(|histogram| histogram.weighted.iter().map(single));
        let fill = std::iter::repeat_n(0.0_f32, unused * BINS);
        file.array(&format!("eff_hist_{index}"), &[slots, BINS], weighted.chain(fill))
    }
}

/// The version of the format that the features need.
pub(super) fn schema(projection: &Projection) -> i64 {
    match projection {
        Projection { normalised: true, .. } | Projection { density_channels: true, .. } => 6,
        Projection { asinh: true, .. } => 4,
        _ => 3,
    }
}

/// Numbers in single precision, as files have them.
pub(super) fn single(values: &[f64]) -> impl Iterator<Item = f32> {
    values.iter().map(|&value| value as f32)
}

/// Inverse covariance of an unused slot, I/ε.
pub(super) fn unused_inverse(dimension: usize) -> impl Iterator<Item = f32> {
    let diagonal = (1.0 / REGULARISATION) as f32;
    (0..dimension * dimension).map(move |at| if at % (dimension + 1) == 0 { diagonal } else { 0.0 })
}

/// The thresholds of every slot; unused ones get those of components without data.
fn thresholds(element: Option<&BuiltElement>, slots: usize, dimension: usize) -> Thresholds {
    let mut histograms = match element {
        Some(element) => element.histograms.clone(),
        None => ElementHistograms::empty(0),
    };
    histograms.components.resize_with(slots, SigmaHistogram::default);
    histograms.thresholds(ThresholdRule::Robust, dimension)
}

/// A component as its file has it.
fn stored(
    component: &BuiltComponent,
    threshold: f64,
) -> Result<Arc<Component>, crate::component::ComponentError> {
    let single = |values: &[f64]| values.iter().map(|&value| f64::from(value as f32)).collect::<Vec<_>>();
    let statistics = Statistics {
        scatter: single(&component.scatter),
        count: component.count,
        effective_count: component.effective_count,
    };
    let (centroid, inverse) = (single(&component.centroid), single(&component.inverse));
    Component::new(centroid, inverse, f64::from(threshold as f32), Some(statistics)).map(Arc::new)
}

/// The histograms that an artifact stores for each element, from which [`ElementHistograms::thresholds`] calibrates
/// again; `None` for an element that it does not hold. Unused slots have empty histograms.
///
/// # Errors
/// As [`Artifact::load`]; histograms on another grid.
pub fn read_histograms(path: impl AsRef<Path>) -> Result<Vec<Option<ElementHistograms>>, ArtifactError> {
    let file = &NpzFile::open(path.as_ref())?;
    let edges = file.numbers("hist_bin_edges")?.with_shape(&[BINS + 1])?;
    let grid = BinEdges::default();
    let mut pairs = edges.iter().zip(grid.edges());
    if let Some((found, expected)) = pairs.find(|(a, b)| (*a - *b).abs() > EDGE_ROUNDING * *b) {
        return Err(file.invalid("hist_bin_edges", found, expected).into());
    }
    let mut elements = vec![None; file.strings("element_map")?.len()];
    let count = elements.len();
    for index in file.indices("elements", count)? {
        elements[index] = Some(read_element(file, index)?);
    }
    Ok(elements)
}

fn read_element(file: &NpzFile, index: usize) -> Result<ElementHistograms, ArtifactError> {
    let (raw, weighted) = (format!("hist_{index}"), format!("eff_hist_{index}"));
    let counts = file.integers(&raw)?;
    let slots = counts.shape.first().copied().unwrap_or_default();
    let counts = counts.with_shape(&[slots, BINS])?;
    if let Some(found) = counts.iter().find(|count| **count < 0) {
        return Err(file.invalid(&raw, found, "numbers of atoms").into());
    }
    let weights = file.floats(&weighted, &[slots, BINS])?;
    if let Some(found) = weights.iter().find(|weight| **weight < 0.0) {
        return Err(file.invalid(&weighted, found, "sums of weights").into());
    }
    let rows = counts.chunks_exact(BINS).zip(weights.chunks_exact(BINS));
    let components = rows.map(|(raw, weighted)| SigmaHistogram {
        raw: raw.iter().map(|&count| count as u64).collect(),
        weighted: weighted.to_vec(),
    });
    Ok(ElementHistograms { components: components.collect() })
}
