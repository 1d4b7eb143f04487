//! `calmwalk calm build`

use std::path::{Path, PathBuf};
use std::sync::Arc;

use calm::Projection;
use calm::build::{BuildSettings, BuiltElement, BuiltMixture};
use potentials::ModelWithFeatures;
use tokio_util::sync::CancellationToken;

use super::campaign_updates::UpdateSource;
use crate::artifact_checks::check_sound;
use crate::atomic_file::check_outputs;
use crate::cli::{CommandError, ExitStatus};
use crate::feature_variant::{FeatureModel, FeatureVariant};
use crate::loaded_model::LoadedModel;
use crate::mixture_build::{BuildDefaults, BuildPart, MixtureBuild, PROJECTED, PassContext, projected};
use crate::mixture_files::MixtureFiles;
use crate::output::{TextTable, log_and_warn, print, print_stderr};
use crate::signals::stop_token;
use crate::structure_files::{StructureArgs, StructureFiles, file_weight};

/// Build a CALM mixture from the training data of a model
///
/// Goes through all structures three times: pass 1 finds clusters of environments for each element, pass 2 their covariances,
/// pass 3 the thresholds. The artifact depends on model, data, weights, --where, --candidates, --projection-dimension, --feature-variant,
/// --rng-seed, --shard-size and --campaign, but not on the number of threads.
///
/// A model without a projection of its features (uq_rp_matrix) gets a random one, which the artifact stores.
///
/// Several hosts can share the work (--pass, --part, `calmwalk calm merge`); the artifact is the same.
///
/// Keeps its state in CALM.npz.build until it has written the artifact. After an interruption (Ctrl-C, SIGTERM, a crash), the same command
/// continues from the last finished shards.
#[derive(Debug, clap::Args)]
pub struct CalmBuildArgs {
    /// GRACE model (kokkos.npz)
    #[arg(long, value_name = "MODEL.npz")]
    model: PathBuf,
    #[command(flatten)]
    data: StructureArgs,
    /// File for the artifact; an existing file is replaced at the end
    #[arg(long, short, value_name = "CALM.npz")]
    output: PathBuf,
    /// Also write a copy of the model with the new mixture, for LAMMPS and calmwalk
    #[arg(long, value_name = "MODEL.npz", conflicts_with = "feature_variant")]
    embed: Option<PathBuf>,
    /// Features of the mixture: normalised or linear, with the projection matrix of the model file, or hidden [default: those of the model
    /// file]. Mixtures of other features are for comparisons (`calm score`, `calm baseline`, `calm validate --compare-artifact`), not for
    /// campaigns
    #[arg(long, value_name = "VARIANT")]
    feature_variant: Option<FeatureVariant>,
    /// Weight of the atoms of a file of DATA, 0 or more; multiplies calmwalk_weight of a frame that has it; may be repeated [default: 1]
    #[arg(long, value_name = "FILE=W", value_parser = file_weight)]
    weight: Vec<(PathBuf, f64)>,
    /// Also update the mixture with the accepted candidates of this campaign that have no label (pending, failed, dropped or excluded), so
    /// that walkers do not collect them again: its directory or the postgres:// URL of its store. With --part, give it to `calm merge`
    #[arg(long, value_name = "DIR", conflicts_with = "pass")]
    campaign: Option<PathBuf>,
    /// Candidate numbers of components per element, ascending; the build chooses one for each element
    #[arg(long, value_name = "K,…", value_delimiter = ',', default_values_t = BuildDefaults::CANDIDATES)]
    candidates: Vec<usize>,
    /// Random seed
    #[arg(long, value_name = "N", default_value_t = 42)]
    rng_seed: u64,
    /// Projected features of a model that has no projection yet; the norms of the basis are further features [default: 128]
    #[arg(long, value_name = "D", value_parser = clap::value_parser!(u32).range(1..=65536))]
    projection_dimension: Option<u32>,
    /// Number of structures per shard. Each thread keeps one shard in memory
    #[arg(long, value_name = "N", default_value_t = BuildDefaults::SHARD_SIZE, value_parser = clap::value_parser!(u64).range(1..))]
    shard_size: u64,
    /// Threads; each takes whole shards [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Disk space beside the output for features, GB. Passes 2 and 3 read the features of pass 1 there, and compute those that do not fit.
    /// With --part, the limit applies to each process. 0 stores none
    #[arg(long, value_name = "GB", default_value_t = BuildDefaults::MAX_FEATURE_BYTES as f64 / 1e9, value_parser = gigabytes)]
    max_feature_cache: f64,
    /// Discard the saved state and start from pass 1
    #[arg(long)]
    restart: bool,
    /// Run only this pass, on the shards of --part (to share a build between hosts)
    #[arg(long, value_name = "1|2|3", requires = "part", conflicts_with = "restart", value_parser = clap::value_parser!(u8).range(1..=3))]
    pass: Option<u8>,
    /// The part of this process: every n-th shard, from shard i. When all parts of a pass are done, run `calmwalk calm merge`
    #[arg(long, value_name = "i/n", requires = "pass")]
    part: Option<BuildPart>,
}

fn gigabytes(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (0.0..=1e6).contains(number));
    number.ok_or_else(|| "expected 0 to 1e6 GB".to_owned())
}

impl CalmBuildArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let files = self.files()?;
        let campaign = self.campaign.as_deref().map(UpdateSource::find).transpose()?;
        let (model, projection, seed) = self.projected_model()?;
        if model.is_hidden() && campaign.is_some() {
            let message = "--campaign: updates grade the features of the campaign; expected no --feature-variant hidden";
            return Err(CommandError::Input(message.into()));
        }
        let stop = stop_token()?;
        let mut build = self.open(files, &model, &projection, &stop)?;
        if let (Some(pass), Some(part)) = (self.pass, self.part) {
            return end_part(pass, part, build.run_part(pass)?);
        }
        let Some(mixture) = build.run(projection, seed)? else { return Ok(stopped()) };
        let embed = self.embed.as_deref().map(|copy| (self.model.as_path(), copy));
        let files = MixtureFiles { embed, output: &self.output };
        let Some(updates) = write_mixture(&mixture, files, &model.model.shared(), campaign.as_ref(), &stop)?
        else {
            return Ok(stopped());
        };
        build.finish()?;
        report(&mixture, &self.output, &updates)?;
        Ok(ExitStatus::Done)
    }

    /// The training data with their weights. Checks the paths of all files, so that errors are found before hours of work.
    fn files(&self) -> Result<StructureFiles, CommandError> {
        let mut files = self.data.files()?;
        files.set_weights(&self.weight)?;
        let data = files.paths().map(|path| (path, "a file of training data"));
        let inputs: Vec<_> = std::iter::once((self.model.as_path(), "the model")).chain(data).collect();
        check_outputs(std::iter::once(&self.output).chain(&self.embed).map(PathBuf::as_path), &inputs)?;
        Ok(files)
    }

    /// As [`projected`], with what the command line says about the projection.
    fn projected_model(&self) -> Result<(FeatureModel, Projection, Option<i64>), CommandError> {
        let model = LoadedModel::load(&self.model)?;
        if let (Some(found), Some(_)) = (model.projection(), self.projection_dimension) {
            return Err(CommandError::Input(format!(
                "--projection-dimension: {} has a projection with {} features; expected a model without one",
                self.model.display(),
                found.columns
            )));
        }
        let dimension = self.projection_dimension.map_or(PROJECTED, |dimension| dimension as usize);
        projected(&self.model, model, self.feature_variant, self.rng_seed, dimension)
    }

    /// Begins the build, or continues it.
    fn open(
        &self,
        files: StructureFiles,
        model: &FeatureModel,
        projection: &Projection,
        stop: &CancellationToken,
    ) -> Result<MixtureBuild, CommandError> {
        let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get());
        let settings = BuildSettings {
            dimension: projection.feature_dimension,
            seed: self.rng_seed,
            candidates: self.candidates.clone(),
            shard_size: self.shard_size,
        };
        let hash = model.model.identity(&self.model)?;
        let context = PassContext {
            model: model.clone(),
            files,
            shard_size: self.shard_size,
            part: self.part,
            seed: self.rng_seed,
            threads: self.threads.map_or(cores, usize::from),
            max_feature_bytes: (1e9 * self.max_feature_cache) as u64,
            stop: stop.clone(),
        };
        MixtureBuild::open(context, settings, hash, projection, &self.output, self.restart)
    }
}

fn end_part(pass: u8, part: BuildPart, done: bool) -> Result<ExitStatus, CommandError> {
    if !done {
        return Ok(stopped());
    }
    print(|out| {
        writeln!(out, "part {part} of pass {pass} is done; when all parts are, run calmwalk calm merge")
    })?;
    Ok(ExitStatus::Done)
}

/// Says how to continue the build.
pub(super) fn stopped() -> ExitStatus {
    print_stderr("stopped; the same command continues");
    ExitStatus::Interrupted
}

/// Writes the files of a mixture, after the updates by a campaign, if one is named. `model` computes the features. Returns what is said of
/// the updates, or `None` if `stop` was cancelled before they ended.
pub(super) fn write_mixture(
    mixture: &BuiltMixture,
    files: MixtureFiles<'_>,
    model: &Arc<dyn ModelWithFeatures>,
    campaign: Option<&UpdateSource>,
    stop: &CancellationToken,
) -> Result<Option<String>, CommandError> {
    match campaign {
        Some(campaign) => campaign.write(mixture, files, model, stop),
        None => files.write_built(mixture).map(|()| Some(String::new())),
    }
}

/// A table of the elements, and what is said of updates, if anything.
pub(super) fn report(mixture: &BuiltMixture, output: &Path, updates: &str) -> Result<(), CommandError> {
    let artifact = mixture.artifact().map_err(CommandError::failed)?;
    if let Err(fault) = check_sound(&artifact, output) {
        log_and_warn(format_args!("WARNING: {fault}; campaigns and calm score refuse this artifact"));
    }
    let titles = [
        "element",
        ">atoms",
        ">components",
        ">smallest",
        ">largest",
        ">condition number",
        ">thresholds",
        ">γ > 1",
    ];
    let mut table = TextTable::new(&titles);
    for ((symbol, element), thresholds) in
        artifact.symbols.iter().zip(mixture.elements()).zip(mixture.thresholds())
    {
        table.push(row(symbol, element.as_ref(), &thresholds.weighted));
    }
    print(|out| {
        table.write(out)?;
        out.write_all(updates.as_bytes())?;
        writeln!(out, "wrote {}", output.display())
    })
}

fn row(symbol: &str, element: Option<&BuiltElement>, thresholds: &[f64]) -> Vec<String> {
    let Some(BuiltElement { components, histograms }) = element else {
        let dashes = std::iter::repeat_n("–".to_owned(), 5);
        return [symbol.to_owned(), "0".into()].into_iter().chain(dashes).chain(["–".to_owned()]).collect();
    };
    let counts = || components.iter().map(|component| component.count);
    let atoms: f64 = counts().sum();
    let condition = components.iter().map(|component| component.condition_number).fold(0.0, f64::max);
    let thresholds = &thresholds[..components.len()];
    let (low, high) = range(thresholds.iter().copied());
    let (smallest, largest) = range(counts());
    let above: f64 = histograms
        .components
        .iter()
        .zip(thresholds)
        .map(|(histogram, &threshold)| histogram.count_above(threshold))
        .sum();
    vec![
        symbol.to_owned(),
        atoms.to_string(),
        components.len().to_string(),
        smallest.to_string(),
        largest.to_string(),
        format!("{condition:.1e}"),
        if low == high { format!("{low:.2}") } else { format!("{low:.2}–{high:.2}") },
        format!("{:.2} %", 100.0 * above / atoms.max(1.0)),
    ]
}

fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, 0.0), |(low, high), value| (low.min(value), f64::max(high, value)))
}
