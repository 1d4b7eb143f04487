//! What came of a campaign, in numbers, and whether the grade told where the potential errs.

use std::fmt;

use calm::forgetting::GradeDistribution;
use store::{Status, Store, StoreError, Unlabelled};
use wire::ContentHash;

use crate::budget;
use crate::ends::Ends;
use crate::learned::{self, Grades, Learned};
use crate::output::{count, decimals};
use crate::unlabelled;

/// Seed structures with failed labels that are shown.
const SHOWN: usize = 8;

/// A finished campaign.
#[derive(Clone, Debug)]
pub struct Summary {
    status: Status,
    learned: Learned,
    /// Where labels finally failed.
    unlabelled: Vec<Unlabelled>,
    /// Grades of the training frames under the newest mixture, if they are watched.
    training: Option<GradeDistribution>,
}

/// Gathers the summary of a campaign, with the labels of one protocol.
pub async fn of(store: &Store, protocol: ContentHash) -> Result<Summary, StoreError> {
    let status = store.status().await?;
    let learned = learned::of(store, protocol).await?;
    let unlabelled = store.unlabelled(protocol, true).await?;
    let values = store.values().await?;
    let watched = values.iter().find(|(name, _)| name == "training_frames");
    let watched: Option<GradeDistribution> = watched.and_then(|(_, text)| serde_json::from_str(text).ok());
    Ok(Summary { status, learned, unlabelled, training: watched })
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { status: Status { candidates, labels, walks, mixture_version, .. }, learned, .. } = self;
        let of = |origin: &str| walks.iter().filter(|walk| walk.origin == origin).count();
        writeln!(f, "walks            {} biased, {} control", of("biased"), of("control"))?;
        let ends = Ends::of(walks);
        writeln!(f, "                 ended: {}", ends.in_words())?;
        ends.lines().iter().try_for_each(|line| writeln!(f, "                 {line}"))?;
        let declined = &candidates.declined;
        let all = declined.covered + declined.duplicate + declined.guard + declined.budget + declined.backlog;
        writeln!(
            f,
            "candidates       {} seen, {} accepted, {all} declined (covered {}, duplicate {}, guard {}, budget {}, backlog {})",
            candidates.seen,
            candidates.accepted,
            declined.covered,
            declined.duplicate,
            declined.guard,
            declined.budget,
            declined.backlog
        )?;
        writeln!(f, "                 {} refused by walkers' own guards", candidates.refused_by_walkers)?;
        let superseded = match labels.superseded {
            0 => String::new(),
            jobs => format!(", {jobs} superseded"),
        };
        let excluded = match labels.excluded {
            0 => String::new(),
            labels => format!(", {labels} excluded by hand"),
        };
        writeln!(
            f,
            "labels           {} biased and {} control structures labelled{}, {} failed, {} dropped{superseded}{excluded}",
            learned.biased.structures + learned.shared,
            learned.control.structures + learned.shared,
            both(learned),
            labels.failed,
            labels.dropped
        )?;
        write!(f, "{}", unlabelled::shown(&self.unlabelled, 17, SHOWN))?;
        if let Some(budget) = budget::shown(&self.status.budget) {
            writeln!(f, "budget           {budget}")?;
        }
        writeln!(f, "mixture          version {mixture_version}")?;
        if let Some(training) = &self.training {
            let (share, median) = (100.0 * training.share_above_one, training.median);
            writeln!(
                f,
                "                 training atoms under it: median γ {median:.2}, {share:.1} % above 1"
            )?;
        }
        writeln!(f, "force error of the potential against the grade of the original mixture:")?;
        writeln!(
            f,
            "           atoms   mean error   γ > 1   γ_nbr > 1   ρ(γ, error)   ρ(γ_nbr, error)   ROC-AUC(γ)   ROC-AUC(γ_nbr)"
        )?;
        writeln!(f, "  biased   {}", line(&self.learned.biased))?;
        writeln!(f, "  control  {}", line(&self.learned.control))?;
        let energies = self.learned.energies.summary();
        if let Some(line) = energies.line() {
            writeln!(f, "energy error of the potential: {line}")?;
        }
        writeln!(f, "{}", energies.offsets.note)
    }
}

/// That structures are counted twice which biased walks and controls both found.
fn both(learned: &Learned) -> String {
    match learned.shared {
        0 => String::new(),
        shared => {
            format!(" ({shared} of them both, and not compared: {})", count(learned.all.structures, "label"))
        }
    }
}

/// A line of numbers.
fn line(grades: &Grades) -> String {
    let Grades { gamma, gamma_nbr, .. } = grades;
    if gamma.atoms() == 0 {
        return "no labelled structures".to_owned();
    }
    let percent = |share: Option<f64>| decimals(share.map(|share| 100.0 * share), 0);
    format!(
        "{:>5}   {} eV/Å   {:>4} %      {:>4} %   {:>11}   {:>15}   {:>10}   {:>14}",
        gamma.atoms(),
        decimals(gamma.mean(), 3),
        percent(gamma.fraction_above(1.0)),
        percent(gamma_nbr.fraction_above(1.0)),
        decimals(gamma.spearman(), 2),
        decimals(gamma_nbr.spearman(), 2),
        decimals(gamma.roc_auc(), 2),
        decimals(gamma_nbr.roc_auc(), 2),
    )
}
