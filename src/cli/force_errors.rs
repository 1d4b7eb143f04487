//! `calmwalk force-errors`

mod comparison;

use std::io::{self, Write};
use std::path::PathBuf;

use analysis::{CompletionBin, ErrorBin};
use monitor::calibration;
use monitor::label_statistics::{self, ErrorsByGrade, LARGE_FORCE_ERROR, LabelStatistics};
use store::{Protocol, Store};

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::calibration_file::CalibrationFile;
use crate::output::{TextTable, count, decimals, print, print_json, range};
use crate::wording;

/// Failed structures listed per line.
const NAMES: usize = 3;

/// Show the errors of the potential: force errors by extrapolation grade, energy errors, and structures without labels
///
/// Relates the force error |F_model − F_label| of each labelled atom to its grades γ and γ_nbr under the original mixture:
/// median and percentiles in bins of the grade, Spearman's ρ, and the area under the receiver operating characteristic
/// (ROC-AUC) of the grade as a test for errors above 1 eV/Å. Structures whose labels failed have no error: each bin counts them as
/// 'without label'. Energy errors exclude a fitted offset per element, because labels and potential have different zeros of energy.
///
/// Biased walks are compared with their controls, matched by pairs and pooled,
/// with tests and with confidence intervals by bootstrap over seed structures. docs/errors.md defines each number.
///
/// Also shows, by γ_nbr, the error below which 90 % of force errors are expected, and how often that held for later labels.
///
/// With several versions of the potential, the numbers are those of one version (--version), and a table compares all, each by its
/// own grades. Works while the campaign runs.
#[derive(Debug, clap::Args)]
pub struct ForceErrorsArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Use the labels of this protocol [default: the current protocol]
    #[arg(long, value_name = "NAME")]
    protocol: Option<String>,
    /// Use structures from walks with this version of the potential [default: the newest with labels]
    #[arg(long, value_name = "N")]
    version: Option<u32>,
    /// Also write the bounds of the force error by γ_nbr to this file, for `calmwalk calm score --calibration`
    #[arg(long, value_name = "OUT.json")]
    calibration: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl ForceErrorsArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let (protocol, statistics, bounds) = block_on(self.read())??;
        if let Some(path) = &self.calibration {
            bounds.write(path)?;
        }
        if self.json {
            let mut json = wording::json::force_errors(&statistics, &protocol);
            json["calibration"] = wording::json::error_bounds(&bounds.summary);
            print_json(&json)?;
        } else {
            print(|out| {
                write(out, &protocol, &statistics)?;
                super::calibration::write(out, &bounds.summary)
            })?;
        }
        Ok(ExitStatus::Done)
    }

    async fn read(&self) -> Result<(Protocol, LabelStatistics, CalibrationFile), CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let protocol = self.select_protocol(&store).await?;
        if let Some(version) = self.version {
            check_version(&store, version).await?;
        }
        let statistics = label_statistics::read(&store, protocol.hash, self.version).await?;
        let version = statistics.version.unwrap_or(0);
        let bounds = calibration::read(&store, protocol.hash, version).await?;
        let bounds = CalibrationFile::new(&store, &protocol, bounds.summary()).await?;
        store.close().await;
        Ok((protocol, statistics, bounds))
    }

    async fn select_protocol(&self, store: &Store) -> Result<Protocol, CommandError> {
        let Some(name) = &self.protocol else {
            let none =
                || CommandError::Input("the campaign has no labels: it has no label protocol yet".into());
            return store.protocol_in_force().await?.ok_or_else(none);
        };
        let protocols = store.protocols().await?;
        let found = protocols.iter().find(|protocol| protocol.name == *name);
        found.cloned().ok_or_else(|| {
            let names: Vec<_> = protocols.iter().map(|protocol| format!("'{}'", protocol.name)).collect();
            CommandError::Input(format!("the campaign has no protocol '{name}'; it has {}", names.join(", ")))
        })
    }
}

/// Refuses a version that drives no walk.
///
/// # Errors
/// The campaign has no walk with it.
pub async fn check_version(store: &Store, version: u32) -> Result<(), CommandError> {
    let numbers: Vec<u32> = store.walk_versions().await?.numbers().collect();
    if numbers.contains(&version) {
        return Ok(());
    }
    let numbers: Vec<_> = numbers.iter().map(u32::to_string).collect();
    Err(CommandError::Input(format!(
        "--version {version}: no walk has this version of the potential; expected one of {}",
        numbers.join(", ")
    )))
}

fn write(out: &mut dyn Write, protocol: &Protocol, statistics: &LabelStatistics) -> io::Result<()> {
    let LabelStatistics { all, version, .. } = statistics;
    let version = version.map_or(String::new(), |version| format!(", version {version} of the potential"));
    writeln!(
        out,
        "force error |F_model − F_label| by grade under the original mixture, protocol '{}'{version}",
        protocol.name
    )?;
    write_correlations(out, statistics)?;
    if (all.gamma.sampled() as u64) < all.gamma.atoms() {
        let (sampled, atoms) = (all.gamma.sampled(), all.gamma.atoms());
        writeln!(out, "ρ, ROC-AUC and percentiles are from a sample of {sampled} of {atoms} atoms")?;
    }
    if statistics.shared > 0 {
        let structures = count(statistics.shared, "structure");
        writeln!(
            out,
            "{structures} found by both biased and control walks: counted once in 'all', and not in 'biased' or 'control'"
        )?;
    }
    if all.gamma.left_out() + all.gamma_nbr.left_out() > 0 {
        let (gamma, gamma_nbr) = (all.gamma.left_out(), all.gamma_nbr.left_out());
        writeln!(out, "excluded: {gamma} atoms without a finite γ, {gamma_nbr} without a finite γ_nbr")?;
    }
    write_energies(out, statistics)?;
    comparison::write(out, &statistics.comparison())?;
    write_versions(out, statistics)?;
    for (name, errors) in [("γ", &all.gamma), ("γ_nbr", &all.gamma_nbr)] {
        write_bins(out, name, &errors.bins())?;
    }
    write_completion(out, "γ₀_max", &statistics.by_gamma.bins())?;
    write_completion(out, "V/V₀", &statistics.by_expansion.bins())
}

fn write_correlations(out: &mut dyn Write, statistics: &LabelStatistics) -> io::Result<()> {
    let mut table = TextTable::new(&[
        "",
        ">structures",
        ">atoms",
        ">mean (eV/Å)",
        ">ρ(γ)",
        ">ρ(γ_nbr)",
        ">ROC-AUC(γ)",
        ">ROC-AUC(γ_nbr)",
    ]);
    // Biased walks and their controls have intervals, in a section of their own.
    let ErrorsByGrade { structures, gamma, gamma_nbr } = &statistics.all;
    table.push(vec![
        "all".into(),
        structures.to_string(),
        gamma.atoms().to_string(),
        decimals(gamma.mean(), 3),
        decimals(gamma.spearman(), 3),
        decimals(gamma_nbr.spearman(), 3),
        decimals(gamma.roc_auc(), 3),
        decimals(gamma_nbr.roc_auc(), 3),
    ]);
    table.write(out)
}

fn write_energies(out: &mut dyn Write, statistics: &LabelStatistics) -> io::Result<()> {
    let energies = statistics.energies.summary();
    writeln!(out)?;
    if let Some(line) = wording::energies::errors(&energies) {
        writeln!(out, "energy error |E_model − E_label|: {line}")?;
    }
    writeln!(out, "{}", wording::energies::offsets(&energies.offsets))
}

/// A table of the versions, each by the grades of its own mixture.
fn write_versions(out: &mut dyn Write, statistics: &LabelStatistics) -> io::Result<()> {
    if statistics.by_version.is_empty() {
        return Ok(());
    }
    let mut table = TextTable::new(&[
        ">version",
        ">structures",
        ">atoms",
        ">mean (eV/Å)",
        ">median",
        ">ρ(γ)",
        ">ρ(γ_nbr)",
        ">ROC-AUC(γ)",
        ">ROC-AUC(γ_nbr)",
    ]);
    for (version, grades) in &statistics.by_version {
        let ErrorsByGrade { structures, gamma, gamma_nbr } = grades;
        table.push(vec![
            version.to_string(),
            structures.to_string(),
            gamma.atoms().to_string(),
            decimals(gamma.mean(), 3),
            decimals(gamma.median(), 3),
            decimals(gamma.spearman(), 3),
            decimals(gamma_nbr.spearman(), 3),
            decimals(gamma.roc_auc(), 3),
            decimals(gamma_nbr.roc_auc(), 3),
        ]);
    }
    writeln!(
        out,
        "\nby version of the potential, each by its own grades, of the structures of its own walks:"
    )?;
    table.write(out)
}

fn write_bins(out: &mut dyn Write, name: &str, bins: &[ErrorBin]) -> io::Result<()> {
    let large = format!(">above {LARGE_FORCE_ERROR} eV/Å (%)");
    let mut table = TextTable::new(&[
        name,
        ">atoms",
        ">atoms (%)",
        ">median",
        ">p90",
        ">p99",
        &large,
        ">without label",
        ">possible (%)",
    ]);
    for bin in bins.iter().filter(|bin| bin.atoms > 0 || bin.unlabelled > 0) {
        let percent = |share: f64| format!("{:.1}", 100.0 * share);
        let possible =
            bin.large_between.map(|(least, most)| format!("{} to {}", percent(least), percent(most)));
        table.push(vec![
            range(bin.above, bin.up_to),
            bin.atoms.to_string(),
            percent(bin.share),
            decimals(bin.median, 3),
            decimals(bin.p90, 3),
            decimals(bin.p99, 3),
            bin.large.map_or("–".into(), percent),
            bin.unlabelled.to_string(),
            possible.unwrap_or("–".into()),
        ]);
    }
    writeln!(out)?;
    table.write(out)
}

fn write_completion(out: &mut dyn Write, name: &str, bins: &[CompletionBin<String>]) -> io::Result<()> {
    let mut table =
        TextTable::new(&[name, ">attempted", ">labelled", ">share (%)", ">95 %", "failed (without label)"]);
    for bin in bins.iter().filter(|bin| bin.labelled > 0 || !bin.failed.is_empty()) {
        let percent = |share: f64| format!("{:.0}", 100.0 * share);
        let interval = bin.interval.map(|(low, high)| format!("{} to {}", percent(low), percent(high)));
        let more = bin.failed.len().saturating_sub(NAMES);
        let mut names = bin.failed[..bin.failed.len() - more].join(" ");
        if more > 0 {
            names = format!("{names} … and {more} more (use --json)");
        }
        table.push(vec![
            range(bin.above, bin.up_to),
            (bin.labelled + bin.failed.len() as u64).to_string(),
            bin.labelled.to_string(),
            bin.share.map_or("–".into(), percent),
            interval.unwrap_or("–".into()),
            names,
        ]);
    }
    writeln!(out)?;
    table.write(out)
}
