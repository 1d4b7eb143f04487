//! `calmwalk calm baseline`

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use calm::baselines::{Baseline, BaselineFile, BaselineKind, BaselineSettings, Builder};
use calm::{Artifact, Mixture};
use tokio_util::sync::CancellationToken;

use crate::artifact_checks::check_sound;
use crate::atomic_file::{AtomicFile, cannot_write, refuse_to_replace};
use crate::cli::{CommandError, ExitStatus};
use crate::feature_variant::{FeatureModel, FeatureVariant};
use crate::features::FeatureCalculator;
use crate::loaded_model::LoadedModel;
use crate::output::{self, Bar, TextTable, print, print_stderr};
use crate::signals::stop_token;
use crate::structure_files::{FileLine, StructureArgs, StructureFiles};

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

/// Build scores to compare γ with: D-optimality, LLPR, distances, likelihood
///
/// Reads all structures once; for D-optimality, repeatedly until its active sets no longer change. Memory does not depend on the amount of
/// data. `calmwalk calm score --baseline` writes the scores of atoms; larger scores are further from the training data.
///
/// Components (d-optimality-centred, d-optimality-component, euclidean, likelihood) are those of the artifact, or of the mixture in
/// the model file; likelihood needs an artifact.
#[derive(Debug, clap::Args)]
pub struct CalmBaselineArgs {
    /// GRACE model (kokkos.npz)
    #[arg(long, value_name = "MODEL.npz")]
    model: PathBuf,
    /// CALM artifact (gmm_artifacts.npz) with the components [default: mixture in the model file]
    #[arg(long, value_name = "CALM.npz")]
    artifact: Option<PathBuf>,
    /// Features to score [default: those of the artifact, or of the model file]
    #[arg(long, value_name = "VARIANT")]
    feature_variant: Option<FeatureVariant>,
    #[command(flatten)]
    data: StructureArgs,
    /// Kind of score, may be repeated: d-optimality-element, d-optimality-centred, d-optimality-component, llpr, llpr-sum,
    /// llpr-forces, euclidean, k-nearest, likelihood
    #[arg(long, required = true, value_name = "KIND", value_delimiter = ',')]
    kind: Vec<BaselineKind>,
    /// File for the scores; an existing file is replaced at the end
    #[arg(long, short, value_name = "BASELINES.npz")]
    output: PathBuf,
    #[command(flatten)]
    settings: BaselineSettingsArgs,
}

#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Settings")]
struct BaselineSettingsArgs {
    /// D-optimality: how much the score of a training atom may exceed 1
    #[arg(long, value_name = "X", default_value_t = BaselineSettings::default().tolerance)]
    tolerance: f64,
    /// D-optimality: maximum number of sweeps over the data
    #[arg(long, value_name = "N", default_value_t = BaselineSettings::default().max_sweeps)]
    max_sweeps: usize,
    /// D-optimality: leave out directions in which no training atom reaches this far, relative to the largest norm of features
    #[arg(long, value_name = "X", default_value_t = BaselineSettings::default().rank_tolerance)]
    rank_tolerance: f64,
    /// LLPR: η in λ = η tr G / D
    #[arg(long, value_name = "ETA", default_value_t = BaselineSettings::default().regularisation)]
    regularisation: f64,
    /// llpr-forces: weight of a force component relative to a structure's energy, Å²
    #[arg(long, value_name = "W", default_value_t = BaselineSettings::default().force_weight)]
    force_weight: f64,
    /// k-nearest: k
    #[arg(long, value_name = "K", default_value_t = BaselineSettings::default().neighbours)]
    neighbours: usize,
    /// k-nearest: training atoms of each element that are kept, a random sample
    #[arg(long, value_name = "N", default_value_t = BaselineSettings::default().sample)]
    sample: usize,
    /// k-nearest: random seed of the sample
    #[arg(long, value_name = "N", default_value_t = BaselineSettings::default().seed)]
    rng_seed: u64,
}

impl BaselineSettingsArgs {
    fn get(&self) -> BaselineSettings {
        BaselineSettings {
            tolerance: self.tolerance,
            max_sweeps: self.max_sweeps,
            rank_tolerance: self.rank_tolerance,
            regularisation: self.regularisation,
            force_weight: self.force_weight,
            neighbours: self.neighbours,
            sample: self.sample,
            seed: self.rng_seed,
        }
    }
}

impl CalmBaselineArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let files = self.data.files()?;
        self.protect_inputs(&files)?;
        let (features, artifact) = self.load()?;
        let settings = self.settings.get();
        let mixture = artifact.as_ref().map(|artifact| &artifact.mixture);
        let mut builders = self.builders(&features, &settings, mixture)?;
        let mut calculator = features.calculator();
        let (stop, mut sweep) = (stop_token()?, 0);
        while builders.iter().any(Builder::needs_sweep) {
            sweep += 1;
            if !read(&files, &mut calculator, &mut builders, sweep, &stop)? {
                print_stderr("stopped; nothing was written");
                return Ok(ExitStatus::Interrupted);
            }
            for builder in builders.iter_mut().filter(|builder| builder.needs_sweep()) {
                builder.end_sweep();
            }
        }
        let finished = builders.into_iter().map(Builder::finish).collect::<Result<_, _>>();
        let baselines = finished.map_err(CommandError::input)?;
        let file = BaselineFile { origin: features.origin(&self.model)?, settings, baselines };
        let mut output = AtomicFile::create(&self.output)?;
        file.write(&mut output).map_err(|error| cannot_write(&self.output, error))?;
        output.finish()?;
        report(&file, &self.output)?;
        Ok(ExitStatus::Done)
    }

    fn protect_inputs(&self, files: &StructureFiles) -> Result<(), CommandError> {
        let data = files.paths().map(|path| (path, "a file of training data"));
        let model = std::iter::once((self.model.as_path(), "the model"));
        let artifact = self.artifact.iter().map(|path| (path.as_path(), "the artifact"));
        refuse_to_replace(&self.output, model.chain(artifact).chain(data))?;
        // An error in the path is found before the data are read.
        AtomicFile::create(&self.output).map(drop)
    }

    /// The features, and the mixture over them if there is one.
    fn load(&self) -> Result<(FeatureModel, Option<Artifact>), CommandError> {
        let Some(path) = &self.artifact else {
            let features = FeatureModel::load(&self.model, self.feature_variant)?;
            let projection =
                features.projection().filter(|_| self.kind.iter().any(|kind| kind.needs_mixture()));
            let Some(projection) = projection else { return Ok((features, None)) };
            let own = Artifact::load_export(&self.model).map_err(CommandError::input)?;
            check_sound(&own, &self.model).map_err(CommandError::Input)?;
            let fits = own.projection.check_same(&projection).is_ok();
            return Ok((features, fits.then_some(own)));
        };
        let artifact = Artifact::load(path).map_err(CommandError::input)?;
        let features = match self.feature_variant {
            Some(_) => FeatureModel::load(&self.model, self.feature_variant)?,
            None => {
                let model = LoadedModel::load(&self.model)?;
                FeatureModel::for_artifact(&self.model, model, &artifact.projection)?
            }
        };
        features
            .check_artifact(&artifact)
            .map_err(|error| CommandError::Input(format!("{}: {error}", path.display())))?;
        check_sound(&artifact, path).map_err(CommandError::Input)?;
        Ok((features, Some(artifact)))
    }

    fn builders(
        &self,
        features: &FeatureModel,
        settings: &BaselineSettings,
        mixture: Option<&Mixture>,
    ) -> Result<Vec<Builder>, CommandError> {
        let elements = features.symbols().len();
        let mut builders = Vec::new();
        for (number, kind) in self.kind.iter().enumerate() {
            if self.kind[..number].contains(kind) {
                return Err(CommandError::Input(format!("--kind {kind}: given twice")));
            }
            let builder = Builder::new(*kind, settings, features.dimension(), elements, mixture);
            builders.push(builder.map_err(|error| {
                let hint = if mixture.is_none() { " (--artifact)" } else { "" };
                CommandError::Input(format!("--kind {kind}: {error}{hint}"))
            })?);
        }
        Ok(builders)
    }
}

/// One sweep over all structures; false if it was stopped.
fn read(
    files: &StructureFiles,
    calculator: &mut FeatureCalculator,
    builders: &mut [Builder],
    sweep: usize,
    stop: &CancellationToken,
) -> Result<bool, CommandError> {
    let bytes = Arc::new(AtomicU64::new(0));
    let bar = Bar::new(Some(files.total_bytes()?), BAR);
    let mut structures = files.reader(Arc::clone(&bytes));
    let mut count = 0_u64;
    while let Some((frame, file)) = structures.next()? {
        if stop.is_cancelled() {
            return Ok(false);
        }
        let position = FileLine { file: file.path, line: frame.line };
        let elements = calculator.compute(&frame.structure).map_err(|error| position.wrong(error))?;
        let needs_forces =
            builders.iter().any(|builder| builder.needs_sweep() && builder.kind().has_force_form());
        let rows = if needs_forces {
            calculator.force_rows().map_err(|error| position.wrong(error))?
        } else {
            Vec::new()
        };
        for builder in builders.iter_mut().filter(|builder| builder.needs_sweep()) {
            builder.add(&elements, calculator.features()).map_err(|error| position.wrong(error))?;
            builder.add_forces(&rows).map_err(|error| position.wrong(error))?;
        }
        count += 1;
        bar.set(bytes.load(Ordering::Relaxed), || {
            format!("sweep {sweep}, {}", output::count(count, "structure"))
        });
    }
    Ok(true)
}

/// A table of what was built.
fn report(file: &BaselineFile, output: &Path) -> Result<(), CommandError> {
    let mut table = TextTable::new(&["score", ">features", ">active sets", ">rows of each", "remark"]);
    for baseline in &file.baselines {
        let (kind, dimension) = (baseline.kind().to_string(), baseline.dimension().to_string());
        let [sets, rows, remark] = match baseline {
            Baseline::DOptimality(found) => {
                let ranks: Vec<usize> = found.ranks().into_iter().filter(|rank| *rank > 0).collect();
                let (least, most) = (ranks.iter().min(), ranks.iter().max());
                let rows = match (least, most) {
                    (Some(least), Some(most)) if least < most => format!("{least}–{most}"),
                    _ => most.copied().unwrap_or_default().to_string(),
                };
                let remark = if found.is_converged() { "" } else { "not converged: raise --max-sweeps" };
                [ranks.len().to_string(), rows, remark.to_owned()]
            }
            _ => ["–".to_owned(), "–".to_owned(), String::new()],
        };
        table.push(vec![kind, dimension, sets, rows, remark]);
    }
    print(|out| {
        table.write(out)?;
        writeln!(out, "wrote {}", output.display())
    })
}
