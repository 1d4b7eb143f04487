//! `calmwalk status`

mod batch_jobs;
mod expected_end;
mod json;
mod label_summary;
mod mixture_summary;
pub mod page;
mod processes;
#[cfg(test)]
pub mod tests;
pub mod walks;

use std::io::{self, Write};

use serde_json::Value;
use store::{Candidates, Location, Status as CampaignStatus, Store};

use self::batch_jobs::BatchJobs;
pub use self::expected_end::ExpectedEnd;
use self::label_summary::LabelSummary;
pub use self::mixture_summary::MixtureSummary;
use self::page::Page;
use super::{CampaignLocation, ExitStatus, Failure, block_on};
use crate::budget_usage;
use crate::disk_forecast::{self, DiskForecast, megabytes};
use crate::output::{count, decimals, print, print_json};
use crate::provenance::Provenance;
use crate::walk_ends::WalkEnds;

/// Show the progress of a campaign
///
/// Shows walks, mixture, label queue, costs, processes and the expected end. Works on running and finished campaigns and on
/// backups. docs/status.md describes the JSON output.
#[derive(Debug, clap::Args)]
pub struct Status {
    #[command(flatten)]
    location: CampaignLocation,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Show all walks and processes instead of a selection that fits a screen (JSON always contains all)
    #[arg(long)]
    all: bool,
    /// Number of walks to show, or all: running walks with the largest γ first [default: as many as fit a screen]
    #[arg(long, value_name = "NUMBER", value_parser = page::parse_walks)]
    walks: Option<usize>,
}

impl Status {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let location = self.location.get()?;
        let snapshot = block_on(Snapshot::read_location(&location))??;
        let jobs = block_on(BatchJobs::query(&location))?;
        if self.json {
            print_json(&json::to_json(&snapshot, &jobs).map_err(Failure::failed)?)?;
        } else {
            let page = if self.all { Page::unlimited() } else { Page::unlimited().screen() };
            print(|out| snapshot.write(out, &jobs, page, self.walks))?;
        }
        Ok(ExitStatus::Done)
    }
}

/// The state of a campaign, read within a short time.
#[derive(Debug)]
pub struct Snapshot {
    campaign: store::Campaign,
    /// `None` for campaigns of early versions.
    origin: Option<Provenance>,
    status: CampaignStatus,
    mixture: MixtureSummary,
    disk: Disk,
    labels: LabelSummary,
    end: ExpectedEnd,
}

impl Snapshot {
    async fn read_location(location: &Location) -> Result<Self, Failure> {
        let store = Store::open_read_only(location).await?;
        let snapshot = Self::read(&store).await?;
        store.close().await;
        Ok(snapshot)
    }

    /// Reads the state of a campaign.
    pub async fn read(store: &Store) -> Result<Self, Failure> {
        let forecast = store.metadata(disk_forecast::METADATA_KEY).await?;
        let forecast = forecast.and_then(|text| serde_json::from_str(&text).ok());
        let (campaign, status) = (store.campaign().await?, store.status().await?);
        let labels = LabelSummary::read(store, &status).await?;
        let configuration: Value = serde_json::from_str(&campaign.configuration_in_force).unwrap_or_default();
        Ok(Self {
            end: ExpectedEnd::extrapolate(&status, &configuration, labels.bill()),
            origin: Provenance::read(store).await?,
            mixture: MixtureSummary(store.values().await?),
            disk: Disk { bytes: store.size().await?, forecast },
            campaign,
            status,
            labels,
        })
    }

    /// A description of what the campaign does.
    pub fn state(&self) -> String {
        processes::state(&self.status)
    }

    /// The output of `--all` in lines of at most `width` columns, without the jobs of a batch system.
    pub fn text(&self, width: usize) -> String {
        let (mut text, page) = (Vec::new(), Page { width, ..Page::unlimited() });
        // Writing to memory cannot fail.
        let _ = self.write(&mut text, &BatchJobs::None, page, None);
        String::from_utf8_lossy(&text).into_owned()
    }

    /// The JSON output (docs/status.md), without the jobs of a batch system.
    pub fn to_json(&self) -> serde_json::Result<Value> {
        json::to_json(self, &BatchJobs::None)
    }

    /// Identity and configuration.
    pub fn campaign(&self) -> &store::Campaign {
        &self.campaign
    }

    /// Counts, walks and processes.
    pub fn status(&self) -> &CampaignStatus {
        &self.status
    }

    /// Label failures by class.
    pub fn failures(&self) -> &[store::FailureCount] {
        &self.labels.failures
    }

    /// Fraction of the training atoms with γ > 1 under the newest mixture, if they are monitored.
    pub fn share_above_one(&self) -> Option<f64> {
        self.mixture.training_frames()["share_above_one"].as_f64()
    }

    /// Size of the store, bytes.
    pub fn bytes(&self) -> u64 {
        self.disk.bytes
    }

    /// The expected end.
    pub fn end(&self) -> &ExpectedEnd {
        &self.end
    }

    fn write(
        &self,
        out: &mut dyn Write,
        jobs: &BatchJobs,
        page: Page,
        walks: Option<usize>,
    ) -> io::Result<()> {
        let mut head = Vec::new();
        self.write_head(&mut head, &page)?;
        out.write_all(&head)?;
        let lines = head.iter().filter(|byte| **byte == b'\n').count();
        let page = page.fitted(lines, if matches!(jobs, BatchJobs::Known(_)) { 3 } else { 2 }, walks);
        walks::write(out, &self.status.walks, self.status.led, &page)?;
        processes::write(out, &self.status.processes, &page)?;
        jobs.write(out, &page)
    }

    fn write_head(&self, out: &mut dyn Write, page: &Page) -> io::Result<()> {
        let Self { campaign, origin, status, mixture, disk, labels, end } = self;
        let (name, mode) = (origin.as_ref().map_or("", |origin| &origin.name), &campaign.mode);
        let id = campaign.id.to_string();
        // Ids of candidates start with the same eight characters.
        let id = if page.is_unlimited() || name.is_empty() { &id[..] } else { &id[..8] };
        let separator = if name.is_empty() { "" } else { ", " };
        let round = if status.round == 0 { String::new() } else { format!(", round {}", status.round) };
        page.titled(out, "campaign", &format!("{name}{separator}{id}, {mode} mode{round}"))?;
        if let Some(origin) = origin.as_ref().filter(|_| page.is_unlimited()) {
            page.titled(out, "", &format!("configured by {}", origin.file.path))?;
        }
        page.titled(out, "state", &processes::state(status))?;
        let ends = WalkEnds::from_walks(&status.walks);
        page.titled(out, "walks", &describe_walks(status, &ends))?;
        if page.is_unlimited() {
            ends.lines().iter().try_for_each(|line| page.titled(out, "", line))?;
        } else {
            let advice =
                ends.causes().map(|(cause, _)| format!("{}: try {}", cause.in_words(), cause.advice()));
            advice.take(page.few).try_for_each(|line| page.titled(out, "", &line))?;
        }
        page.titled(out, "mixture", &format!("version {}", status.mixture_version))?;
        mixture.write(out, page, &campaign.mode)?;
        write_candidates(out, page, &status.candidates, labels.shared)?;
        labels.write(out, page, status)?;
        if let Some(budget) = budget_usage::describe(&status.budget) {
            page.titled(out, "budget", &budget)?;
        }
        page.titled(out, "disk", &disk.describe(page, status))?;
        match end.describe() {
            Some(end) => page.titled(out, "end", &end),
            None => Ok(()),
        }
    }
}

/// Disk use of the store.
#[derive(Debug, serde::Serialize)]
struct Disk {
    /// Current size.
    bytes: u64,
    /// Last forecast of the orchestrator for the end of the campaign.
    forecast: Option<DiskForecast>,
}

impl Disk {
    /// Expected size at the end, bytes. `None` if it is unknown or the campaign is finished.
    fn at_the_end(&self, status: &CampaignStatus) -> Option<u64> {
        let Candidates { accepted, control, .. } = status.candidates;
        let forecast = self.forecast.filter(|_| !status.finished)?;
        Some(self.bytes + forecast.remaining_bytes(accepted + control, self.bytes))
    }

    fn describe(&self, page: &Page, status: &CampaignStatus) -> String {
        let now = megabytes(self.bytes);
        let Some((forecast, end)) = self.forecast.zip(self.at_the_end(status)) else {
            return format!("{now} now");
        };
        let end = format!("{now} now; about {} at the end", megabytes(end));
        match page.is_unlimited() {
            true => {
                let declined = megabytes(forecast.declined);
                format!("{end}, plus up to {declined} for features of declined candidates")
            }
            false => end,
        }
    }
}

fn describe_walks(status: &CampaignStatus, ends: &WalkEnds) -> String {
    let under_way = status.walks.iter().filter(|walk| walk.is_active()).count();
    let state = if status.led { "active" } else { "not finished" };
    let ended = match ends.ended() {
        0 => "0 ended".to_owned(),
        ended => format!("{ended} ended ({})", ends.counts_by_end()),
    };
    let speed = status.steps_per_second.filter(|_| under_way > 0);
    let speed = speed.map_or(String::new(), |speed| format!("; {} steps/s", decimals(Some(speed), 1)));
    format!("{under_way} {state}, {ended}{speed}")
}

fn write_candidates(
    out: &mut dyn Write,
    page: &Page,
    candidates: &Candidates,
    shared: Option<u64>,
) -> io::Result<()> {
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
    page.titled(out, "candidates", &format!("{seen} seen, {accepted} accepted, {all} declined ({reasons})"))?;
    let shared = match shared {
        None | Some(0) => String::new(),
        Some(shared) if page.is_unlimited() => format!(
            " ({shared} of them also found by biased walks: {} in total)",
            count(accepted + control - shared, "label")
        ),
        Some(shared) => format!(" ({shared} also biased)"),
    };
    let control = count(*control, "control frame");
    page.titled(out, "", &format!("{control}{shared}; {refused_by_walkers} rejected by guards"))
}
