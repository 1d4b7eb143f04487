//! `calmwalk calm score`

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use atoms::extxyz::{Column, ColumnData, ExtxyzValue, Frame, write_frame};
use calm::{Artifact, NeighbourWeights};
use npyz::{NpyWriter, WriterBuilder};

use super::other_scores::{OtherScoreError, OtherScores};
use super::score_calibration::{self, ScoreCalibration};
use super::score_labels::ScoreLabels;
use super::score_list::ScoreList;
use super::scorer::Scorer;
use crate::artifact_checks::check_sound;
use crate::atomic_file::{AtomicFile, cannot_write, check_outputs, refuse_to_replace};
use crate::cli::{CommandError, ExitStatus};
use crate::feature_variant::FeatureModel;
use crate::left_out::LeftOutStructures;
use crate::loaded_model::LoadedModel;
use crate::output::{self, Bar, print};
use crate::structure_files::{FileLine, StructureReadingArgs, is_plain_extxyz};

/// Keys of labels in a frame.
const LABELS: [&str; 5] = ["energy", "free_energy", "forces", "stress", "virial"];

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

/// Grade structures: energy, forces, stress, and extrapolation grades of every atom
///
/// Writes every frame with the model's energy (eV), forces (eV/Å) and, for periodic cells, stress (eV/Å³, tension positive),
/// and per atom gamma (extrapolation grade γ), gamma_nbr (its neighbourhood average), sigma (Mahalanobis distance σ) and
/// component (nearest component of the atom's element, from 0). Leaves out structures that cannot be graded (atoms closer than 0.4 Å,
/// an element that the model does not have), with a warning. Refuses mixtures that cannot come from training data. With an artifact
/// of other features of the model (`calm build --feature-variant`), grades those features.
///
/// With --baseline, it also writes the scores of baselines (`calmwalk calm baseline`), such as llpr, each with its neighbourhood
/// average (llpr_nbr). With --ensemble, force_deviation is the norm of the standard deviation of the forces of all models (eV/Å).
///
/// Keeps all other data of the frame. Renames its energy, forces, stress and virial to REF_energy, REF_forces and so on, unless
/// it already has reference labels; then it replaces the plain ones, which come from another model.
///
/// Prints γ_max, the number of atoms with γ > 1 and the worst atom of each structure; of more than 20 structures those with the largest γ_max.
///
/// If frames have labels, also prints the errors of the model, and how well γ and γ_nbr of an atom predict large force errors:
/// Spearman's ρ, ROC-AUC, what γ ≤ 1 keeps, and quantiles by bins of γ, with intervals by bootstrap over structures.
#[derive(Debug, clap::Args)]
pub struct CalmScoreArgs {
    /// GRACE model (kokkos.npz)
    #[arg(long, value_name = "MODEL.npz")]
    model: PathBuf,
    /// CALM artifact (gmm_artifacts.npz) [default: mixture in the model file]
    #[arg(long, value_name = "CALM.npz")]
    artifact: Option<PathBuf>,
    /// Structures to grade: extended XYZ, POSCAR (.poscar, .vasp, POSCAR*, CONTCAR*) or text dumps of LAMMPS (.dump, .lammpstrj,
    /// dump.*), each also with .gz or .zst; files of other names are read as extended XYZ
    #[arg(value_name = "IN.extxyz")]
    input: PathBuf,
    #[command(flatten)]
    reading: StructureReadingArgs,
    /// File for the graded structures; an existing file is replaced once all are graded
    #[arg(long, short, value_name = "OUT.extxyz")]
    output: PathBuf,
    /// Also write gamma_gradient per atom: gradient of the sum of all γ, 1/Å
    #[arg(long)]
    gradient: bool,
    /// Also write the features z of all atoms to this file: array of shape [atoms, D] in the order of the input, float64
    #[arg(long, value_name = "FILE.npy")]
    features: Option<PathBuf>,
    /// Also write the scores of this file of baselines (`calmwalk calm baseline`); may be repeated
    #[arg(long, value_name = "BASELINES.npz")]
    baseline: Vec<PathBuf>,
    /// Also write the disagreement of the forces with those of this model, independently trained; may be repeated
    #[arg(long, value_name = "MODEL.npz")]
    ensemble: Vec<PathBuf>,
    /// Also write a neighbour average of γ with weights of your choice, as gamma_nbr_uniform and so on; may be repeated.
    /// cosine counts a neighbour by its distance, uniform counts each one fully; a radius in Å limits the neighbours within the
    /// model's cutoff, such as uniform:3.2
    #[arg(long, value_name = "WEIGHTS[:RADIUS]")]
    gamma_nbr: Vec<NeighbourWeights>,
    /// Also write the statistics of labelled structures to this file, for all thresholds of the force error
    #[arg(long, value_name = "FILE.json")]
    json: Option<PathBuf>,
    /// Also draw the statistics of labelled structures into this directory: force errors by grade and on either side of its
    /// limit, contamination and ROC-AUC by threshold of the force error, as SVG, PNG and CSV
    #[arg(long, value_name = "DIR")]
    figures: Option<PathBuf>,
    /// Also write a table with one row for each structure, for calm filter: line of the input, largest γ and γ_nbr, energy per
    /// atom of the model and of the label (eV), mean and largest force error (eV/Å)
    #[arg(long, value_name = "FILE.csv")]
    table: Option<PathBuf>,
    /// Also write force_error_bound (eV/Å) of each structure: 90 % of the force errors of its worst atom (largest gamma_nbr) are expected
    /// to be below it. calmwalk learns it from the labels of this campaign, or reads it from a file of `calmwalk force-errors
    /// --calibration`. Model and artifact must be those of a version of the campaign's potential
    #[arg(long, value_name = "DIR|FILE.json")]
    calibration: Option<PathBuf>,
    /// Print a line for every structure [default: the 20 with the largest γ_max]
    #[arg(long)]
    all: bool,
}

impl CalmScoreArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        self.check_outputs()?;
        let files = self.reading.single_file(&self.input)?;
        let (model, artifact) = load_any(&self.model, self.artifact.as_deref())?;
        let load_bounds =
            |path: &PathBuf| ScoreCalibration::load(path, &self.model, self.artifact.as_deref());
        let mut bounds = self.calibration.as_ref().map(load_bounds).transpose()?;
        let others = OtherScores::load(&self.model, &model, &self.baseline, &self.ensemble)?;
        let mut others = others.with_averages(&self.gamma_nbr);
        let dimension = artifact.mixture.dimension();
        let mut scorer = Scorer::new(&model, Arc::new(artifact.mixture));
        let bytes = Arc::new(AtomicU64::new(0));
        let mut frames = files.reader(Arc::clone(&bytes));
        // A pipe has no length.
        let bar = Bar::new(Some(files.total_bytes()?).filter(|length| *length > 0), BAR);
        let mut output = AtomicFile::create(&self.output)?;
        let cannot = |error| cannot_write(self.features.as_deref().unwrap_or(Path::new("")), error);
        let mut feature_file = self.features.as_deref().map(AtomicFile::create).transpose()?;
        let matrix = feature_file.as_mut().map(|file| feature_matrix(file, dimension));
        let mut matrix = matrix.transpose().map_err(cannot)?;
        let mut labels = ScoreLabels::new(others.score_columns(), self.table.as_deref(), bounds.is_some())?;
        let (mut count, mut left_out) = (0_u64, LeftOutStructures::default());
        let mut list = ScoreList::new(self.all);
        while let Some((mut frame, _)) = frames.next()? {
            let line = frame.line;
            let graded = scorer.score(&frame.structure, self.gradient).map_err(OtherScoreError::from);
            let columns = match graded.and_then(|()| others.columns(&frame.structure, &scorer)) {
                Ok(columns) => columns,
                Err(error) if error.is_of_structure() => {
                    left_out.add(self.place(line), error);
                    continue;
                }
                Err(error) => return Err(self.at(line, error)),
            };
            let bound = bounds.as_mut().and_then(|bounds| bounds.bound(&frame.structure, &scorer.gamma_nbr));
            list.add(&frame, &scorer);
            labels.add(&frame, &scorer, &columns, bound)?;
            write_scores(&mut frame, &scorer, self.gradient);
            if let Some(bound) = bound {
                frame.info.insert(score_calibration::COLUMN.into(), bound.into());
            }
            for (name, values) in columns {
                frame.arrays.insert(name, scalars(&values));
            }
            write_frame(&mut output, &frame).map_err(|error| self.at(line, error))?;
            if let Some(matrix) = &mut matrix {
                matrix.extend(scorer.features().iter().copied()).map_err(cannot)?;
            }
            count += 1;
            bar.set(bytes.load(Ordering::Relaxed), || output::count(count, "frame"));
        }
        drop(bar);
        self.warn(&left_out, frames.left_out(), count)?;
        matrix.map_or(Ok(()), NpyWriter::finish).map_err(cannot)?;
        feature_file.map_or(Ok(()), AtomicFile::finish)?;
        output.finish()?;
        print(|out| {
            writeln!(
                out,
                "wrote {} with grades to {}",
                output::count(count, "structure"),
                self.output.display()
            )
        })?;
        print(|out| list.write(out))?;
        if let Some(bounds) = &bounds {
            print(|out| writeln!(out, "{}", bounds.note()))?;
        }
        labels.finish(self.json.as_deref(), self.figures.as_deref(), &self.input)?;
        Ok(ExitStatus::Done)
    }

    /// No output may replace a file that is read, or another output; the graded structures may replace the input.
    fn check_outputs(&self) -> Result<(), CommandError> {
        let artifact = self.artifact.iter().map(|path| (path, "the artifact"));
        let baselines = self.baseline.iter().map(|path| (path, "a file of baselines"));
        let ensemble = self.ensemble.iter().map(|path| (path, "a model of the ensemble"));
        let calibration = self.calibration.iter().map(|path| (path, "the calibration"));
        let others = artifact.chain(baselines).chain(ensemble).chain(calibration);
        let inputs = std::iter::once((&self.model, "the model")).chain(others);
        let inputs: Vec<_> = inputs.map(|(path, what)| (path.as_path(), what)).collect();
        let further = || self.features.iter().chain(&self.json).chain(&self.table).map(PathBuf::as_path);
        check_outputs(std::iter::once(self.output.as_path()).chain(further()), &inputs)?;
        let input = (self.input.as_path(), "the input");
        further().try_for_each(|output| refuse_to_replace(output, [input]))?;
        if is_plain_extxyz(&self.input) { Ok(()) } else { refuse_to_replace(&self.output, [input]) }
    }

    /// Warns of structures that cannot be graded. Refuses an output that would replace the input if these, or others that do not match the filter,
    /// would be lost.
    fn warn(&self, left_out: &LeftOutStructures, filtered: u64, kept: u64) -> Result<(), CommandError> {
        left_out.warn(kept)?;
        if left_out.count() + filtered == 0 {
            return Ok(());
        }
        refuse_to_replace(
            &self.output,
            [(self.input.as_path(), "the input, which has structures that were left out")],
        )
    }

    fn place(&self, line: usize) -> FileLine {
        FileLine { file: self.input.as_path().into(), line }
    }

    fn at(&self, line: usize, error: impl std::fmt::Display) -> CommandError {
        self.place(line).wrong(error)
    }
}

/// The model with the features of the artifact, and the mixture that grades them.
pub(in crate::cli) fn load(
    export: &Path,
    artifact: Option<&Path>,
) -> Result<(FeatureModel, Artifact), CommandError> {
    let (features, found) = load_any(export, artifact)?;
    if let Some(path) = artifact.filter(|_| features.is_hidden()) {
        return Err(CommandError::Input(format!(
            "{}: grades the hidden layer; expected features of the basis here (calm score and --compare-artifact of calm validate take \
             both)",
            path.display()
        )));
    }
    Ok((features, found))
}

/// The same, also with the hidden layer as features.
pub(super) fn load_any(
    export: &Path,
    artifact: Option<&Path>,
) -> Result<(FeatureModel, Artifact), CommandError> {
    let Some(path) = artifact else {
        let model = FeatureModel::load(export, None)?;
        let own = Artifact::load_export(export).map_err(CommandError::input)?;
        check_sound(&own, export).map_err(CommandError::Input)?;
        return Ok((model, own));
    };
    let model = LoadedModel::load(export)?;
    let artifact = Artifact::load(path).map_err(CommandError::input)?;
    let model = FeatureModel::for_artifact(export, model, &artifact.projection)?;
    model
        .check_artifact(&artifact)
        .map_err(|error| CommandError::Input(format!("{}: {error}", path.display())))?;
    check_sound(&artifact, path).map_err(CommandError::Input)?;
    Ok((model, artifact))
}

/// Adds the results to the frame, after moving its own labels.
fn write_scores(frame: &mut Frame, scorer: &Scorer, gradient: bool) {
    move_labels_to_reference(frame);
    let evaluation = &scorer.evaluation;
    frame.info.insert("energy".into(), evaluation.energy().into());
    if let Some(stress) = evaluation.stress(&frame.structure) {
        frame.info.insert("stress".into(), stress.into());
    }
    let component = scorer.grades.component.iter().map(|slot| *slot as i64).collect();
    let mut insert = |name: &str, column| frame.arrays.insert(name.to_owned(), column);
    insert("forces", Column::vectors(&evaluation.forces));
    insert("gamma", scalars(&scorer.grades.gamma));
    insert("gamma_nbr", scalars(&scorer.gamma_nbr));
    insert("sigma", scalars(&scorer.grades.sigma));
    insert("component", Column { width: 1, entries: ColumnData::Int(component) });
    if gradient {
        insert("gamma_gradient", Column::vectors(&scorer.pull_back.gradient));
    }
}

fn scalars(values: &[f64]) -> Column {
    Column { width: 1, entries: ColumnData::Real(values.to_vec()) }
}

/// Renames the plain labels to `REF_…`, or removes them if the frame has reference labels.
fn move_labels_to_reference(frame: &mut Frame) {
    let reference = LABELS.map(|label| format!("REF_{label}"));
    let kept = reference.iter().any(|key| frame.info.contains_key(key) || frame.arrays.contains_key(key));
    for (label, reference) in LABELS.into_iter().zip(reference) {
        let (info, array) = (frame.info.remove(label), frame.arrays.remove(label));
        if kept {
            continue;
        }
        if let Some(column) = array {
            frame.arrays.insert(reference.clone(), column);
        }
        if let Some(value) = info {
            // MACE reads REF_stress as nine numbers in a row.
            let flat = value.numbers().filter(|numbers| numbers.len() > 1).map(ExtxyzValue::from);
            frame.info.insert(reference, flat.unwrap_or(value));
        }
    }
}

/// Starts the array of features in NumPy's format; the number of rows is written at the end.
fn feature_matrix(file: &mut AtomicFile, dimension: usize) -> io::Result<NpyWriter<f64, &mut AtomicFile>> {
    npyz::WriteOptions::new().default_dtype().writer(file).begin_2d(dimension as u64)
}
