//! `calmwalk status`

mod end;
mod jobs;
mod json;
mod labels;
pub mod page;
mod processes;
#[cfg(test)]
pub mod tests;
mod values;
pub mod walks;

use std::io::{self, Write};

use serde_json::Value;
use store::{Candidates, Location, Status as Standing, Store};

pub use self::end::End;
use self::jobs::Jobs;
use self::labels::LabelsSoFar;
use self::page::Page;
pub use self::values::Values;
use super::{CampaignLocation, Ended, Failure, block_on};
use crate::budget;
use crate::ends::Ends;
use crate::forecast::{self, Forecast, megabytes};
use crate::origin::Origin;
use crate::output::{count, decimals, print, print_json};

/// Show how a campaign stands
///
/// Works while it runs and after it ended, also on a copy, and changes nothing. docs/status.md says what the JSON means.
#[derive(Debug, clap::Args)]
pub struct Status {
    #[command(flatten)]
    location: CampaignLocation,
    /// Print JSON
    #[arg(long)]
    json: bool,
    /// Show every walk and process, not only some of them (JSON always has all)
    #[arg(long)]
    all: bool,
    /// Show so many walks, or all: first those that advance, the newest structures before the others
    #[arg(long, value_name = "NUMBER", value_parser = page::number)]
    walks: Option<usize>,
}

impl Status {
    pub fn run(self) -> Result<Ended, Failure> {
        let location = self.location.get()?;
        let snapshot = block_on(Snapshot::at(&location))??;
        let jobs = block_on(Jobs::of(&location))?;
        if self.json {
            print_json(&json::of(&snapshot, &jobs).map_err(Failure::failed)?)?;
        } else {
            let page = if self.all { Page::of_all() } else { Page::of_all().screen() };
            print(|out| snapshot.write(out, &jobs, page, self.walks))?;
        }
        Ok(Ended::Done)
    }
}

/// What the store says, at one instant or almost.
#[derive(Debug)]
pub struct Snapshot {
    campaign: store::Campaign,
    /// None of a campaign of an early version.
    origin: Option<Origin>,
    standing: Standing,
    values: Values,
    disk: Disk,
    labels: LabelsSoFar,
    end: End,
}

impl Snapshot {
    async fn at(location: &Location) -> Result<Self, Failure> {
        let store = Store::open_read_only(location).await?;
        let snapshot = Self::of(&store).await?;
        store.close().await;
        Ok(snapshot)
    }

    /// Reads it.
    pub async fn of(store: &Store) -> Result<Self, Failure> {
        let forecast = store.metadata(forecast::NOTE).await?;
        let forecast = forecast.and_then(|text| serde_json::from_str(&text).ok());
        let (campaign, standing) = (store.campaign().await?, store.status().await?);
        let labels = LabelsSoFar::of(store, &standing).await?;
        let configuration: Value = serde_json::from_str(&campaign.configuration_in_force).unwrap_or_default();
        Ok(Self {
            end: End::of(&standing, &configuration, labels.bill()),
            origin: Origin::of(store).await?,
            values: Values(store.values().await?),
            disk: Disk { bytes: store.size().await?, forecast },
            campaign,
            standing,
            labels,
        })
    }

    /// What it does, in words.
    pub fn state(&self) -> String {
        processes::state(&self.standing)
    }

    /// All that the command prints with `--all`, in lines of at most `width` columns; without jobs of a batch system.
    pub fn text(&self, width: usize) -> String {
        let (mut text, page) = (Vec::new(), Page { width, ..Page::of_all() });
        // Memory takes everything.
        let _ = self.write(&mut text, &Jobs::None, page, None);
        String::from_utf8_lossy(&text).into_owned()
    }

    /// As docs/status.md has it, without jobs of a batch system.
    pub fn to_json(&self) -> serde_json::Result<Value> {
        json::of(self, &Jobs::None)
    }

    /// The campaign.
    pub fn campaign(&self) -> &store::Campaign {
        &self.campaign
    }

    /// How it stands.
    pub fn standing(&self) -> &Standing {
        &self.standing
    }

    /// Failures of labels by class.
    pub fn failures(&self) -> &[store::FailureCount] {
        &self.labels.failures
    }

    /// Share of the training atoms with γ > 1 under the newest mixture, if they are watched.
    pub fn share_above_one(&self) -> Option<f64> {
        self.values.training_frames()["share_above_one"].as_f64()
    }

    /// Size of the store, bytes.
    pub fn bytes(&self) -> u64 {
        self.disk.bytes
    }

    /// When it is expected to end.
    pub fn end(&self) -> &End {
        &self.end
    }

    fn write(&self, out: &mut dyn Write, jobs: &Jobs, page: Page, walks: Option<usize>) -> io::Result<()> {
        let mut head = Vec::new();
        self.write_head(&mut head, &page)?;
        out.write_all(&head)?;
        let lines = head.iter().filter(|byte| **byte == b'\n').count();
        let page = page.fitted(lines, if matches!(jobs, Jobs::Known(_)) { 3 } else { 2 }, walks);
        walks::write(out, &self.standing.walks, self.standing.led, &page)?;
        processes::write(out, &self.standing.processes, &page)?;
        jobs.write(out, &page)
    }

    fn write_head(&self, out: &mut dyn Write, page: &Page) -> io::Result<()> {
        let Self { campaign, origin, standing, values, disk, labels, end } = self;
        let (name, mode) = (origin.as_ref().map_or("", |origin| &origin.name), &campaign.mode);
        let id = campaign.id.to_string();
        // The names of candidates begin with as much of it.
        let id = if page.has_all() || name.is_empty() { &id[..] } else { &id[..8] };
        let separator = if name.is_empty() { "" } else { ", " };
        let round = if standing.round == 0 { String::new() } else { format!(", round {}", standing.round) };
        page.titled(out, "campaign", &format!("{name}{separator}{id}, {mode} mode{round}"))?;
        if let Some(origin) = origin.as_ref().filter(|_| page.has_all()) {
            page.titled(out, "", &format!("by {}", origin.file.path))?;
        }
        page.titled(out, "state", &processes::state(standing))?;
        let ends = Ends::of(&standing.walks);
        page.titled(out, "walks", &walks_in_words(standing, &ends))?;
        if page.has_all() {
            ends.lines().iter().try_for_each(|line| page.titled(out, "", line))?;
        } else {
            let advice =
                ends.causes().map(|(cause, _)| format!("{}: try {}", cause.in_words(), cause.advice()));
            advice.take(page.few).try_for_each(|line| page.titled(out, "", &line))?;
        }
        page.titled(out, "mixture", &format!("version {}", standing.mixture_version))?;
        values.write(out, page, &campaign.mode)?;
        write_candidates(out, page, &standing.candidates, labels.shared)?;
        labels.write(out, page, standing)?;
        if let Some(budget) = budget::shown(&standing.budget) {
            page.titled(out, "budget", &budget)?;
        }
        page.titled(out, "disk", &disk.in_words(page, standing))?;
        match end.shown() {
            Some(end) => page.titled(out, "end", &end),
            None => Ok(()),
        }
    }
}

/// What the store takes.
#[derive(Debug, serde::Serialize)]
struct Disk {
    /// Now.
    bytes: u64,
    /// At the end, as the leader of the campaign last reckoned.
    forecast: Option<Forecast>,
}

impl Disk {
    /// At the end, bytes; none if it is unknown, or the campaign is over.
    fn at_the_end(&self, status: &Standing) -> Option<u64> {
        let Candidates { accepted, control, .. } = status.candidates;
        let forecast = self.forecast.filter(|_| !status.finished)?;
        Some(self.bytes + forecast.still_to_come(accepted + control, self.bytes))
    }

    fn in_words(&self, page: &Page, status: &Standing) -> String {
        let now = megabytes(self.bytes);
        let Some((forecast, end)) = self.forecast.zip(self.at_the_end(status)) else {
            return format!("{now} now");
        };
        let end = format!("{now} now; about {} when all is collected", megabytes(end));
        match page.has_all() {
            true => {
                let declined = megabytes(forecast.declined);
                format!("{end}, besides up to {declined} of features of declined candidates")
            }
            false => end,
        }
    }
}

fn walks_in_words(status: &Standing, ends: &Ends) -> String {
    let under_way = status.walks.iter().filter(|walk| walk.is_active()).count();
    let are = if status.led { "under way" } else { "not finished" };
    let ended = match ends.ended() {
        0 => "0 ended".to_owned(),
        ended => format!("{ended} ended ({})", ends.without_causes()),
    };
    let pace = status.steps_per_second.filter(|_| under_way > 0);
    let pace = pace.map_or(String::new(), |pace| format!("; {} steps/s", decimals(Some(pace), 1)));
    format!("{under_way} {are}, {ended}{pace}")
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
        Some(shared) if page.has_all() => format!(
            " ({shared} of them structures of biased walks too: {} for all)",
            count(accepted + control - shared, "label")
        ),
        Some(shared) => format!(" ({shared} also biased)"),
    };
    let control = count(*control, "control frame");
    page.titled(out, "", &format!("{control}{shared}; {refused_by_walkers} refused by guards"))
}
