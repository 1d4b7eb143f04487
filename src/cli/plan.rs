//! `calmwalk plan`

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use analysis::{CostModel, Measured, Size};
use serde_json::json;
use store::{Location, Store};

use super::{ExitStatus, Failure, block_on, place};
use crate::campaign::Campaign;
use crate::disk_forecast::DiskForecast;
use crate::label_cost::{CoreHours, CostEstimator, cost_size, two_digits};
use crate::output::{Table, count, print, print_json};

/// Seed structures shown unless all are asked for.
const SHOWN: usize = 20;

/// Show what a campaign may cost before it starts
///
/// Labels at most by the campaign's own rules, what they will take, and how much disk. What a label takes is known from the
/// labels of another campaign (--like), or from one that was made to try the protocol out (--core-seconds).
#[derive(Debug, clap::Args)]
pub struct Plan {
    /// Configuration of a campaign
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// A campaign whose labels were made in the same way: its directory, or the postgres:// URL of its store
    #[arg(long, value_name = "DIR", conflicts_with = "core_seconds")]
    like: Option<PathBuf>,
    /// What one label of the first seed structure took, core-seconds
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    core_seconds: Option<f64>,
    /// Show every seed structure, not only 20 of them (JSON always has all)
    #[arg(long)]
    all: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds: &f64| seconds.is_finite() && *seconds > 0.0);
    seconds.ok_or_else(|| "expected a number of seconds above 0".to_owned())
}

/// The labels of one seed structure.
struct Part {
    name: String,
    size: Size,
    /// At most.
    labels: u64,
    /// What one of them takes.
    each: Option<CoreHours>,
}

/// The whole bill.
struct Planned {
    parts: Vec<Part>,
    /// At most; less than those of all seed structures where a key of the configuration limits the sum.
    labels: u64,
    limited_by: Option<String>,
    all: Option<CoreHours>,
    measured: String,
    disk: DiskForecast,
}

impl Plan {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let campaign = Campaign::load(&self.config)?;
        let planned = self.plan(&campaign)?;
        if self.json {
            print_json(&as_json(&planned))?;
        } else {
            print(|out| write(out, &self.config, &planned, self.all))?;
        }
        Ok(ExitStatus::Done)
    }

    fn plan(&self, campaign: &Campaign) -> Result<Planned, Failure> {
        let sizes: Vec<_> = campaign.label_sizes()?.iter().map(cost_size).collect();
        let (costs, measured) = self.costs(sizes.first())?;
        let config = &campaign.config;
        let (copies, per_seed) = (config.labels_of_each(), config.collect.per_seed.get());
        let labels = u64::from(copies) * u64::from(per_seed);
        let parts: Vec<_> = campaign
            .seed_structures
            .iter()
            .zip(sizes)
            .map(|(seed, size)| Part {
                name: seed.seed.name.clone(),
                size,
                labels,
                each: costs.as_ref().and_then(|costs| costs.predict([(size, 1)])),
            })
            .collect();
        let by_seeds = labels * parts.len() as u64;
        let most = config.most_structures().map(|most| u64::from(copies) * u64::from(most));
        let all = costs.and_then(|costs| costs.predict(parts.iter().map(|part| (part.size, part.labels))));
        // Which seed structures get fewer is not known before.
        let limited = most.filter(|most| *most < by_seeds);
        let share = limited.unwrap_or(by_seeds) as f64 / by_seeds.max(1) as f64;
        Ok(Planned {
            parts,
            labels: limited.unwrap_or(by_seeds),
            limited_by: limited.and(config.budget().structures_by),
            all: all.map(|all| all.scaled(share)),
            measured,
            disk: DiskForecast::from_campaign(campaign),
        })
    }

    /// What is known of costs, and from where.
    fn costs(&self, first: Option<&Size>) -> Result<(Option<CostEstimator>, String), Failure> {
        if let (Some(core_seconds), Some(size)) = (self.core_seconds, first) {
            let one = Measured { size: *size, core_seconds };
            let costs = CostEstimator::from_model(CostModel::fit(&[one], None));
            return Ok((Some(costs), "one label, as you say".into()));
        }
        let Some(like) = &self.like else {
            return Ok((None, String::new()));
        };
        let location = place::location(like)?;
        let costs = block_on(learn(&location))??;
        let shown = format!(
            "the {} newest {} of {location}",
            costs.measured(),
            if costs.measured() == 1 { "label" } else { "labels" }
        );
        Ok((Some(costs), shown))
    }
}

async fn learn(location: &Location) -> Result<CostEstimator, Failure> {
    let store = Store::open_read_only(location).await?;
    let none = || Failure::Input("--like: that campaign has no labels to learn from".into());
    let protocol = store.protocol_in_force().await?.ok_or_else(none)?;
    let costs = CostEstimator::from_store(&store, protocol.hash).await?;
    store.close().await;
    if costs.measured() == 0 { Err(none()) } else { Ok(costs) }
}

fn write(out: &mut dyn Write, path: &Path, planned: &Planned, all: bool) -> io::Result<()> {
    let Planned { parts, labels, limited_by, all: total, measured, disk } = planned;
    let limit = limited_by.as_ref().map_or(String::new(), |key| format!(", limited by {key}"));
    writeln!(out, "{}: at most {}{limit}", path.display(), count(*labels, "label"))?;
    match total {
        Some(hours) => {
            writeln!(out, "  labels   about {hours} if all of them are made, as {measured}")?;
            writeln!(
                out,
                "           one after the other on one core that is {} h",
                two_digits(hours.expected)
            )?;
        }
        None => writeln!(
            out,
            "  labels   their cost is unknown: name a campaign of the same kind with --like, or make one label \
             (calmwalk label --once) and give --core-seconds"
        )?,
    }
    writeln!(out, "  disk     {disk}")?;
    let mut table =
        Table::new(&["seed structure", ">labels", ">atoms", ">electrons", ">k-points", ">core-hours each"]);
    let shown = if all { parts.len() } else { SHOWN.min(parts.len()) };
    for Part { name, size, labels, each } in &parts[..shown] {
        table.push(vec![
            name.clone(),
            labels.to_string(),
            size.atoms.to_string(),
            size.electrons.map_or("–".into(), |electrons| electrons.to_string()),
            size.k_points.to_string(),
            each.map_or("–".into(), |hours| two_digits(hours.expected)),
        ]);
    }
    table.write(out)?;
    match parts.len() - shown {
        0 => Ok(()),
        more => writeln!(out, "… and {more} more: --all shows them"),
    }
}

fn as_json(planned: &Planned) -> serde_json::Value {
    let part = |part: &Part| {
        let Size { atoms, electrons, k_points } = part.size;
        json!({
            "seed_structure": part.name, "labels": part.labels, "atoms": atoms, "electrons": electrons,
            "k_points": k_points, "core_hours_each": part.each,
        })
    };
    json!({
        "labels": planned.labels, "limited_by": planned.limited_by, "core_hours": planned.all,
        "disk": planned.disk, "seed_structures": planned.parts.iter().map(part).collect::<Vec<_>>(),
    })
}
