//! Data of the two charts: distribution of γ, and acceptance rate of candidates.

use store::RecentDecision;
use wire::Origin;

/// Number of newest candidates for the acceptance rate.
const LAST: usize = 100;

/// Data of the newest candidates of biased walks.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Charts {
    /// Largest γ under the original mixture, sorted.
    gamma: Vec<f64>,
    /// Whether each was accepted, oldest first.
    accepted: Vec<bool>,
}

impl Charts {
    /// Computes the data from decisions, newest first.
    pub fn from_decisions<'a>(decisions: impl DoubleEndedIterator<Item = &'a RecentDecision>) -> Self {
        let mut charts = Self::default();
        for decision in decisions.rev() {
            let Some(found) = decision.candidate.as_ref().filter(|found| found.origin == Origin::Biased)
            else {
                continue;
            };
            charts.accepted.push(found.reason.is_none());
            charts.gamma.extend(found.original_gamma);
        }
        charts.gamma.sort_by(f64::total_cmp);
        charts
    }

    /// Number of candidates.
    pub fn candidates(&self) -> usize {
        self.accepted.len()
    }

    /// Median and largest γ.
    pub fn gamma(&self) -> Option<(f64, f64)> {
        Some((self.gamma.get(self.gamma.len() / 2).copied()?, self.gamma.last().copied()?))
    }

    /// A histogram of γ with `bins` equal bins on [0, end), and `end`. The last bin includes larger values, at most one in
    /// fifty.
    pub fn histogram(&self, bins: usize) -> (Vec<u64>, f64) {
        let high = self.gamma.get(self.gamma.len() * 49 / 50);
        let end = high.map_or(2.0, |gamma| gamma.ceil().max(2.0));
        let mut counts = vec![0; bins];
        for gamma in &self.gamma {
            let bin = (gamma / end * bins as f64) as usize;
            if let Some(count) = counts.get_mut(bin.min(bins.saturating_sub(1))) {
                *count += 1;
            }
        }
        (counts, end)
    }

    /// Acceptance rate of the last hundred candidates, or of all if there are fewer, in %, and their number.
    pub fn acceptance(&self) -> Option<(f64, usize)> {
        let last = &self.accepted[self.accepted.len().saturating_sub(LAST)..];
        (!last.is_empty()).then(|| (percent(last), last.len()))
    }

    /// Acceptance rates of groups of candidates in %, oldest first, in at most `columns` groups; and the size of a group.
    pub fn acceptance_history(&self, columns: usize) -> (Vec<u64>, usize) {
        let group = self.accepted.len().div_ceil(columns.max(1)).max(1);
        (self.accepted.chunks(group).map(|group| percent(group).round() as u64).collect(), group)
    }
}

fn percent(accepted: &[bool]) -> f64 {
    100.0 * accepted.iter().filter(|accepted| **accepted).count() as f64 / accepted.len() as f64
}

#[cfg(test)]
mod tests {
    use store::DecidedCandidate;

    use super::*;

    fn decision(sequence: i64, gamma: Option<f64>, accepted: bool, origin: Origin) -> RecentDecision {
        let candidate = DecidedCandidate {
            candidate: format!("c-{sequence}"),
            origin,
            reason: (!accepted).then(|| "covered".into()),
            step: 1,
            seed_structure: "bcc".into(),
            atoms: 2,
            formula: "Mo2".into(),
            temperature: None,
            relative_volume: None,
            selector_gamma: None,
            original_gamma: gamma,
            original_gamma_nbr: None,
        };
        RecentDecision {
            sequence,
            kind: if accepted { "accepted" } else { "declined" }.into(),
            walk: Some(0),
            mixture_version: 0,
            detail: serde_json::Value::Null,
            candidate: Some(candidate),
        }
    }

    #[test]
    fn grades_are_counted_in_equal_bins_and_the_last_has_the_rest() {
        let of = |gammas: &[f64]| {
            let decisions: Vec<_> =
                gammas.iter().map(|g| decision(1, Some(*g), true, Origin::Biased)).collect();
            Charts::from_decisions(decisions.iter())
        };
        let mut gammas = vec![0.1; 60];
        gammas.extend([1.2; 38]);
        gammas.extend([1.9, 50.0]);
        let charts = of(&gammas);
        assert_eq!(charts.histogram(4), (vec![60, 0, 38, 2], 2.0));
        assert_eq!((charts.gamma(), charts.candidates()), (Some((0.1, 50.0)), 100));
        assert_eq!(of(&[]).histogram(3), (vec![0; 3], 2.0));
        assert_eq!((of(&[]).gamma(), of(&[2.6]).histogram(2).1), (None, 3.0));
        assert_eq!(charts.histogram(0).0, [0; 0]);
    }

    #[test]
    fn the_share_accepted_is_that_of_biased_candidates() {
        let mut decisions: Vec<_> =
            (0..150).rev().map(|k| decision(k, None, k < 60 || k % 2 == 0, Origin::Biased)).collect();
        decisions.insert(0, decision(200, Some(9.0), true, Origin::Control));
        let charts = Charts::from_decisions(decisions.iter());
        assert_eq!((charts.candidates(), charts.gamma()), (150, None));
        // Of candidates 50 to 149, ten before the change and half of ninety behind it.
        assert_eq!(charts.acceptance(), Some((55.0, 100)));
        assert_eq!(
            charts.acceptance_history(15),
            (vec![100, 100, 100, 100, 100, 100, 50, 50, 50, 50, 50, 50, 50, 50, 50], 10)
        );
        assert_eq!(charts.acceptance_history(4).1, 38);
        assert_eq!(
            (Charts::default().acceptance(), Charts::default().acceptance_history(7)),
            (None, (vec![], 1))
        );
    }
}
