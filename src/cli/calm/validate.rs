//! `calmwalk calm validate`

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::Species;
use atoms::prototypes::Prototype;
use calm::{Mixture, NeighbourWeights};
use md::Fire;
use tokio_util::sync::CancellationToken;

use super::other_scores::OtherScores;
use super::score::{load, load_any};
use super::validate_labels::{self, LabelledComparison, NamedMixture};
use crate::atomic_file::refuse_to_replace;
use crate::calm_validation::labelled::LabelledSet;
use crate::calm_validation::{
    self, AtomScore, EnergySpread, FeaturePlanes, LabelledResults, MixtureScore, PAGE, Subject,
    TrainingCompositions, Validation, ValidationProgress, ValidationSettings, both, labelled, verdict,
};
use crate::cli::{CommandError, ExitStatus};
use crate::feature_variant::FeatureModel;
use crate::loaded_model::LoadedModel;
use crate::output::{self, Bar, TextTable, decimals, print, print_stderr};
use crate::page::{create_directory, write_files};
use crate::signals::stop_token;
use crate::structure_files::StructureReadingArgs;

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

/// Metals up to which all pairs are mixed by default.
const MIXED: usize = 4;

/// Test whether the extrapolation grade of a model can be trusted, with and without labels
///
/// Run it after calm build, before you rely on γ in a campaign. It tests
///
/// - bond scans of the elements' crystals from compression to stretching, the paper's minimal test;
///
/// - grades at vacancies, surfaces and grain boundaries, and of random solid solutions against composition;
///
/// - whether different environments have the same features;
///
/// - with --labelled, how well the grade ranks the force errors of labelled structures, as calm score does.
///
/// Writes a self-contained HTML page, each figure as SVG, PNG and CSV, each table as CSV, all results as JSON, and the graded
/// structures. The same input gives the same bytes. docs/calm-validation.md explains the tests.
///
/// (calmwalk validate checks the configuration of a campaign.)
#[derive(Debug, clap::Args)]
pub struct CalmValidateArgs {
    /// GRACE model (kokkos.npz)
    #[arg(long, value_name = "MODEL.npz")]
    model: PathBuf,
    /// CALM artifact (gmm_artifacts.npz) [default: mixture in the model file]
    #[arg(long, value_name = "CALM.npz")]
    artifact: Option<PathBuf>,
    /// Also test the scores of this file of baselines (`calmwalk calm baseline`); may be repeated
    #[arg(long, value_name = "BASELINES.npz")]
    baseline: Vec<PathBuf>,
    /// Another model of the same elements, trained independently; may be repeated. The spread of the energies of all models is compared
    /// with γ
    #[arg(long, value_name = "MODEL.npz")]
    ensemble: Vec<PathBuf>,
    /// Structures with labels, extended XYZ, also packed (.gz, .zst). The page also shows how well γ, γ_nbr and the other scores of an atom predict large force
    /// errors. Several files are several sets, each with a section of its own, and a table with all of them
    #[arg(long, value_name = "LABELLED.extxyz", num_args = 1..)]
    labelled: Vec<PathBuf>,
    /// Training data of the model, in any format of `calm build`; several files are allowed. The solid solutions are drawn with the compositions and first
    /// shells of these structures, and the errors by composition with the errors of the model on them
    #[arg(long, value_name = "TRAINING.extxyz", num_args = 1..)]
    training: Vec<PathBuf>,
    #[command(flatten)]
    reading: StructureReadingArgs,
    /// Another model with a mixture in its file; may be repeated. Its force errors on the labelled structures are drawn by its own γ_nbr
    /// below those of the model
    #[arg(long, value_name = "MODEL.npz", requires = "labelled")]
    compare_model: Vec<PathBuf>,
    /// Also judge γ averaged with these weights over the neighbours of the labelled structures, as calm score --gamma-nbr does; may be
    /// repeated
    #[arg(long, value_name = "WEIGHTS[:RADIUS]", requires = "labelled")]
    gamma_nbr: Vec<NeighbourWeights>,
    /// Another mixture of the model, such as one of other features or with more components; may be repeated. Its γ is a score beside γ.
    /// With --labelled, a table and a figure also compare what γ up to 1 keeps of the labelled structures under each mixture
    #[arg(long, value_name = "CALM.npz")]
    compare_artifact: Vec<PathBuf>,
    /// Directory for the files, created if it does not exist; files of an earlier validation are replaced
    #[arg(long, short, value_name = "DIR")]
    output: PathBuf,
    /// Elements whose crystals and defects are tested [default: all of the model]
    #[arg(long, value_name = "SYMBOL,…", value_delimiter = ',')]
    elements: Vec<Species>,
    /// Pairs of elements whose solid solutions are tested, such as Mo-W [default: all pairs of the tested metals if there are at most 4]
    #[arg(long, value_name = "A-B,…", value_delimiter = ',', value_parser = pair)]
    pairs: Vec<[Species; 2]>,
    /// Distances of each bond scan
    #[arg(long, value_name = "N", default_value = "80")]
    scan_steps: NonZeroUsize,
    /// Random structures of each composition of a solid solution
    #[arg(long, value_name = "N", default_value = "10")]
    solution_structures: NonZeroUsize,
    /// Keep the ideal positions at defects instead of relaxing them at fixed cell (FIRE, to 0.01 eV/Å)
    #[arg(long)]
    no_relax: bool,
    /// Evaluations of the features in each search for two environments with the same features, for up to six elements; 0 leaves these
    /// searches out
    #[arg(long, value_name = "N", default_value = "1000")]
    collision_evaluations: usize,
    /// Random seed of the solid solutions and of the searched environments
    #[arg(long, value_name = "N", default_value = "42")]
    rng_seed: u64,
}

impl CalmValidateArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let (features, artifact) = load(&self.model, self.artifact.as_deref())?;
        let (model, mixture) = (features.model.clone(), Arc::new(artifact.mixture));
        let settings = self.settings(&model)?;
        let spread = self.ensemble(&model)?;
        let mut compared = self.compared(&features)?;
        let mixtures = self.mixtures(&features, &mixture)?;
        let models = self.models()?;
        let further = mixture_scores(&features, mixtures.get(1..).unwrap_or_default());
        let others = further.into_iter().chain(compared.baselines()).chain(spread).collect();
        // Fail before the long computation.
        create_directory(&self.output)?;
        let stop = stop_token()?;
        let own = NamedMixture { file: self.model.clone(), features, mixture: mixture.clone() };
        let planes = FeaturePlanes::new(&mixture, model.elements(), &settings.elements);
        let comparison = LabelledComparison { mixtures: &mixtures, models: &models };
        let Some(labelled) = self.labelled(&own, &mut compared, &comparison, planes, &settings, &stop)?
        else {
            return Ok(stopped());
        };
        let progress = ValidationProgress::new(Bar::new(Some(1), BAR), stop);
        let subject = Subject { model, mixture, others };
        let Some(validation) = calm_validation::run(&subject, settings, labelled, &progress)? else {
            return Ok(stopped());
        };
        drop(progress);
        let files = calm_validation::files(&validation)?;
        write_files(&self.output, &files)?;
        print(|out| {
            bond_scans(&validation).write(out)?;
            writeln!(out)?;
            defects(&validation).write(out)?;
            for LabelledSet { file, report, mixtures, .. } in &validation.labelled {
                writeln!(out, "\n{file}")?;
                labelled::write(report, out)?;
                labelled::write_table(&labelled::mixtures_table(mixtures, report), out)?;
            }
            labelled::write_table(&labelled::sets_table(&validation.labelled), out)?;
            let page = self.output.join(PAGE);
            let others = output::count(files.len() - 1, "file");
            writeln!(out, "\nwrote {} and {others} in the same directory", page.display())
        })?;
        Ok(ExitStatus::Done)
    }

    /// The baselines, and what else labelled structures are scored by beside γ and γ_nbr. The output must not replace these structures.
    fn compared(&self, features: &FeatureModel) -> Result<OtherScores, CommandError> {
        let labelled = self.labelled.iter().map(|path| (path.as_path(), "a file of labelled structures"));
        let training = self.training.iter().map(|path| (path.as_path(), "a file of training data"));
        let inputs: Vec<_> = labelled.chain(training).collect();
        for written in ["structures.extxyz", "collisions.extxyz"] {
            refuse_to_replace(&self.output.join(written), inputs.iter().copied())?;
        }
        let ensemble: &[PathBuf] = if self.labelled.is_empty() { &[] } else { &self.ensemble };
        let others = OtherScores::load(&self.model, features, &self.baseline, ensemble)?;
        Ok(others.with_averages(&self.gamma_nbr))
    }

    /// The mixtures to compare, that of γ first, with their files and features; none without `--compare-artifact`.
    fn mixtures(
        &self,
        own: &FeatureModel,
        mixture: &Arc<Mixture>,
    ) -> Result<Vec<NamedMixture>, CommandError> {
        if self.compare_artifact.is_empty() {
            return Ok(Vec::new());
        }
        let file = self.artifact.as_ref().unwrap_or(&self.model).clone();
        let mut mixtures = vec![NamedMixture { file, features: own.clone(), mixture: mixture.clone() }];
        for path in &self.compare_artifact {
            let (features, artifact) = load_any(&self.model, Some(path))?;
            let mixture = Arc::new(artifact.mixture);
            mixtures.push(NamedMixture { file: path.clone(), features, mixture });
        }
        Ok(mixtures)
    }

    /// The further models for labelled structures, each with the mixture in its file.
    fn models(&self) -> Result<Vec<NamedMixture>, CommandError> {
        let named = |path: &PathBuf| {
            let (features, artifact) = load(path, None)?;
            Ok(NamedMixture { file: path.clone(), features, mixture: Arc::new(artifact.mixture) })
        };
        self.compare_model.iter().map(named).collect()
    }

    /// What labelled structures and training data say. `None` if it was stopped.
    fn labelled(
        &self,
        own: &NamedMixture,
        others: &mut OtherScores,
        comparison: &LabelledComparison<'_>,
        mut planes: FeaturePlanes,
        settings: &ValidationSettings,
        stop: &CancellationToken,
    ) -> Result<Option<LabelledResults>, CommandError> {
        let read = |paths: &[PathBuf]| -> Result<Vec<_>, _> {
            paths.iter().map(|path| self.reading.single_file(path)).collect()
        };
        let (labelled, data) = (read(&self.labelled)?, read(&self.training)?);
        let (mut sets, mut training) = (Vec::new(), None);
        for input in &labelled {
            let mut scorer = own.scorer();
            let scores = (&mut scorer, &mut *others);
            let Some(set) = validate_labels::set(input, scores, comparison, &mut planes, stop)? else {
                return Ok(None);
            };
            sets.push(set);
        }
        if !data.is_empty() {
            let empty = TrainingCompositions::new(&settings.pairs);
            training = validate_labels::training(&data, &mut own.scorer(), empty, stop)?;
            if training.is_none() {
                return Ok(None);
            }
        }
        Ok(Some(LabelledResults { sets, training, planes }))
    }

    /// The spread of the energies, if there are further models.
    fn ensemble(&self, model: &LoadedModel) -> Result<Option<Box<dyn AtomScore>>, CommandError> {
        let mut models = vec![model.shared()];
        for path in &self.ensemble {
            let other = LoadedModel::load(path)?;
            if let Some(missing) = model.elements().iter().find(|species| !other.elements().contains(species))
            {
                let message = format!("{}: does not support {missing}, as the model does", path.display());
                return Err(CommandError::Input(message));
            }
            models.push(other.shared());
        }
        Ok((models.len() > 1).then(|| Box::new(EnergySpread::new(models)) as Box<dyn AtomScore>))
    }

    fn settings(&self, model: &LoadedModel) -> Result<ValidationSettings, CommandError> {
        let known = model.elements();
        let names = || known.iter().map(|species| species.symbol()).collect::<Vec<_>>().join(", ");
        for species in self.elements.iter().chain(self.pairs.iter().flatten()) {
            if !known.contains(species) {
                let message = format!("the model does not support {species}; expected some of {}", names());
                return Err(CommandError::Input(message));
            }
        }
        if self.scan_steps.get() < 2 {
            return Err(CommandError::Input("--scan-steps 1: expected at least 2".into()));
        }
        let mut elements = if self.elements.is_empty() { known.to_vec() } else { self.elements.clone() };
        let pairs = if self.pairs.is_empty() { all_pairs(&elements) } else { self.pairs.clone() };
        // Solid solutions need the equilibrium distances of their elements.
        for species in pairs.iter().flatten() {
            if !elements.contains(species) {
                elements.push(*species);
            }
        }
        Ok(ValidationSettings {
            elements,
            pairs,
            scan_steps: self.scan_steps.get(),
            relaxation: (!self.no_relax).then(Fire::default),
            solution_structures: self.solution_structures.get(),
            // They need the readout of the model.
            collision_evaluations: if model.grace().is_some() { self.collision_evaluations } else { 0 },
            seed: self.rng_seed,
        })
    }
}

/// γ under each of these mixtures as a score with the name of its file. `graded` has the features that γ grades.
fn mixture_scores(graded: &FeatureModel, mixtures: &[NamedMixture]) -> Vec<Box<dyn AtomScore>> {
    let stem = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let score = |NamedMixture { file: path, features, mixture }: &NamedMixture| {
        let is_only = mixtures.iter().filter(|other| stem(&other.file) == stem(path)).count() == 1;
        let name = if is_only { stem(path) } else { path.display().to_string() };
        let own = (features.projection() != graded.projection()).then(|| features.clone());
        Box::new(MixtureScore::new(format!("γ ({name})"), mixture.clone(), own)) as Box<dyn AtomScore>
    };
    mixtures.iter().map(score).collect()
}

fn stopped() -> ExitStatus {
    print_stderr("stopped; nothing was written");
    ExitStatus::Interrupted
}

/// All pairs of the metals among the elements, if there are few.
fn all_pairs(elements: &[Species]) -> Vec<[Species; 2]> {
    const NOBLE: [u8; 5] = [2, 10, 18, 36, 54];
    let is_metal = |species: &&Species| {
        let found = species.ground_state();
        let is_close_packed =
            matches!(found.prototype, Prototype::Fcc | Prototype::Bcc | Prototype::Hcp { .. });
        found.is_own && is_close_packed && !NOBLE.contains(&species.atomic_number())
    };
    let metals: Vec<_> = elements.iter().filter(is_metal).copied().collect();
    if metals.len() > MIXED {
        return Vec::new();
    }
    let others = |k: usize| metals[k + 1..].iter().copied();
    metals.iter().enumerate().flat_map(|(k, first)| others(k).map(|second| [*first, second])).collect()
}

fn pair(text: &str) -> Result<[Species; 2], String> {
    let (first, second) = text.split_once('-').ok_or("expected two elements, such as Mo-W")?;
    let parse = |symbol: &str| symbol.parse::<Species>().map_err(|error| error.to_string());
    let pair = [parse(first)?, parse(second)?];
    if pair[0] == pair[1] { Err("expected two different elements".into()) } else { Ok(pair) }
}

fn bond_scans(validation: &Validation) -> TextTable {
    let mut table = TextTable::new(&[
        "element",
        "crystal",
        ">d_eq (Å)",
        "score",
        "compression/stretching",
        "equilibrium inside",
        ">compressed",
        ">at d_eq",
        ">stretched",
    ]);
    let scans = validation.bond_scans.iter().filter(|scan| scan.is_ground_state);
    let rows = scans.flat_map(|scan| {
        let names = [scan.element.clone(), scan.prototype.clone(), format!("{:.3}", scan.equilibrium)];
        validation.scores.iter().zip(&scan.detection).map(move |(score, found)| (names.clone(), score, found))
    });
    let all = ["all", "", ""].map(str::to_owned);
    let totals = validation.scores.iter().map(|score| (all.clone(), score, &score.detection));
    for (names, score, found) in rows.chain(totals) {
        let mut row = names.to_vec();
        row.extend([score.name.clone(), both(found), verdict(found.interpolation).to_owned()]);
        let values = [found.largest_in_compression, found.at_equilibrium, found.largest_in_stretching];
        row.extend(values.map(|value| decimals(value, 2)));
        table.push(row);
    }
    table
}

fn defects(validation: &Validation) -> TextTable {
    let mut table = TextTable::new(&["element", "defect", ">crystal γ", ">γ next to it", ">γ far away"]);
    for defect in &validation.defects {
        let gamma = |of: Option<&f64>| decimals(of.copied(), 2);
        let near = defect.shells.first().and_then(|shell| shell.scores.first());
        let far = defect.shells.last().and_then(|shell| shell.scores.first());
        table.push(vec![
            defect.element.clone(),
            format!("{} {}", defect.prototype, defect.name),
            gamma(defect.crystal.first()),
            gamma(near),
            gamma(far),
        ]);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metals_are_mixed_with_each_other() {
        let mixed = |symbols: &[&str]| {
            let elements: Vec<_> = symbols.iter().map(|symbol| symbol.parse().unwrap()).collect();
            all_pairs(&elements).len()
        };
        assert_eq!((mixed(&["Al"]), mixed(&["Ni", "Al", "H"]), mixed(&["Si", "Ge"])), (0, 1, 0));
        assert_eq!((mixed(&["Mo", "Nb", "Ta", "W"]), mixed(&["Mo", "Nb", "Ta", "W", "Ti"])), (6, 0));
        assert!(pair("Mo-W").is_ok());
        assert_eq!(pair("Mo-Mo").unwrap_err(), "expected two different elements");
        assert!(pair("MoW").is_err() && pair("Mo-Xx").unwrap_err().contains("Xx"));
    }
}
