//! `calmwalk calm info`

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use atoms::Species;
use calm::{Artifact, Mixture};
use npz::NpzFile;
use potentials::grace::{GraceModel, NOTE};
use serde::Serialize;
use serde_json::Value;

use crate::cli::{CommandError, ExitStatus};
use crate::output::{TextTable, decimals, print, print_json};

/// Components printed without --json.
const SHOWN: usize = 40;

/// Show the contents of a GRACE model or CALM artifact
///
/// Detects the type of the file from its contents.
#[derive(Debug, clap::Args)]
pub struct CalmInfoArgs {
    /// GRACE model (kokkos.npz) or CALM artifact (gmm_artifacts.npz)
    #[arg(value_name = "MODEL_OR_ARTIFACT")]
    file: PathBuf,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The contents of a file.
#[derive(Debug, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
enum FileContent {
    Model(Box<Model>),
    Artifact(MixtureInfo),
}

#[derive(Debug, Serialize)]
struct Model {
    architecture: String,
    elements: Vec<Species>,
    /// Å
    cutoff: f64,
    /// Pairs of elements with their own cutoff.
    pair_cutoffs: Vec<PairCutoff>,
    lmax: usize,
    radial_basis_size: usize,
    channels: usize,
    basis_functions: Vec<String>,
    basis_dimension: usize,
    feature_dimension: usize,
    weights: usize,
    radial_tables: Vec<RadialTableInfo>,
    /// How a training made the model, as it says in `calmwalk_note`.
    training: Option<Value>,
    mixture: Option<MixtureInfo>,
}

#[derive(Debug, Serialize)]
struct PairCutoff {
    centre: Species,
    neighbour: Species,
    /// Å
    cutoff: f64,
}

#[derive(Debug, Serialize)]
struct RadialTableInfo {
    intervals: usize,
    /// The larger of the errors of values and derivatives, each relative to the largest value.
    error: f64,
}

#[derive(Debug, Serialize)]
struct MixtureInfo {
    schema: u32,
    elements: Vec<String>,
    feature_dimension: usize,
    basis_dimension: usize,
    projected_dimension: usize,
    normalised: bool,
    asinh: bool,
    density_channels: bool,
    threshold_mode: Option<String>,
    can_be_updated: bool,
    /// Components that cannot come from training data, and why.
    faults: Vec<String>,
    components: Vec<ComponentInfo>,
}

#[derive(Debug, Serialize)]
struct ComponentInfo {
    element: String,
    component: usize,
    /// Calibrated threshold θ of σ.
    threshold: f64,
    /// Number of atomic environments.
    count: Option<f64>,
    /// Sum of the weights of the environments.
    effective_count: Option<f64>,
    /// Condition number of the covariance matrix when the mixture was built.
    condition_number: Option<f64>,
    /// Rank of the covariance matrix then, without the regularisation.
    effective_rank: Option<u32>,
    /// Eigenvalues that its pseudo-inverse dropped.
    truncated: Option<u32>,
}

impl CalmInfoArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let content = inspect(&self.file)?;
        if self.json {
            print_json(&content)?;
        } else {
            print(|out| content.write(&self.file, out))?;
        }
        Ok(ExitStatus::Done)
    }
}

fn inspect(path: &Path) -> Result<FileContent, CommandError> {
    let archive = &NpzFile::open(path)
        .map_err(|error| CommandError::Input(format!("{error} (kokkos.npz or gmm_artifacts.npz)")))?;
    if archive.contains("__schema_version__") {
        let artifact = Artifact::load(path).map_err(CommandError::input)?;
        return Ok(FileContent::Artifact(MixtureInfo::new(&artifact, "__schema_version__", archive)));
    }
    if !archive.contains("element_names") {
        return Err(CommandError::Input(format!(
            "{}: neither a GRACE model (no array 'element_names') nor a CALM artifact (no array '__schema_version__')",
            path.display()
        )));
    }
    let model = GraceModel::load(path).map_err(CommandError::input)?;
    let mixture = match archive.contains("uq_centroids") {
        true => {
            let artifact = Artifact::load_export(path).map_err(CommandError::input)?;
            Some(MixtureInfo::new(&artifact, "uq_schema_version", archive))
        }
        false => None,
    };
    let note =
        archive.contains(NOTE).then(|| archive.strings(NOTE)).transpose().map_err(CommandError::input)?;
    let training = note.and_then(|texts| serde_json::from_str(texts.first()?).ok());
    Ok(FileContent::Model(Box::new(Model { training, ..Model::new(&model, mixture) })))
}

impl Model {
    fn new(model: &GraceModel, mixture: Option<MixtureInfo>) -> Self {
        let description = model.description().clone();
        let elements = &description.elements;
        let n = elements.len();
        let pairs = (0..n * n).map(|pair| (pair / n, pair % n)).filter(|_| description.pair_cutoffs);
        let pair_cutoffs = pairs.map(|(i, j)| PairCutoff {
            centre: elements[i],
            neighbour: elements[j],
            cutoff: model.pair_cutoff(i, j),
        });
        let tables = description.radial_tables.iter();
        Self {
            architecture: description.architecture.to_string(),
            elements: elements.clone(),
            cutoff: description.cutoff,
            pair_cutoffs: pair_cutoffs.collect(),
            lmax: description.lmax,
            radial_basis_size: description.radial_basis_size,
            channels: description.channels,
            basis_functions: description.basis_functions,
            basis_dimension: description.basis_dimension,
            feature_dimension: description.feature_dimension,
            weights: description.weights,
            radial_tables: tables
                .map(|(intervals, error)| RadialTableInfo {
                    intervals: *intervals,
                    error: error[0].max(error[1]),
                })
                .collect(),
            training: None,
            mixture,
        }
    }

    fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        let elements: Vec<_> = self.elements.iter().map(|species| species.symbol()).collect();
        line(out, "architecture", &self.architecture)?;
        line(out, "elements", elements.join(" "))?;
        line(out, "cutoff", format!("{} Å", self.cutoff))?;
        for PairCutoff { centre, neighbour, cutoff } in &self.pair_cutoffs {
            line(out, "", format!("{cutoff} Å for {centre}–{neighbour}"))?;
        }
        line(out, "angular momenta", format!("l ≤ {}", self.lmax))?;
        line(
            out,
            "radial channels",
            format!("{} from {} polynomials", self.channels, self.radial_basis_size),
        )?;
        let basis = self.basis_functions.join(", ");
        line(out, "invariants", format!("{} of {basis}", self.basis_dimension))?;
        line(out, "weights", self.weights)?;
        for RadialTableInfo { intervals, error } in &self.radial_tables {
            line(
                out,
                "radial table",
                format!("{intervals} intervals, relative error of values and derivatives below {error:.1e}"),
            )?;
        }
        if let Some(training) = &self.training {
            let text = |path: &str| {
                training.pointer(path).map_or_else(String::new, |value| match value {
                    Value::String(text) => text.clone(),
                    value => value.to_string(),
                })
            };
            let structures = text("/training/structures");
            line(out, "trained", format!("by {}, on {structures} structures", text("/program")))?;
            line(out, "", format!("from {} (BLAKE3 {})", text("/model/file"), text("/model/hash")))?;
        }
        match &self.mixture {
            Some(mixture) => mixture.write(out),
            None => line(out, "mixture", "none: no CALM arrays (uq_*); calmwalk calm build makes one"),
        }
    }
}

impl MixtureInfo {
    fn new(artifact: &Artifact, schema_key: &str, archive: &NpzFile) -> Self {
        let Artifact { symbols, mixture, projection } = artifact;
        Self {
            schema: archive.scalar(schema_key).unwrap_or_default() as u32,
            elements: symbols.clone(),
            feature_dimension: mixture.dimension(),
            basis_dimension: projection.rows,
            projected_dimension: projection.columns,
            normalised: projection.normalised,
            asinh: projection.asinh,
            density_channels: projection.density_channels,
            threshold_mode: text(archive, "threshold_mode"),
            can_be_updated: mixture.can_be_updated(),
            faults: artifact.unsound_components().iter().map(ToString::to_string).collect(),
            components: components(symbols, mixture, archive),
        }
    }

    fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        line(out, "CALM schema", self.schema)?;
        let sizes = (self.feature_dimension, self.projected_dimension, self.basis_dimension);
        line(
            out,
            "features",
            format!("{}, {} of them projected from {} invariants", sizes.0, sizes.1, sizes.2),
        )?;
        let flags = [
            (self.normalised, "normalised basis"),
            (self.asinh, "asinh"),
            (self.density_channels, "density channels"),
        ];
        let flags: Vec<_> = flags.into_iter().filter(|(set, _)| *set).map(|(_, name)| name).collect();
        line(out, "feature map", if flags.is_empty() { "linear".to_owned() } else { flags.join(", ") })?;
        if let Some(mode) = &self.threshold_mode {
            line(out, "thresholds", mode)?;
        }
        let updates = if self.can_be_updated { "yes" } else { "no: without scatter matrices" };
        line(out, "can be updated", updates)?;
        line(out, "components", format!("{} for {}", self.components.len(), self.elements.join(" ")))?;
        for fault in self.faults.iter().take(SHOWN) {
            line(out, "UNUSABLE", fault)?;
        }
        writeln!(out)?;
        let mut table = TextTable::new(&[
            "element",
            ">component",
            ">θ",
            ">environments",
            ">weighted",
            ">condition",
            ">rank",
            ">truncated",
        ]);
        let count = |count: Option<u32>| count.map_or("–".into(), |count| count.to_string());
        for component in self.components.iter().take(SHOWN) {
            table.push(vec![
                component.element.clone(),
                component.component.to_string(),
                format!("{:.4}", component.threshold),
                decimals(component.count, 0),
                decimals(component.effective_count, 1),
                component.condition_number.map_or("–".into(), |condition| format!("{condition:.1e}")),
                count(component.effective_rank),
                count(component.truncated),
            ]);
        }
        table.write(out)?;
        match self.components.len().saturating_sub(SHOWN) {
            0 => Ok(()),
            more => writeln!(out, "… and {more} more (use --json)"),
        }
    }
}

/// A single text, if the array exists and is readable.
fn text(archive: &NpzFile, key: &str) -> Option<String> {
    archive.strings(key).ok().filter(|texts| texts.len() == 1).map(|texts| texts.concat())
}

fn components(symbols: &[String], mixture: &Mixture, archive: &NpzFile) -> Vec<ComponentInfo> {
    // By element and slot; not in exports.
    let stored = |name: &str| -> Vec<Vec<f64>> {
        let of = |element| archive.numbers(&format!("{name}_{element}"));
        (0..symbols.len()).map(|element| of(element).map_or(Vec::new(), |numbers| numbers.data)).collect()
    };
    let [conditions, ranks, truncated] = ["cond_number", "effective_rank", "n_truncated"].map(stored);
    let component = |(element, slot, component): (usize, usize, &std::sync::Arc<calm::Component>)| {
        let of = |numbers: &[Vec<f64>]| numbers.get(element)?.get(slot).copied();
        ComponentInfo {
            element: symbols.get(element).cloned().unwrap_or_default(),
            component: slot,
            threshold: component.threshold(),
            count: component.statistics().map(|statistics| statistics.count),
            effective_count: component.statistics().map(|statistics| statistics.effective_count),
            condition_number: of(&conditions),
            effective_rank: of(&ranks).map(|rank| rank as u32),
            truncated: of(&truncated).map(|count| count as u32),
        }
    };
    mixture.iter().map(component).collect()
}

impl FileContent {
    fn write(&self, path: &Path, out: &mut dyn Write) -> io::Result<()> {
        let what = match self {
            Self::Model(_) => "a GRACE model",
            Self::Artifact(_) => "a CALM artifact",
        };
        writeln!(out, "{} is {what}", path.display())?;
        match self {
            Self::Model(model) => model.write(out),
            Self::Artifact(mixture) => mixture.write(out),
        }
    }
}

/// Prints a name and its value.
fn line(out: &mut dyn Write, name: &str, value: impl std::fmt::Display) -> io::Result<()> {
    writeln!(out, "  {name:<16}{value}")
}
