//! `calmwalk replay`

use std::io::{self, Write};

use store::Store;

use super::{CampaignArgs, CommandError, ExitStatus, block_on};
use crate::output::{TextTable, count, decimals, print, print_json};
use crate::replay::{
    self, FateChange, FateCounts, MissingFeatures, RelocatedFilesArgs, ReplayReport, RuleOverride,
};

/// Changed decisions printed without --json.
const SHOWN: usize = 20;

/// Replay a campaign's decisions, to verify them or to test other selection rules
///
/// Passes the recorded candidates to the selector again, without dynamics or labels, and changes nothing. Without --set, expects every
/// decision and the mixture bit by bit as recorded; at the first difference, prints it and exits with code 1.
///
/// With --set, shows which candidates other rules would accept. The walks stay as recorded, which limits the result: a looser rule does
/// not find structures that walkers never offered, walks that would have continued do not continue, and trajectories do not react to the
/// changed mixture.
#[derive(Debug, clap::Args)]
pub struct ReplayArgs {
    #[command(flatten)]
    location: CampaignArgs,
    /// Change a configuration key of the selector to a value (TOML), such as collect.criterion.threshold=2.0; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<RuleOverride>,
    #[command(flatten)]
    moved: RelocatedFilesArgs,
    /// Print JSON, with all changed decisions
    #[arg(long)]
    json: bool,
}

impl ReplayArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let report = block_on(self.replay())??;
        if self.json {
            print_json(&report)?;
        } else {
            print(|out| write_report(out, &report))?;
        }
        match report.difference {
            None => Ok(ExitStatus::Done),
            Some(difference) => Err(CommandError::Failed(format!(
                "decision {} is not reproduced: {} was {}, and is now {}",
                difference.decision, difference.what, difference.recorded, difference.now
            ))),
        }
    }

    async fn replay(&self) -> Result<ReplayReport, CommandError> {
        let store = Store::open_read_only(&self.location.get()?).await?;
        let report = replay::replay(&store, &self.settings, &self.moved).await;
        store.close().await;
        report
    }
}

fn write_report(out: &mut dyn Write, report: &ReplayReport) -> io::Result<()> {
    let ReplayReport { recorded, replayed, seconds, before, now, .. } = report;
    writeln!(out, "replayed    {replayed} of {recorded} decisions in {seconds:.2} s")?;
    for (key, value) in &report.set {
        writeln!(out, "            {key} = {value}")?;
    }
    if let Some(MissingFeatures { decision, candidate, walk, step }) = &report.stopped {
        writeln!(
            out,
            "            stopped: the features of candidate {candidate} (decision {decision}, walk {walk},"
        )?;
        writeln!(out, "            step {step}) were not stored (limit: collect.declined_features_mb)")?;
    }
    if report.set.is_empty() {
        return write_verification(out, report);
    }
    write_counts(out, "before", before)?;
    write_counts(out, "now", now)?;
    if report.walks_cut_short > 0 {
        let walks = report.walks_cut_short;
        writeln!(
            out,
            "            {} that reached a limit of collected structures would continue; their further path is unknown",
            count(walks, "walk")
        )?;
    }
    writeln!(out, "            limited to structures that walkers offered under the recorded rules")?;
    write_changes(out, "no longer accepted", &report.no_longer_accepted)?;
    write_changes(out, "newly accepted", &report.newly_accepted)
}

fn write_verification(out: &mut dyn Write, report: &ReplayReport) -> io::Result<()> {
    if report.difference.is_some() {
        if report.other_processor {
            writeln!(
                out,
                "            the campaign was started on another type of processor, whose floating-point results differ"
            )?;
        }
        return Ok(());
    }
    let FateCounts { candidates, accepted, mixture_version, .. } = report.now;
    writeln!(out, "            all reproduced bit by bit: {accepted} of {candidates} candidates accepted")?;
    if report.same_mixture == Some(true) {
        writeln!(out, "            mixture version {mixture_version} is identical to the stored one")?;
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
    let mut table = TextTable::new(&[
        ">decision",
        "candidate",
        ">walk",
        ">step",
        ">γ_max before",
        ">now",
        "decline reason",
    ]);
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
    if more > 0 { writeln!(out, "… and {more} more (use --json)") } else { Ok(()) }
}
