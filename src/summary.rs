//! Summary of a finished campaign: its numbers, and whether the grade predicted the potential's errors.

use std::fmt;

use calm::forgetting::GradeDistribution;
use monitor::end_reason::CampaignEnd;
use monitor::label_statistics::comparison::{ComparedGroup, WalkComparison};
use monitor::label_statistics::{self, ErrorsByGrade, LARGE_FORCE_ERROR, LabelStatistics};
use monitor::versions::{CampaignVersions, newest_with_labels};
use monitor::walk_ends::WalkEnds;
use store::{CampaignStatus, Store, StoreError, Unlabelled};
use wire::ContentHash;

use crate::output::{TextTable, count, decimals};
use crate::wording::comparison::{estimate, intervals};
use crate::wording::{budget, candidates, end_reason, energies, unlabelled, versions, walk_ends};

/// Largest number of seed structures with failed labels to show.
const MAX_SHOWN: usize = 8;

/// Summary of a campaign.
#[derive(Clone, Debug)]
pub struct Summary {
    status: CampaignStatus,
    /// Why it ended.
    end: Option<CampaignEnd>,
    statistics: LabelStatistics,
    comparison: WalkComparison,
    /// Structures whose labels failed for good.
    unlabelled: Vec<Unlabelled>,
    /// Grades of the training frames under the newest mixture, if they are monitored.
    training: Option<GradeDistribution>,
    /// Versions of the potential.
    versions: CampaignVersions,
}

/// Reads the summary of a campaign with the labels of one protocol.
pub async fn read(store: &Store, protocol: ContentHash) -> Result<Summary, StoreError> {
    let status = store.status().await?;
    let end = CampaignEnd::read(store, &status).await?;
    let statistics = label_statistics::read(store, protocol, None).await?;
    let comparison = statistics.comparison();
    let version = newest_with_labels(store, protocol, &store.walk_versions().await?).await?;
    let unlabelled = store.unlabelled(protocol, version, true).await?;
    let values = store.values().await?;
    let watched = values.iter().find(|(name, _)| name == "training_frames");
    let watched: Option<GradeDistribution> = watched.and_then(|(_, text)| serde_json::from_str(text).ok());
    let versions = CampaignVersions::read(store, &status, &values).await?;
    Ok(Summary { status, end, statistics, comparison, unlabelled, training: watched, versions })
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.write_walks(f)?;
        self.write_end(f)?;
        self.write_candidates(f)?;
        self.write_labels(f)?;
        if let Some(budget) = budget::describe(&self.status.budget) {
            writeln!(f, "budget           {budget}")?;
        }
        self.write_mixture(f)?;
        self.write_versions(f)?;
        self.write_errors(f)
    }
}

impl Summary {
    fn write_walks(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let walks = &self.status.walks;
        let of = |origin: &str| walks.iter().filter(|walk| walk.origin == origin).count();
        writeln!(f, "walks            {} biased, {} control", of("biased"), of("control"))?;
        let ends = WalkEnds::from_walks(walks);
        writeln!(f, "                 ended: {}", walk_ends::all(&ends))?;
        walk_ends::early_ends(&ends).iter().try_for_each(|line| writeln!(f, "                 {line}"))
    }

    fn write_end(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let end = self.end.as_ref().map(end_reason::describe);
        end.map_or(Ok(()), |end| writeln!(f, "end              {end}"))
    }

    fn write_candidates(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let found = &self.status.candidates;
        let declined = candidates::declined(&found.declined, false);
        writeln!(f, "candidates       {} seen, {} accepted{declined}", found.seen, found.accepted)?;
        match found.rejected_by_guards {
            0 => Ok(()),
            rejected => writeln!(f, "                 {rejected} rejected by guards"),
        }
    }

    fn write_labels(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (labels, statistics) = (&self.status.labels, &self.statistics);
        let superseded = match labels.superseded {
            0 => String::new(),
            jobs => format!(", {jobs} superseded"),
        };
        let excluded = match labels.excluded {
            0 => String::new(),
            labels => format!(", {labels} excluded by hand"),
        };
        let part =
            |number: u64, what: &str| if number > 0 { format!(", {number} {what}") } else { String::new() };
        let (failed, dropped) = (part(labels.failed, "failed"), part(labels.dropped, "dropped"));
        writeln!(
            f,
            "labels           {}{} biased and {} control structures labelled{}{failed}{dropped}{superseded}{excluded}",
            versions_note(statistics),
            statistics.biased.structures + statistics.shared,
            statistics.control.structures + statistics.shared,
            shared_note(statistics),
        )?;
        write!(f, "{}", unlabelled::describe(&self.unlabelled, 17, MAX_SHOWN))
    }

    fn write_mixture(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "mixture          version {}", self.status.mixture_version)?;
        if let Some(training) = &self.training {
            let (share, median) = (100.0 * training.share_above_one, training.median);
            writeln!(
                f,
                "                 training atoms under it: median γ {median:.2}, {share:.1} % above 1"
            )?;
        }
        Ok(())
    }

    fn write_versions(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(in_force) = self.versions.in_force() else { return Ok(()) };
        writeln!(f, "potential        {}", versions::in_force(&self.versions, in_force))?;
        for refused in self.versions.all.iter().filter(|version| !version.is_registered()) {
            writeln!(f, "                 {}", versions::refused(refused))?;
        }
        versions::table(&self.versions).lines().try_for_each(|line| writeln!(f, "  {line}"))
    }

    fn write_errors(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let version = match self.statistics.version {
            Some(version) => format!("version {version} of the potential"),
            None => "the potential".to_owned(),
        };
        writeln!(f, "force error of {version} against the grade of the original mixture:")?;
        let mut table = TextTable::new(&[
            "",
            ">atoms",
            ">mean error (eV/Å)",
            ">γ > 1",
            ">γ_nbr > 1",
            ">ρ(γ, error)",
            ">ρ(γ_nbr, error)",
            ">ROC-AUC(γ)",
            ">ROC-AUC(γ_nbr)",
        ]);
        let WalkComparison { pooled, .. } = &self.comparison;
        table.push(line("biased", &self.statistics.biased, &pooled.biased));
        table.push(line("control", &self.statistics.control, &pooled.control));
        table.lines().try_for_each(|line| writeln!(f, "  {line}"))?;
        writeln!(f, "  {}", intervals(&pooled.all.units, &self.comparison))?;
        let energy = self.statistics.energies.summary();
        if let Some(line) = energies::errors(&energy) {
            writeln!(f, "energy error of the potential: {line}")?;
        }
        writeln!(f, "{}", energies::offsets(&energy.offsets))
    }
}

/// The labels of all versions of the potential, before those of the version that the statistics are of.
fn versions_note(statistics: &LabelStatistics) -> String {
    let Some(version) = statistics.version else { return String::new() };
    let all: u64 = statistics.by_version.values().map(|grades| grades.structures).sum();
    format!("{} in all; of walks with version {version}: ", count(all, "label"))
}

/// Says that structures found by both biased and control walks are counted twice.
fn shared_note(statistics: &LabelStatistics) -> String {
    match statistics.shared {
        0 => String::new(),
        shared => {
            format!(
                " ({shared} of them by both and not compared: {})",
                count(statistics.all.structures, "label")
            )
        }
    }
}

/// A line of the comparison.
fn line(origin: &str, grades: &ErrorsByGrade, group: &ComparedGroup) -> Vec<String> {
    let ErrorsByGrade { gamma, gamma_nbr, .. } = grades;
    if gamma.atoms() == 0 {
        return vec![origin.to_owned(), "none".to_owned()];
    }
    let percent =
        |share: Option<f64>| share.map_or("–".to_owned(), |share| format!("{:.0} %", 100.0 * share));
    let mut cells = vec![
        origin.to_owned(),
        gamma.atoms().to_string(),
        decimals(gamma.mean(), 3),
        percent(gamma.fraction_above(1.0)),
        percent(gamma_nbr.fraction_above(1.0)),
    ];
    let areas = [&group.gamma, &group.gamma_nbr].map(|grade| grade.area_above(LARGE_FORCE_ERROR));
    let estimates = [group.gamma.spearman, group.gamma_nbr.spearman].into_iter().chain(areas);
    cells.extend(estimates.map(|found| estimate(&found, 1.0, 2)));
    cells
}
