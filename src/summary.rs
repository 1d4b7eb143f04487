//! What came of a campaign, in numbers, and whether the grade told where the potential errs.

use std::fmt;

use atoms::cell::{norm, sub};
use calm::watch::GradeDistribution;
use store::{ExportFilter, ExportSource, Status, Store, StoreError};
use wire::{ContentHash, Origin};

use crate::budget;

/// Rows read from the store at a time.
const PAGE: u32 = 256;

/// Grades and force errors of labelled atoms, of one origin.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ForceErrors {
    /// Labelled structures.
    pub structures: usize,
    /// |F_model − F_label| of every atom, eV/Å.
    pub errors: Vec<f64>,
    /// γ under the original mixture.
    pub gamma: Vec<f64>,
    /// γ_nbr under the original mixture.
    pub gamma_nbr: Vec<f64>,
}

/// A finished campaign.
#[derive(Clone, Debug)]
pub struct Summary {
    status: Status,
    biased: ForceErrors,
    control: ForceErrors,
    /// Grades of the training frames under the newest mixture, if they are watched.
    training: Option<GradeDistribution>,
}

/// Gathers the summary of a campaign, with the labels of one protocol.
pub async fn of(store: &Store, protocol: ContentHash) -> Result<Summary, StoreError> {
    let status = store.status().await?;
    let (mut biased, mut control) = (ForceErrors::default(), ForceErrors::default());
    let filter = ExportFilter { protocol, biased: true, control: true, imported: false };
    let mut after = None;
    loop {
        let page = store.labelled(&filter, after, PAGE).await?;
        let Some(last) = page.last() else { break };
        after = Some(last.place);
        for row in &page {
            let ExportSource::Candidate { origin, block, original, .. } = &row.source else { continue };
            let into = if *origin == Origin::Biased { &mut biased } else { &mut control };
            let pairs = block.view().forces.iter().zip(&row.label.forces);
            into.structures += 1;
            into.errors.extend(pairs.map(|(model, label)| norm(sub(*model, *label))));
            into.gamma.extend(&original.gamma);
            into.gamma_nbr.extend(&original.gamma_nbr);
        }
    }
    let values = store.values().await?;
    let watched = values.iter().find(|(name, _)| name == "training_frames");
    let watched: Option<GradeDistribution> = watched.and_then(|(_, text)| serde_json::from_str(text).ok());
    Ok(Summary { status, biased, control, training: watched })
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Status { candidates, labels, walks, mixture_version, .. } = &self.status;
        let count = |origin: &str| walks.iter().filter(|walk| walk.origin == origin).count();
        writeln!(f, "walks            {} biased, {} control", count("biased"), count("control"))?;
        let mut ends: Vec<_> = walks.iter().map(|walk| walk.state.as_str()).collect();
        ends.sort_unstable();
        let ends: Vec<_> =
            ends.chunk_by(|a, b| a == b).map(|run| format!("{} {}", run.len(), run[0])).collect();
        writeln!(f, "                 ended: {}", ends.join(", ").replace('_', " "))?;
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
        writeln!(
            f,
            "labels           {} biased and {} control structures labelled, {} failed, {} dropped",
            self.biased.structures, self.control.structures, labels.failed, labels.dropped
        )?;
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
        writeln!(f, "           atoms   mean error   γ > 1   γ_nbr > 1   ρ(γ, error)   ρ(γ_nbr, error)")?;
        writeln!(f, "  biased   {}", self.biased)?;
        writeln!(f, "  control  {}", self.control)
    }
}

impl fmt::Display for ForceErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let n = self.errors.len();
        if n == 0 {
            return write!(f, "no labelled structures");
        }
        let share = |grades: &[f64]| 100.0 * grades.iter().filter(|x| **x > 1.0).count() as f64 / n as f64;
        write!(
            f,
            "{n:>5}   {:.3} eV/Å   {:>4.0} %      {:>4.0} %   {:>11.2}   {:>15.2}",
            self.errors.iter().sum::<f64>() / n as f64,
            share(&self.gamma),
            share(&self.gamma_nbr),
            spearman(&self.gamma, &self.errors),
            spearman(&self.gamma_nbr, &self.errors)
        )
    }
}

/// Spearman's ρ: Pearson's correlation of the ranks, equal values sharing their mean rank. NaN below two values or
/// without any spread.
pub fn spearman(a: &[f64], b: &[f64]) -> f64 {
    let (a, b) = (ranks(a), ranks(b));
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let (mean_a, mean_b) = (mean(&a), mean(&b));
    let (mut covariance, mut variance_a, mut variance_b) = (0.0, 0.0, 0.0);
    for (x, y) in a.iter().zip(&b) {
        covariance += (x - mean_a) * (y - mean_b);
        variance_a += (x - mean_a).powi(2);
        variance_b += (y - mean_b).powi(2);
    }
    covariance / (variance_a * variance_b).sqrt()
}

fn ranks(values: &[f64]) -> Vec<f64> {
    let mut order: Vec<_> = (0..values.len()).collect();
    order.sort_by(|i, j| values[*i].total_cmp(&values[*j]));
    let mut ranks = vec![0.0; values.len()];
    let mut first = 0;
    for run in order.chunk_by(|i, j| values[*i] == values[*j]) {
        let rank = first as f64 + 0.5 * (run.len() - 1) as f64;
        run.iter().for_each(|i| ranks[*i] = rank);
        first += run.len();
    }
    ranks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spearman_is_that_of_the_ranks() {
        assert!((spearman(&[1.0, 2.0, 3.0], &[1.0, 10.0, 1000.0]) - 1.0).abs() < 1e-15);
        assert!((spearman(&[1.0, 2.0, 3.0], &[3.0, 2.0, -1.0]) + 1.0).abs() < 1e-15);
        // scipy.stats.spearmanr([1, 2, 2, 4, 5], [2, 1, 3, 3, 5]) = 0.763157894736842
        let tied = spearman(&[1.0, 2.0, 2.0, 4.0, 5.0], &[2.0, 1.0, 3.0, 3.0, 5.0]);
        assert!((tied - 0.763_157_894_736_842).abs() < 1e-14, "{tied}");
        assert!(spearman(&[1.0], &[1.0]).is_nan());
    }
}
