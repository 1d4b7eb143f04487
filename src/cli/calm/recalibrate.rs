//! `calmwalk calm recalibrate`

use std::path::{Path, PathBuf};

use calm::Artifact;
use calm::build::{ElementHistograms, Recalibration, ThresholdRule, read_histograms};

use crate::artifact_checks::check_sound;
use crate::atomic_file::{AtomicFile, cannot_write, check_outputs};
use crate::cli::{CommandError, ExitStatus};
use crate::mixture_files::open;
use crate::output::{TextTable, print};

/// Set new thresholds from the histograms of a CALM artifact, without its training data
///
/// γ = 1 is where σ reaches the threshold of its component. By default the threshold is median + 3 · 1.4826 · MAD of σ over the
/// component's training atoms, as `calm build` sets it. With --percentile, it is a quantile of σ. Components with too few training
/// atoms get the largest reliable threshold of their element.
#[derive(Debug, clap::Args)]
pub struct CalmRecalibrateArgs {
    /// CALM artifact (gmm_artifacts.npz)
    #[arg(value_name = "CALM.npz")]
    artifact: PathBuf,
    /// File for the artifact with the new thresholds; an existing file is replaced
    #[arg(long, short, value_name = "OUT.npz")]
    output: PathBuf,
    /// Percentage of a component's training atoms that have γ ≤ 1, above 0 and at most 100 [default: median + 3 · 1.4826 · MAD]
    #[arg(long, value_name = "Q", value_parser = percentage)]
    percentile: Option<f64>,
    /// GRACE model (kokkos.npz) with this mixture, for --embed
    #[arg(long, value_name = "MODEL.npz", requires = "embed")]
    model: Option<PathBuf>,
    /// Also write a copy of the model with the new thresholds, for LAMMPS and calmwalk
    #[arg(long, value_name = "MODEL.npz", requires = "model")]
    embed: Option<PathBuf>,
}

impl CalmRecalibrateArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let model = self.model.iter().map(|path| (path.as_path(), "the model"));
        let inputs: Vec<_> =
            std::iter::once((self.artifact.as_path(), "the artifact itself")).chain(model).collect();
        check_outputs(std::iter::once(&self.output).chain(&self.embed).map(PathBuf::as_path), &inputs)?;
        let before = Artifact::load(&self.artifact).map_err(CommandError::input)?;
        check_sound(&before, &self.artifact).map_err(CommandError::Input)?;
        if let Some(model) = &self.model {
            check_has_mixture(model, &before)?;
        }
        let histograms = read_histograms(&self.artifact).map_err(CommandError::input)?;
        let rule = self.percentile.map_or(ThresholdRule::Robust, ThresholdRule::Percentile);
        let found = Recalibration::new(rule, before.mixture.dimension(), &histograms);
        if let (Some(model), Some(path)) = (&self.model, &self.embed) {
            let mut file = AtomicFile::create(path)?;
            found.write_export(open(model)?, &mut file).map_err(|error| cannot_write(path, error))?;
            file.finish()?;
        }
        let mut file = AtomicFile::create(&self.output)?;
        let artifact = open(&self.artifact)?;
        found.write_artifact(artifact, &mut file).map_err(|error| cannot_write(&self.output, error))?;
        file.finish()?;
        report(&before, &histograms, &found, &self.output)?;
        Ok(ExitStatus::Done)
    }
}

fn percentage(text: &str) -> Result<f64, String> {
    let found = text.parse().ok().filter(|value| *value > 0.0 && *value <= 100.0);
    found.ok_or_else(|| "expected a percentage, above 0 and at most 100".to_owned())
}

/// The mixture of the model's export is that of the artifact, but for thresholds.
fn check_has_mixture(model: &Path, artifact: &Artifact) -> Result<(), CommandError> {
    let own = Artifact::load_export(model).map_err(CommandError::input)?;
    let centroids = |of: &Artifact| -> Vec<_> {
        of.mixture.iter().map(|(element, slot, found)| (element, slot, found.centroid().to_vec())).collect()
    };
    let same = artifact.check_belongs_to(&own.symbols, &own.projection);
    same.map_err(|error| CommandError::Input(format!("{}: {error}", model.display())))?;
    if centroids(&own) == centroids(artifact) {
        return Ok(());
    }
    Err(CommandError::Input(format!(
        "{}: the model has another mixture than the artifact; expected the same centroids",
        model.display()
    )))
}

/// A table of the thresholds.
fn report(
    before: &Artifact,
    histograms: &[Option<ElementHistograms>],
    after: &Recalibration,
    output: &Path,
) -> Result<(), CommandError> {
    let titles =
        ["element", ">atoms", ">components", ">thresholds before", ">after", ">γ > 1 before", ">after"];
    let mut table = TextTable::new(&titles);
    for (element, (symbol, found)) in before.symbols.iter().zip(histograms).enumerate() {
        let Some(found) = found else { continue };
        let filled: Vec<_> = found.components.iter().filter(|histogram| histogram.count() > 0).collect();
        let old: Vec<f64> = before.mixture.components(element).map_or(Vec::new(), |components| {
            components.iter().map(|component| component.threshold()).collect()
        });
        let new = &after.elements()[element].weighted;
        let atoms: u64 = filled.iter().map(|histogram| histogram.count()).sum();
        let above = |thresholds: &[f64]| -> String {
            let above = filled.iter().zip(thresholds).map(|(histogram, &at)| histogram.count_above(at));
            format!("{:.2} %", 100.0 * above.sum::<f64>() / atoms.max(1) as f64)
        };
        table.push(vec![
            symbol.clone(),
            atoms.to_string(),
            filled.len().to_string(),
            range(&old[..filled.len().min(old.len())]),
            range(&new[..filled.len()]),
            above(&old),
            above(new),
        ]);
    }
    print(|out| {
        table.write(out)?;
        writeln!(out, "wrote {}", output.display())
    })
}

fn range(values: &[f64]) -> String {
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(0.0, f64::max);
    if low >= high { format!("{high:.2}") } else { format!("{low:.2}–{high:.2}") }
}
