//! `calmwalk status`

mod jobs;
mod labels;
mod processes;
mod values;

use std::io::{self, Write};

use store::{Candidates, Labels, Location, Status as Standing, Store, WalkStatus};

use self::jobs::Jobs;
use self::labels::LabelsSoFar;
use self::values::Values;
use super::{CampaignLocation, Ended, Failure, block_on};
use crate::budget;
use crate::forecast::{self, Forecast, megabytes};
use crate::output::{Table, decimals, print, print_json};

/// Walks, and processes, shown unless all are asked for.
const SHOWN: usize = 20;

/// Show how a campaign stands
///
/// Works while it runs and after it ended, and changes nothing.
#[derive(Debug, clap::Args)]
pub struct Status {
    #[command(flatten)]
    location: CampaignLocation,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Show every walk and process, not only 20 of them (JSON always has all)
    #[arg(long)]
    all: bool,
}

impl Status {
    pub fn run(self) -> Result<Ended, Failure> {
        let location = self.location.get()?;
        let Read { campaign, standing, values, disk, labels } = block_on(self.read(&location))??;
        let jobs = block_on(Jobs::of(&location))?;
        if self.json {
            let mut json = serde_json::to_value(&standing).map_err(Failure::failed)?;
            json["campaign"] = campaign.id.to_string().into();
            json["mode"] = campaign.mode.clone().into();
            json["training_frames"] = values.training_frames();
            json["staleness"] = values.staleness();
            json["disk"] = serde_json::to_value(&disk).map_err(Failure::failed)?;
            labels.add_to(&mut json, standing.budget.used.core_hours);
            jobs.add_to(&mut json);
            print_json(&json)?;
        } else {
            print(|out| {
                write_status(out, &campaign, &standing, &values, &labels, &disk, self.all)?;
                jobs.write(out, self.all)
            })?;
        }
        Ok(Ended::Done)
    }

    async fn read(&self, location: &Location) -> Result<Read, Failure> {
        let store = Store::open_read_only(location).await?;
        let forecast = store.note(forecast::NOTE).await?;
        let forecast = forecast.and_then(|text| serde_json::from_str(&text).ok());
        let read = Read {
            campaign: store.campaign().await?,
            standing: store.status().await?,
            values: Values(store.values().await?),
            disk: Disk { bytes: store.size().await?, forecast },
            labels: LabelsSoFar::of(&store).await?,
        };
        store.close().await;
        Ok(read)
    }
}

/// What the store says.
struct Read {
    campaign: store::Campaign,
    standing: Standing,
    values: Values,
    disk: Disk,
    labels: LabelsSoFar,
}

fn write_status(
    out: &mut dyn Write,
    campaign: &store::Campaign,
    status: &Standing,
    values: &Values,
    labels: &LabelsSoFar,
    disk: &Disk,
    all: bool,
) -> io::Result<()> {
    let walks = &status.walks;
    let under_way = walks.iter().filter(|walk| is_under_way(walk)).count();
    writeln!(out, "campaign    {}, {} mode", campaign.id, campaign.mode)?;
    writeln!(out, "state       {}", processes::state(status))?;
    writeln!(
        out,
        "walks       {under_way} under way, {} ended; round {}",
        walks.len() - under_way,
        status.round
    )?;
    writeln!(out, "mixture     version {}", status.mixture_version)?;
    values.write(out, &campaign.mode)?;
    write_candidates(out, &status.candidates)?;
    write_labels(out, &status.labels, status.imported)?;
    labels.write(out, status.budget.used.core_hours, all)?;
    if let Some(budget) = budget::shown(&status.budget) {
        writeln!(out, "budget      {budget}")?;
    }
    write_disk(out, disk)?;
    write_walks(out, walks, all)?;
    processes::write(out, &status.processes, all)
}

/// What the store takes.
#[derive(Debug, serde::Serialize)]
struct Disk {
    /// Now.
    bytes: u64,
    /// At the end, as the leader of the campaign last reckoned.
    forecast: Option<Forecast>,
}

fn write_disk(out: &mut dyn Write, disk: &Disk) -> io::Result<()> {
    let now = megabytes(disk.bytes);
    match &disk.forecast {
        Some(forecast) => writeln!(out, "disk        {now} now; {forecast}"),
        None => writeln!(out, "disk        {now} now"),
    }
}

fn write_candidates(out: &mut dyn Write, candidates: &Candidates) -> io::Result<()> {
    let Candidates { seen, accepted, declined, control, refused_by_walkers } = candidates;
    let reasons = [
        ("covered", declined.covered),
        ("duplicate", declined.duplicate),
        ("guard", declined.guard),
        ("budget", declined.budget),
        ("backlog", declined.backlog),
    ];
    let all: u64 = reasons.iter().map(|(_, count)| count).sum();
    let reasons = reasons.map(|(reason, count)| format!("{count} {reason}")).join(", ");
    writeln!(out, "candidates  {seen} seen, {accepted} accepted, {all} declined ({reasons})")?;
    writeln!(out, "            {control} control frames; {refused_by_walkers} refused by walkers' guards")
}

fn write_labels(out: &mut dyn Write, labels: &Labels, imported: u64) -> io::Result<()> {
    let Labels { queued, leased, labelled, failed, dropped } = labels;
    writeln!(
        out,
        "labels      {queued} queued, {leased} leased, {labelled} labelled, {failed} failed, {dropped} dropped; \
         {imported} structures imported"
    )
}

fn is_under_way(walk: &WalkStatus) -> bool {
    matches!(walk.state.as_str(), "waiting" | "running")
}

/// Those under way first, then those that began last; in order of their numbers.
fn shown(walks: &[WalkStatus], all: bool) -> Vec<&WalkStatus> {
    let mut shown: Vec<_> = walks.iter().collect();
    if !all && shown.len() > SHOWN {
        shown.sort_by_key(|walk| (!is_under_way(walk), std::cmp::Reverse(walk.walk)));
        shown.truncate(SHOWN);
        shown.sort_by_key(|walk| walk.walk);
    }
    shown
}

fn write_walks(out: &mut dyn Write, walks: &[WalkStatus], all: bool) -> io::Result<()> {
    if walks.is_empty() {
        return Ok(());
    }
    let shown = shown(walks, all);
    let mut table = Table::new(&[
        ">walk",
        "seed structure",
        "origin",
        "state",
        ">step",
        ">segment",
        ">τ",
        ">T (K)",
        ">V/V₀",
        ">γ_max",
        ">accepted",
        ">refused",
        ">returns",
    ]);
    for walk in &shown {
        table.push(vec![
            walk.walk.to_string(),
            walk.seed_structure.clone(),
            walk.origin.clone(),
            walk.state.replace('_', " "),
            walk.step.to_string(),
            walk.segment.to_string(),
            decimals(walk.tau, 3),
            decimals(walk.temperature, 0),
            decimals(walk.relative_volume, 3),
            // Walks without bias are not graded.
            decimals(walk.gamma_max.filter(|gamma| *gamma > 0.0), 2),
            walk.accepted.to_string(),
            walk.refused.to_string(),
            walk.returns.to_string(),
        ]);
    }
    writeln!(out)?;
    table.write(out)?;
    if shown.len() < walks.len() {
        writeln!(out, "… and {} more walks: --all shows them", walks.len() - shown.len())?;
    }
    Ok(())
}
