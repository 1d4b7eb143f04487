//! `calmwalk force-errors`

use std::io::{self, Write};

use analysis::{CompletionBin, ErrorBin};
use serde_json::{Value, json};
use store::{Protocol, Store};

use super::{CampaignLocation, ExitStatus, Failure, block_on};
use crate::label_statistics::{self, ErrorsByGrade, LARGE_FORCE_ERROR, LabelStatistics};
use crate::output::{Table, count, decimals, print, print_json, range};

/// Failed structures listed per line.
const NAMES: usize = 3;

/// Show the errors of the potential: force errors by extrapolation grade, energy errors, and structures without labels
///
/// Relates the force error |F_model − F_label| of each labelled atom to its grades γ and γ_nbr under the original mixture:
/// median and percentiles in bins of the grade, Spearman's ρ, and the area under the receiver operating characteristic
/// (ROC-AUC) of the grade as a test for errors above 1 eV/Å. The errors of structures whose labels failed are unknown: these
/// structures are counted as censored and listed in their bins. Energy errors exclude a fitted offset per element, because
/// labels and potential have different zeros of energy. Works while the campaign runs.
#[derive(Debug, clap::Args)]
pub struct ForceErrors {
    #[command(flatten)]
    location: CampaignLocation,
    /// Use the labels of this protocol [default: the current protocol]
    #[arg(long, value_name = "NAME")]
    protocol: Option<String>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl ForceErrors {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let (protocol, learned) = block_on(self.read())??;
        if self.json {
            print_json(&as_json(&protocol, &learned))?;
        } else {
            print(|out| write(out, &protocol, &learned))?;
        }
        Ok(ExitStatus::Done)
    }

    async fn read(&self) -> Result<(Protocol, LabelStatistics), Failure> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let protocol = self.select_protocol(&store).await?;
        let learned = label_statistics::read(&store, protocol.hash).await?;
        store.close().await;
        Ok((protocol, learned))
    }

    async fn select_protocol(&self, store: &Store) -> Result<Protocol, Failure> {
        let Some(name) = &self.protocol else {
            let none = || Failure::Input("the campaign has no labels: it has no label protocol yet".into());
            return store.protocol_in_force().await?.ok_or_else(none);
        };
        let protocols = store.protocols().await?;
        let found = protocols.iter().find(|protocol| protocol.name == *name);
        found.cloned().ok_or_else(|| {
            let names: Vec<_> = protocols.iter().map(|protocol| format!("'{}'", protocol.name)).collect();
            Failure::Input(format!("the campaign has no protocol '{name}'; it has {}", names.join(", ")))
        })
    }
}

fn write(out: &mut dyn Write, protocol: &Protocol, learned: &LabelStatistics) -> io::Result<()> {
    let LabelStatistics { all, .. } = learned;
    writeln!(
        out,
        "force error |F_model − F_label| by grade under the original mixture, protocol '{}'",
        protocol.name
    )?;
    write_correlations(out, learned)?;
    if (all.gamma.sampled() as u64) < all.gamma.atoms() {
        let (sampled, atoms) = (all.gamma.sampled(), all.gamma.atoms());
        writeln!(out, "ρ, ROC-AUC and percentiles are from a sample of {sampled} of {atoms} atoms")?;
    }
    if learned.shared > 0 {
        let structures = count(learned.shared, "structure");
        writeln!(
            out,
            "{structures} found by both biased and control walks: counted once in 'all', and not in 'biased' or 'control'"
        )?;
    }
    if all.gamma.left_out() + all.gamma_nbr.left_out() > 0 {
        let (gamma, gamma_nbr) = (all.gamma.left_out(), all.gamma_nbr.left_out());
        writeln!(out, "excluded: {gamma} atoms without a finite γ, {gamma_nbr} without a finite γ_nbr")?;
    }
    write_energies(out, learned)?;
    for (name, errors) in [("γ", &all.gamma), ("γ_nbr", &all.gamma_nbr)] {
        write_bins(out, name, &errors.bins())?;
    }
    write_completion(out, "γ_max", &learned.by_gamma.bins())?;
    write_completion(out, "V/V₀", &learned.by_expansion.bins())
}

fn write_correlations(out: &mut dyn Write, learned: &LabelStatistics) -> io::Result<()> {
    let mut table = Table::new(&[
        "",
        ">structures",
        ">atoms",
        ">mean (eV/Å)",
        ">ρ(γ)",
        ">ρ(γ_nbr)",
        ">ROC-AUC(γ)",
        ">ROC-AUC(γ_nbr)",
    ]);
    for (name, grades) in [("all", &learned.all), ("biased", &learned.biased), ("control", &learned.control)]
    {
        let ErrorsByGrade { structures, gamma, gamma_nbr } = grades;
        table.push(vec![
            name.into(),
            structures.to_string(),
            gamma.atoms().to_string(),
            decimals(gamma.mean(), 3),
            decimals(gamma.spearman(), 3),
            decimals(gamma_nbr.spearman(), 3),
            decimals(gamma.roc_auc(), 3),
            decimals(gamma_nbr.roc_auc(), 3),
        ]);
    }
    table.write(out)
}

fn write_energies(out: &mut dyn Write, learned: &LabelStatistics) -> io::Result<()> {
    let energies = learned.energies.summary();
    writeln!(out)?;
    if let Some(line) = energies.line() {
        writeln!(out, "energy error |E_model − E_label|: {line}")?;
    }
    writeln!(out, "{}", energies.offsets.note)
}

fn write_bins(out: &mut dyn Write, name: &str, bins: &[ErrorBin]) -> io::Result<()> {
    let large = format!(">above {LARGE_FORCE_ERROR} eV/Å (%)");
    let mut table = Table::new(&[
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
    for bin in bins {
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
        Table::new(&[name, ">attempted", ">labelled", ">share (%)", ">95 %", "failed (censored)"]);
    for bin in bins {
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

/// The output of `--json`.
pub fn as_json(protocol: &Protocol, learned: &LabelStatistics) -> Value {
    json!({
        "protocol": protocol.name,
        "protocol_hash": protocol.hash.to_string(),
        "large": LARGE_FORCE_ERROR,
        "all": grades_as_json(&learned.all),
        "biased": grades_as_json(&learned.biased),
        "control": grades_as_json(&learned.control),
        "energy": learned.energies.summary(),
        "shared_structures": learned.shared,
        "completion_by_gamma": completion_as_json(&learned.by_gamma.bins()),
        "completion_by_relative_volume": completion_as_json(&learned.by_expansion.bins()),
    })
}

fn grades_as_json(grades: &ErrorsByGrade) -> Value {
    let one = |errors: &analysis::ForceErrors| {
        json!({
            "spearman": errors.spearman(), "roc_auc": errors.roc_auc(), "left_out": errors.left_out(),
            "sampled_atoms": errors.sampled(), "share_above_one": errors.fraction_above(1.0),
            "bins": errors.bins().iter().map(bin_as_json).collect::<Vec<_>>(),
        })
    };
    json!({
        "structures": grades.structures, "atoms": grades.gamma.atoms(), "mean_error": grades.gamma.mean(),
        "gamma": one(&grades.gamma), "gamma_nbr": one(&grades.gamma_nbr),
    })
}

fn bin_as_json(bin: &ErrorBin) -> Value {
    let ErrorBin { above, up_to, atoms, share, unlabelled, median, p90, p99, large, large_between } = bin;
    json!({
        "above": above, "up_to": up_to, "atoms": atoms, "share": share, "median": median, "p90": p90, "p99": p99,
        "share_large": large, "atoms_without_label": unlabelled, "share_large_between": large_between,
    })
}

fn completion_as_json(bins: &[CompletionBin<String>]) -> Value {
    let one = |bin: &CompletionBin<String>| {
        json!({
            "above": bin.above, "up_to": bin.up_to, "labelled": bin.labelled, "failed": bin.failed,
            "share": bin.share, "share_between": bin.interval,
        })
    };
    bins.iter().map(one).collect()
}
