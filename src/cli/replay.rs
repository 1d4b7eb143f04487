//! `calmwalk replay`

use std::io::{self, Write};

use store::Store;

use super::{CampaignLocation, ExitStatus, Failure, block_on};
use crate::output::{Table, count, decimals, print, print_json};
use crate::replay::{self, FateChange, FateCounts, MissingFeatures, RelocatedFiles, Report, RuleOverride};

/// Changed decisions shown; JSON has all.
const SHOWN: usize = 20;

/// Put a campaign's recorded candidates before its selector again, by its own rules or by others
///
/// No dynamics and no labels, and nothing is written. With nothing set every decision must come out as it was recorded,
/// to the last digit, and so must the mixture; otherwise the first difference is shown, and the exit code is 1.
///
/// With other rules: walks are as they were recorded. What cannot be known is which structures walkers would have
/// offered under them: a looser rule shows no structure that was never offered, a walk that would have gone on is not
/// continued, and one that would have been steered by another mixture went where it went.
#[derive(Debug, clap::Args)]
pub struct Replay {
    #[command(flatten)]
    location: CampaignLocation,
    /// Another value (TOML) for a key that acts on the selector, as collect.when.threshold=2.0; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<RuleOverride>,
    #[command(flatten)]
    moved: RelocatedFiles,
    /// Print JSON, with all decisions that changed
    #[arg(long)]
    json: bool,
}

impl Replay {
    pub fn run(self) -> Result<ExitStatus, Failure> {
        let report = block_on(self.replay())??;
        if self.json {
            print_json(&report)?;
        } else {
            print(|out| write_report(out, &report))?;
        }
        match report.difference {
            None => Ok(ExitStatus::Done),
            Some(difference) => Err(Failure::Failed(format!(
                "decision {} does not come out as it was recorded: {} was {}, and is {} now",
                difference.decision, difference.what, difference.recorded, difference.now
            ))),
        }
    }

    async fn replay(&self) -> Result<Report, Failure> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let report = replay::replay(&store, &self.settings, &self.moved).await;
        store.close().await;
        report
    }
}

fn write_report(out: &mut dyn Write, report: &Report) -> io::Result<()> {
    let Report { recorded, replayed, seconds, before, now, .. } = report;
    writeln!(out, "replayed    {replayed} of {recorded} decisions in {seconds:.2} s")?;
    for (key, value) in &report.set {
        writeln!(out, "            {key} = {value}")?;
    }
    if let Some(MissingFeatures { decision, candidate, walk, step }) = &report.stopped {
        writeln!(
            out,
            "            no further: the features of candidate {candidate} (decision {decision}, walk {walk},"
        )?;
        writeln!(
            out,
            "            step {step}) were not kept; collect.declined_features_mb says how many are"
        )?;
    }
    if report.set.is_empty() {
        return write_sameness(out, report);
    }
    write_counts(out, "before", before)?;
    write_counts(out, "now", now)?;
    if report.walks_cut_short > 0 {
        let walks = report.walks_cut_short;
        writeln!(
            out,
            "            {} that ended with what they had collected would go on: to where is not known",
            count(walks, "walk")
        )?;
    }
    writeln!(
        out,
        "            only structures that walkers offered are known, and they walked under the rules before"
    )?;
    write_changes(out, "accepted before, and not now", &report.no_longer_accepted)?;
    write_changes(out, "accepted now, and not before", &report.newly_accepted)
}

fn write_sameness(out: &mut dyn Write, report: &Report) -> io::Result<()> {
    if report.difference.is_some() {
        if report.other_processor {
            writeln!(
                out,
                "            the campaign began on another kind of processor, which has other last digits"
            )?;
        }
        return Ok(());
    }
    let FateCounts { candidates, accepted, mixture_version, .. } = report.now;
    writeln!(
        out,
        "            every one as it was recorded, to the last digit: {accepted} of {candidates} accepted"
    )?;
    if report.same_mixture == Some(true) {
        writeln!(
            out,
            "            and the mixture, version {mixture_version}, is the stored one, byte for byte"
        )?;
    }
    Ok(())
}

fn write_counts(out: &mut dyn Write, when: &str, counts: &FateCounts) -> io::Result<()> {
    let FateCounts { candidates, accepted, declined, mixture_version } = counts;
    let reasons: Vec<_> = declined.iter().map(|(reason, count)| format!("{count} {reason}")).collect();
    let reasons = if reasons.is_empty() { String::new() } else { format!(" ({})", reasons.join(", ")) };
    writeln!(
        out,
        "{when:<11} {accepted} of {candidates} candidates accepted, {} declined{reasons}; mixture version \
         {mixture_version}",
        candidates - accepted
    )
}

fn write_changes(out: &mut dyn Write, title: &str, changes: &[FateChange]) -> io::Result<()> {
    if changes.is_empty() {
        return Ok(());
    }
    writeln!(out, "\n{title}:")?;
    let mut table =
        Table::new(&[">decision", "candidate", ">walk", ">step", ">γ_max before", ">now", "declined for"]);
    for change in changes.iter().take(SHOWN) {
        table.push(vec![
            change.decision.to_string(),
            change.candidate.clone(),
            change.walk.to_string(),
            change.step.to_string(),
            decimals(change.gamma_max.0, 3),
            decimals(change.gamma_max.1, 3),
            change.reason.clone(),
        ]);
    }
    table.write(out)?;
    let more = changes.len().saturating_sub(SHOWN);
    if more > 0 { writeln!(out, "… and {more} more: --json has all") } else { Ok(()) }
}
