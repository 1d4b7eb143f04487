//! Loading a mixture from a CALM artifact (`gmm_artifacts.npz`) or from an exported model (`kokkos.npz`).

use std::path::{Path, PathBuf};
use std::sync::Arc;

use npz::{Error, NpzFile};

use crate::component::{Component, ComponentError, Statistics};
use crate::mixture::{Mixture, MixtureError};

/// Schema versions that can be read: 3 (linear features), 4 (asinh), 6 (normalised, with density channels).
pub const SCHEMAS: [usize; 3] = [3, 4, 6];

/// Centroids of unused slots are filled with 10¹⁰; no real feature is this large.
pub(crate) const SENTINEL: f64 = 1e9;

/// A stored matrix counts as symmetric if its asymmetry is at most this fraction of the largest element.
const ASYMMETRY: f64 = 1e-3;

/// A loaded mixture with the data that tie it to a potential.
#[derive(Debug, Clone, PartialEq)]
pub struct Artifact {
    /// Chemical symbols, in the order of the element indices.
    pub symbols: Vec<String>,
    /// The mixture, version 0. A mixture from an export alone can grade but cannot be updated.
    pub mixture: Mixture,
    /// The projection of its features.
    pub projection: Projection,
}

/// How features are computed from the invariant basis: this must agree between an artifact and a potential.
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    /// Random projection matrix R, `[rows × columns]`, row-major, as stored.
    pub matrix: Vec<f32>,
    /// Basis size.
    pub rows: usize,
    /// Projected dimension d.
    pub columns: usize,
    /// Feature dimension D: d, or d + 1 + blocks with density channels.
    pub feature_dimension: usize,
    /// Whether the normalised basis goes through asinh.
    pub asinh: bool,
    /// Whether the basis is normalised.
    pub normalised: bool,
    /// Whether logarithmic norms are appended.
    pub density_channels: bool,
    /// Factor of the logarithmic norms.
    pub density_scale: f32,
}

/// Why an artifact does not belong to a model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the CALM artifact belongs to another model: its {what} is {artifact}, the model's is {model}")]
pub struct ProjectionMismatch {
    /// What differs.
    pub what: &'static str,
    /// Its value in the artifact.
    pub artifact: String,
    /// Its value in the model.
    pub model: String,
}

/// Why an artifact could not be loaded.
#[derive(Debug, thiserror::Error)]
pub enum ArtifactError {
    /// The file could not be opened as an archive.
    #[error("{}: {source}; expected a NumPy .npz archive", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        source: std::io::Error,
    },
    /// An array is missing.
    #[error(
        "{}: no array '{key}'; expected gmm_artifacts.npz, or an export made with CALM arrays (uq_*)",
        path.display()
    )]
    Missing {
        /// The file.
        path: PathBuf,
        /// Its missing key.
        key: String,
    },
    /// An array has an unexpected type, shape or value.
    #[error("{}: array '{key}': found {found}, expected {expected}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// Key of the array.
        key: String,
        /// What it holds.
        found: String,
        /// What it should hold.
        expected: String,
    },
    /// The numbers of a slot are not a valid component.
    #[error("{}: component {slot} of element {element}: {source}", path.display())]
    Component {
        /// The file.
        path: PathBuf,
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
        /// What is wrong with it.
        source: ComponentError,
    },
    /// The components are not a valid mixture.
    #[error("{}: {source}", path.display())]
    Mixture {
        /// The file.
        path: PathBuf,
        /// What is wrong with them.
        source: MixtureError,
    },
}

impl From<Error> for ArtifactError {
    fn from(error: Error) -> Self {
        match error {
            Error::Open { path, source } | Error::NotAnArchive { path, source } => {
                Self::Open { path, source }
            }
            Error::Missing { path, key } => Self::Missing { path, key },
            Error::Type { path, key, found, expected } => {
                Self::Invalid { path, key, found: format!("type {found}"), expected }
            }
            Error::Shape { path, key, found, expected } => {
                Self::Invalid { path, key, found: format!("shape {found}"), expected }
            }
            Error::Damaged { path, key, found, expected } | Error::Value { path, key, found, expected } => {
                Self::Invalid { path, key, found, expected }
            }
        }
    }
}

impl Artifact {
    /// Loads `gmm_artifacts.npz`: a mixture that can grade and can be updated.
    ///
    /// Prefers the weighted thresholds where the file has both. Trailing slots that can never be the nearest
    /// are dropped. Elements that the artifact does not hold get [`Component::unknown_element`].
    ///
    /// # Errors
    /// Missing or ill-shaped arrays and unknown schema versions, with file, key, what was found and what was
    /// expected.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ArtifactError> {
        let path = path.as_ref();
        let file = &NpzFile::open(path)?;
        check_schema(file, "__schema_version__")?;
        if file.contains("uq_feature_mode") {
            let mode = file.strings("uq_feature_mode")?.concat();
            if mode != "basis_rp" {
                return Err(invalid(file, "uq_feature_mode", mode, "basis_rp"));
            }
        }
        let symbols = file.strings("element_map")?;
        let thresholds = thresholds(file, symbols.len())?;
        let mut elements = vec![None; symbols.len()];
        let mut dimension = 0;
        for number in file.numbers("elements")?.data {
            let element = as_count(file, "elements", number)?;
            let place = elements.get_mut(element);
            let place = place.ok_or_else(|| {
                invalid(file, "elements", element, format!("an index below {}", symbols.len()))
            })?;
            let slots = ElementComponents::read(file, element, thresholds.get(element))?;
            dimension = slots.dimension;
            *place = Some(slots.components(path, element)?);
        }
        if dimension == 0 {
            return Err(invalid(file, "elements", "no element", "at least one"));
        }
        let unknown = || vec![Arc::new(Component::unknown_element(dimension))];
        let elements = elements.into_iter().map(|element| element.unwrap_or_else(unknown)).collect();
        finish(path, file, symbols, elements, asinh(file)?)
    }

    /// Loads the CALM arrays (`uq_*`) of an exported model: a mixture that can grade but cannot be updated.
    ///
    /// # Errors
    /// As [`Artifact::load`].
    pub fn load_export(path: impl AsRef<Path>) -> Result<Self, ArtifactError> {
        let path = path.as_ref();
        let file = &NpzFile::open(path)?;
        check_schema(file, "uq_schema_version")?;
        let symbols = file.strings("element_names")?;
        let element_count = count(file, "uq_n_elements")?;
        if element_count != symbols.len() {
            return Err(invalid(file, "uq_n_elements", element_count, symbols.len()));
        }
        let (slots, dimension) = (count(file, "uq_max_clusters")?, count(file, "uq_feature_dim")?);
        let centroids = file.numbers("uq_centroids")?.with_shape(&[element_count, slots, dimension])?;
        let inverses = symmetric(file, "uq_inv_cov", &[element_count, slots, dimension, dimension])?;
        let thresholds = file.numbers("uq_interp_thresholds")?.with_shape(&[element_count, slots])?;
        if slots == 0 || dimension == 0 {
            return Err(invalid(file, "uq_centroids", "no centroid", "at least one an element"));
        }
        let mut elements = Vec::new();
        let rows = thresholds.chunks_exact(slots).zip(centroids.chunks_exact(slots * dimension));
        let rows = rows.zip(inverses.chunks_exact(slots * dimension * dimension));
        for (element, ((thresholds, centroids), inverses)) in rows.enumerate() {
            let slots = ElementComponents {
                dimension,
                thresholds: thresholds.to_vec(),
                centroids: centroids.to_vec(),
                inverses: inverses.to_vec(),
                statistics: Vec::new(),
            };
            elements.push(slots.components(path, element)?);
        }
        let asinh = file.scalar_or("uq_feature_transform", 0.0)?;
        if asinh != 0.0 && asinh != 1.0 {
            return Err(invalid(file, "uq_feature_transform", asinh, "0 (none) or 1 (asinh)"));
        }
        finish(path, file, symbols, elements, asinh == 1.0)
    }

    /// Checks that this artifact belongs to a model, given the model's export: same elements in the same order
    /// and the same projection.
    ///
    /// # Errors
    /// The first difference.
    pub fn check_belongs_to(
        &self,
        symbols: &[String],
        projection: &Projection,
    ) -> Result<(), ProjectionMismatch> {
        differs("list of elements", self.symbols.join(" "), symbols.join(" "))?;
        self.projection.check_same(projection)
    }
}

impl Projection {
    /// Loads the projection of `gmm_artifacts.npz` alone.
    ///
    /// # Errors
    /// As [`Artifact::load`].
    pub fn load(path: impl AsRef<Path>) -> Result<Self, ArtifactError> {
        let file = &NpzFile::open(path.as_ref())?;
        check_schema(file, "__schema_version__")?;
        let elements = file.numbers("elements")?.data;
        let first =
            elements.first().ok_or_else(|| invalid(file, "elements", "no element", "at least one"))?;
        let centroids = file.numbers(&format!("centroids_{}", as_count(file, "elements", *first)?))?;
        let dimension = centroids.shape.last().copied().unwrap_or_default();
        Self::read(file, dimension, asinh(file)?)
    }

    /// Reads the keys that both file formats share.
    fn read(file: &NpzFile, feature_dimension: usize, asinh: bool) -> Result<Self, ArtifactError> {
        let matrix = file.numbers("uq_rp_matrix")?;
        let [rows, columns] = matrix.shape[..] else {
            let found = format!("shape {:?}", matrix.shape);
            return Err(invalid(file, "uq_rp_matrix", found, "shape [D_basis, d]"));
        };
        let announced = count(file, "uq_rp_dim")?;
        if announced != columns {
            let expected = format!("{columns}, the columns of uq_rp_matrix");
            return Err(invalid(file, "uq_rp_dim", announced, expected));
        }
        let projection = Self {
            matrix: matrix.data.iter().map(|&value| value as f32).collect(),
            rows,
            columns,
            feature_dimension,
            asinh,
            normalised: file.scalar_or("uq_rp_normalize", 0.0)? != 0.0,
            density_channels: file.scalar_or("uq_rp_add_density_channel", 0.0)? != 0.0,
            density_scale: file.scalar_or("uq_rp_density_scale", 1.0)? as f32,
        };
        let extra = feature_dimension.checked_sub(columns);
        let fits = if projection.density_channels { extra >= Some(2) } else { extra == Some(0) };
        if fits {
            return Ok(projection);
        }
        let found = format!("{columns} columns for {feature_dimension} features");
        let expected = "as many, or at least two less with density channels";
        Err(invalid(file, "uq_rp_matrix", found, expected))
    }

    /// Checks that both artifacts describe the same features.
    ///
    /// # Errors
    /// The first difference; `self` is called the artifact, `model` the model.
    pub fn check_same(&self, model: &Self) -> Result<(), ProjectionMismatch> {
        differs("feature dimension", self.feature_dimension, model.feature_dimension)?;
        differs("basis size", self.rows, model.rows)?;
        differs("projected dimension", self.columns, model.columns)?;
        differs("asinh transform", self.asinh, model.asinh)?;
        differs("basis normalisation", self.normalised, model.normalised)?;
        differs("use of density channels", self.density_channels, model.density_channels)?;
        differs("density scale", self.density_scale, model.density_scale)?;
        differs("projection matrix length", self.matrix.len(), model.matrix.len())?;
        let mut pairs = self.matrix.iter().zip(&model.matrix).enumerate();
        match pairs.find(|(_, (a, b))| a.to_bits() != b.to_bits()) {
            Some((index, (a, b))) => {
                let describe = |value| format!("{value} at number {index}");
                Err(ProjectionMismatch {
                    what: "projection matrix",
                    artifact: describe(a),
                    model: describe(b),
                })
            }
            None => Ok(()),
        }
    }

    /// The projection as bytes in a fixed order (sizes, flags, scale, matrix; little-endian), for hashing.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut out = Vec::new();
        for size in [self.rows, self.columns, self.feature_dimension] {
            out.extend((size as u64).to_le_bytes());
        }
        out.extend([self.asinh, self.normalised, self.density_channels].map(u8::from));
        out.extend(self.density_scale.to_le_bytes());
        out.extend(self.matrix.iter().flat_map(|value| value.to_le_bytes()));
        out
    }
}

fn differs<T: PartialEq + ToString>(
    what: &'static str,
    artifact: T,
    model: T,
) -> Result<(), ProjectionMismatch> {
    if artifact == model {
        return Ok(());
    }
    Err(ProjectionMismatch { what, artifact: artifact.to_string(), model: model.to_string() })
}

fn invalid(file: &NpzFile, key: &str, found: impl ToString, expected: impl ToString) -> ArtifactError {
    file.invalid(key, found, expected).into()
}

/// A count; some builds store it as a floating-point number.
fn count(file: &NpzFile, key: &str) -> Result<usize, ArtifactError> {
    as_count(file, key, file.scalar(key)?)
}

fn as_count(file: &NpzFile, key: &str, found: f64) -> Result<usize, ArtifactError> {
    if found.fract() == 0.0 && (0.0..=u32::MAX as f64).contains(&found) {
        return Ok(found as usize);
    }
    Err(invalid(file, key, found, "a whole number, 0 or more"))
}

fn check_schema(file: &NpzFile, key: &str) -> Result<(), ArtifactError> {
    let schema = count(file, key)?;
    if SCHEMAS.contains(&schema) {
        return Ok(());
    }
    Err(invalid(file, key, format!("schema version {schema}"), "version 3, 4 or 6; build the artifact again"))
}

/// θ, `[elements][slots]`: the weighted thresholds if present.
fn thresholds(file: &NpzFile, elements: usize) -> Result<Vec<Vec<f64>>, ArtifactError> {
    let weighted = file.contains("eff_interp_thresholds");
    let key = if weighted { "eff_interp_thresholds" } else { "interp_thresholds" };
    let found = file.numbers(key)?;
    match found.shape[..] {
        [rows, slots] if rows == elements && slots > 0 => {
            Ok(found.data.chunks_exact(slots).map(<[f64]>::to_vec).collect())
        }
        _ => Err(invalid(file, key, format!("shape {:?}", found.shape), format!("shape [{elements}, K]"))),
    }
}

/// Consecutive square matrices of this shape, each symmetric up to rounding.
fn symmetric(file: &NpzFile, key: &str, shape: &[usize]) -> Result<Vec<f64>, ArtifactError> {
    let numbers = file.numbers(key)?.with_shape(shape)?;
    let dimension = shape.last().copied().unwrap_or_default();
    for (index, matrix) in numbers.chunks_exact((dimension * dimension).max(1)).enumerate() {
        let largest = matrix.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
        let pairs = (0..dimension).flat_map(|row| (0..row).map(move |column| (row, column)));
        let mut values = pairs.map(|(i, j)| (matrix[i * dimension + j], matrix[j * dimension + i]));
        if let Some((a, b)) = values.find(|(a, b)| (a - b).abs() > ASYMMETRY * largest) {
            let found = format!("{a:e} and {b:e} on both sides of the diagonal of matrix {index}");
            return Err(invalid(file, key, found, "symmetric matrices"));
        }
    }
    Ok(numbers)
}

/// The arrays of one element, slot by slot.
struct ElementComponents {
    dimension: usize,
    thresholds: Vec<f64>,
    centroids: Vec<f64>,
    inverses: Vec<f64>,
    statistics: Vec<Statistics>,
}

impl ElementComponents {
    fn read(file: &NpzFile, element: usize, thresholds: Option<&Vec<f64>>) -> Result<Self, ArtifactError> {
        let key = format!("centroids_{element}");
        let centroids = file.numbers(&key)?;
        let [slots, dimension] = centroids.shape[..] else {
            return Err(invalid(file, &key, format!("shape {:?}", centroids.shape), "shape [K, D]"));
        };
        let thresholds = thresholds.filter(|row| row.len() >= slots).cloned();
        let thresholds = thresholds.ok_or_else(|| {
            invalid(file, &key, format!("{slots} components"), "at most one for each threshold")
        })?;
        if slots == 0 || dimension == 0 {
            return Err(invalid(file, &key, format!("shape {:?}", centroids.shape), "at least one centroid"));
        }
        let square = [slots, dimension, dimension];
        let inverses = symmetric(file, &format!("inv_cov_{element}"), &square)?;
        let scatters = symmetric(file, &format!("scatter_{element}"), &square)?;
        let counts = file.numbers(&format!("counts_{element}"))?.with_shape(&[slots])?;
        let weighted = format!("effective_count_{element}");
        let effective = if file.contains(&weighted) {
            file.numbers(&weighted)?.with_shape(&[slots])?
        } else {
            counts.clone()
        };
        let statistics = scatters.chunks_exact(dimension * dimension).zip(counts.iter().zip(effective));
        let statistics = statistics
            .map(|(scatter, (&count, effective_count))| Statistics {
                scatter: scatter.to_vec(),
                count,
                effective_count,
            })
            .collect();
        Ok(Self { dimension, thresholds, centroids: centroids.data, inverses, statistics })
    }

    /// The components up to the last slot that can be the nearest or has data. Drops trailing sentinels and
    /// repetitions of the first centroid (an element that the artifact does not hold); indices do not change.
    fn components(&self, path: &Path, element: usize) -> Result<Vec<Arc<Component>>, ArtifactError> {
        let centroids: Vec<&[f64]> = self.centroids.chunks_exact(self.dimension).collect();
        let has_data = |slot: usize| self.statistics.get(slot).is_some_and(|found| found.count > 0.0);
        let used = |(slot, centroid): (usize, &&[f64])| {
            let own =
                Some(centroid) != centroids.first() && centroid.iter().any(|value| value.abs() < SENTINEL);
            own || has_data(slot)
        };
        let count = centroids.iter().enumerate().rposition(used).map_or(1, |last| last + 1);
        let inverses = self.inverses.chunks_exact(self.dimension * self.dimension);
        let slots = centroids.iter().zip(inverses).zip(&self.thresholds).take(count).enumerate();
        let components = slots.map(|(slot, ((centroid, inverse), &threshold))| {
            let statistics = self.statistics.get(slot).cloned();
            Component::new(centroid.to_vec(), inverse.to_vec(), threshold, statistics).map(Arc::new).map_err(
                |source| ArtifactError::Component { path: path.to_path_buf(), element, slot, source },
            )
        });
        components.collect()
    }
}

/// Whether the features of an artifact go through asinh.
fn asinh(file: &NpzFile) -> Result<bool, ArtifactError> {
    let transform = match file.contains("uq_feature_transform") {
        true => file.strings("uq_feature_transform")?.concat(),
        false => String::new(),
    };
    match transform.as_str() {
        "" | "none" | "linear" | "identity" => Ok(false),
        "asinh" => Ok(true),
        _ => Err(invalid(file, "uq_feature_transform", transform, "none or asinh")),
    }
}

/// Assembles the artifact.
fn finish(
    path: &Path,
    file: &NpzFile,
    symbols: Vec<String>,
    elements: Vec<Vec<Arc<Component>>>,
    asinh: bool,
) -> Result<Artifact, ArtifactError> {
    let mixture = Mixture::new(0, elements)
        .map_err(|source| ArtifactError::Mixture { path: path.to_path_buf(), source })?;
    let projection = Projection::read(file, mixture.dimension(), asinh)?;
    Ok(Artifact { symbols, mixture, projection })
}
