//! `calmwalk estimate`

use std::collections::HashMap;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use analysis::{CostModel, CostPredictors, MeasuredCost};
use monitor::disk::DiskForecast;
use monitor::label_cost::{CoreHours, CostEstimator};
use serde_json::json;
use store::{Location, Store};

use super::seed_structure_table::{SeedStructureTable, skipped_json, walk_hours};
use super::{CommandError, ExitStatus, block_on, campaign_location};
use crate::campaign::{LoadedCampaign, SkippedStructure, WalkTime};
use crate::disk_forecast;
use crate::output::{TextTable, count, print, print_json};
use crate::wording;
use crate::wording::cost::{core_hours, two_digits, wall_time};

/// Seed structures shown without --all.
const SHOWN: usize = 20;

/// Estimate the cost of a campaign before it starts
///
/// Shows the largest number of labels that the configuration allows, their expected cost, the time of the walks and the disk use. Measures a
/// few steps on this host for the time of the walks. Extrapolates the cost of a label from the labels of another campaign (--cost-from)
/// or from one test label (--core-seconds, see `calmwalk label-file`).
///
/// Also grades every seed structure as `calmwalk validate` does, and shows the worst: elements, closest pair, γ_max, and whether they meet
/// the collection rule (docs/seed-structures.md).
#[derive(Debug, clap::Args)]
pub struct EstimateArgs {
    /// Configuration of the campaign (TOML)
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// Campaign with labels computed in the same way, from which to estimate costs: its directory, or the postgres:// URL of
    /// its store
    #[arg(long, value_name = "DIR", conflicts_with = "core_seconds")]
    cost_from: Option<PathBuf>,
    /// Cost of one label of the first seed structure, in core-seconds
    #[arg(long, value_name = "CORE_SECONDS", value_parser = core_seconds)]
    core_seconds: Option<f64>,
    /// List every seed structure instead of the first 20 and the 20 worst (JSON always lists all)
    #[arg(long)]
    all: bool,
    /// Write a table of all seed structures, as `calmwalk validate --csv` does, to this file
    #[arg(long, value_name = "FILE.csv")]
    csv: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn core_seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds: &f64| seconds.is_finite() && *seconds > 0.0);
    seconds.ok_or_else(|| "expected a number of core-seconds above 0".to_owned())
}

/// The labels of one seed structure.
struct SeedStructureEstimate {
    name: String,
    size: CostPredictors,
    /// Upper limit.
    labels: u64,
    /// Cost of one label.
    cost_per_label: Option<CoreHours>,
    /// Time of its walks.
    walks: Option<WalkTime>,
}

/// The estimate for the campaign.
struct CampaignEstimate<'a> {
    /// What is known of the seed structures before their walks start.
    table: SeedStructureTable<'a>,
    skipped: &'a [SkippedStructure],
    seed_structures: Vec<SeedStructureEstimate>,
    /// Upper limit. Smaller than the sum over the seed structures if a key of the configuration limits the total.
    labels: u64,
    limited_by: Option<String>,
    cost: Option<CoreHours>,
    /// Where the costs come from.
    cost_source: String,
    /// Time of all walks.
    walks: Option<WalkTime>,
    disk: DiskForecast,
}

impl EstimateArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let campaign = LoadedCampaign::load(&self.config)?;
        campaign.print_warnings();
        let estimate = self.estimate(&campaign)?;
        if self.json {
            print_json(&as_json(&estimate))?;
        } else {
            print(|out| write(out, &self.config, &estimate, self.all))?;
        }
        Ok(ExitStatus::Done)
    }

    fn estimate<'a>(&self, campaign: &'a LoadedCampaign) -> Result<CampaignEstimate<'a>, CommandError> {
        let sizes: Vec<_> = campaign.label_sizes()?.iter().map(cost_size).collect();
        let (costs, cost_source) = self.costs(sizes.first())?;
        let table = SeedStructureTable::examine(campaign, self.csv.as_deref())?;
        let config = &campaign.config;
        let copies = config.labels_of_each();
        let seed_structures: Vec<_> = campaign
            .seed_structures
            .iter()
            .zip(sizes)
            .map(|(seed, size)| SeedStructureEstimate {
                name: seed.plan.name.clone(),
                size,
                labels: u64::from(copies) * config.max_structures_of(seed.plan.walks.len()),
                cost_per_label: costs.as_ref().and_then(|costs| costs.predict([(size, 1)])),
                walks: table.walk_time(seed),
            })
            .collect();
        let sum = seed_structures.iter().map(|seed| seed.labels).sum();
        let limit = config.max_structures().map(|limit| u64::from(copies) * u64::from(limit));
        let cost = costs
            .and_then(|costs| costs.predict(seed_structures.iter().map(|seed| (seed.size, seed.labels))));
        // It is not known in advance which seed structures reach fewer labels: scale all costs alike.
        let limit = limit.filter(|limit| *limit < sum);
        let fraction = limit.unwrap_or(sum) as f64 / sum.max(1) as f64;
        Ok(CampaignEstimate {
            seed_structures,
            labels: limit.unwrap_or(sum),
            limited_by: limit.and(config.budget().structures_by),
            cost: cost.map(|cost| cost.scaled(fraction)),
            cost_source,
            walks: table.total_walk_time(),
            disk: disk_forecast::estimate(campaign),
            skipped: &campaign.skipped,
            table,
        })
    }

    /// The cost model, and a description of its source.
    fn costs(&self, first: Option<&CostPredictors>) -> Result<(Option<CostEstimator>, String), CommandError> {
        if let (Some(core_seconds), Some(size)) = (self.core_seconds, first) {
            let measured = MeasuredCost { size: *size, core_seconds };
            let costs = CostEstimator::from_model(CostModel::fit(&[measured], None));
            return Ok((Some(costs), "--core-seconds".into()));
        }
        let Some(campaign) = &self.cost_from else {
            return Ok((None, String::new()));
        };
        let location = campaign_location::parse(campaign)?;
        let costs = block_on(fit_costs(&location))??;
        let source = format!("the {} of {location}", newest_labels(costs.measured()));
        Ok((Some(costs), source))
    }
}

/// The quantities that the cost of a label depends on, from its method.
fn cost_size(size: &dft::CalculationSize) -> CostPredictors {
    let electrons = Some(size.electrons).filter(|electrons| *electrons > 0.0);
    CostPredictors { atoms: size.atoms as f64, electrons, k_points: size.k_points as f64 }
}

fn newest_labels(count: usize) -> String {
    if count == 1 { "newest label".to_owned() } else { format!("{count} newest labels") }
}

async fn fit_costs(location: &Location) -> Result<CostEstimator, CommandError> {
    let store = Store::open_read_only(location).await?;
    let none = || CommandError::Input("--cost-from: that campaign has no labels".into());
    let protocol = store.protocol_in_force().await?.ok_or_else(none)?;
    let costs = CostEstimator::from_store(&store, protocol.hash).await?;
    store.close().await;
    if costs.measured() == 0 { Err(none()) } else { Ok(costs) }
}

fn write(out: &mut dyn Write, path: &Path, estimate: &CampaignEstimate<'_>, all: bool) -> io::Result<()> {
    let CampaignEstimate {
        table, seed_structures, labels, limited_by, cost, cost_source, walks, disk, ..
    } = estimate;
    let limit = limited_by.as_ref().map_or(String::new(), |key| format!(", limited by {key}"));
    writeln!(out, "{}: at most {}{limit}", path.display(), count(*labels, "label"))?;
    match cost {
        Some(hours) => {
            writeln!(
                out,
                "  labels   about {} for all of them, estimated from {cost_source}",
                core_hours(hours)
            )?;
        }
        None => writeln!(
            out,
            "  labels   cost unknown: pass a similar campaign with --cost-from, or compute one label with calmwalk label-file \
             and pass its cost with --core-seconds"
        )?,
    }
    let walks = walks.map_or("no step could be measured".to_owned(), wording::cost::walks);
    writeln!(out, "  walks    {walks}")?;
    writeln!(out, "  disk     {}", wording::disk::forecast(disk))?;
    for remark in table.remarks() {
        writeln!(out, "  start    {remark}")?;
    }
    let shown = if all { usize::MAX } else { SHOWN };
    write_labels(out, seed_structures, shown)?;
    writeln!(out)?;
    table.write(out, shown)
}

/// The labels of the first `shown` seed structures.
fn write_labels(
    out: &mut dyn Write,
    seed_structures: &[SeedStructureEstimate],
    shown: usize,
) -> io::Result<()> {
    let mut table = TextTable::new(&[
        "seed structure",
        ">labels",
        ">atoms",
        ">electrons",
        ">k-points",
        ">core-hours per label",
        ">walk",
    ]);
    let shown = shown.min(seed_structures.len());
    for SeedStructureEstimate { name, size, labels, cost_per_label, walks } in &seed_structures[..shown] {
        table.push(vec![
            name.clone(),
            labels.to_string(),
            size.atoms.to_string(),
            size.electrons.map_or("–".into(), |electrons| electrons.to_string()),
            size.k_points.to_string(),
            cost_per_label.map_or("–".into(), |hours| two_digits(hours.expected)),
            walks.map_or("–".into(), |time| wall_time(time.biased)),
        ]);
    }
    table.write(out)?;
    match seed_structures.len() - shown {
        0 => Ok(()),
        more => writeln!(out, "… and {more} more (use --all)"),
    }
}

fn as_json(estimate: &CampaignEstimate<'_>) -> serde_json::Value {
    let triage: HashMap<_, _> = estimate.table.to_json().into_iter().collect();
    let of_seed = |seed: &SeedStructureEstimate| {
        let CostPredictors { atoms, electrons, k_points } = seed.size;
        json!({
            "seed_structure": seed.name, "labels": seed.labels, "atoms": atoms, "electrons": electrons,
            "k_points": k_points, "core_hours_each": seed.cost_per_label, "walk_hours": walk_hours(seed.walks),
            "triage": triage.get(seed.name.as_str()),
        })
    };
    json!({
        "labels": estimate.labels, "limited_by": estimate.limited_by, "core_hours": estimate.cost,
        "walk_hours": walk_hours(estimate.walks), "disk": estimate.disk,
        "seed_structures": estimate.seed_structures.iter().map(of_seed).collect::<Vec<_>>(),
        "skipped": estimate.skipped.iter().map(skipped_json).collect::<Vec<_>>(),
    })
}
