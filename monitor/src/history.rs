//! The history of a campaign since its beginning, with few enough samples for a drawing.

use serde::Serialize;
use store::{Budget, HistorySample, Store, StoreError};

/// Largest number of samples for a drawing.
const MAX_SAMPLES: usize = 800;

/// Samples over time, and what limits them.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct CampaignHistory {
    /// Oldest first.
    pub samples: Vec<HistorySample>,
    /// The limits of the campaign.
    pub limits: Budget,
    /// When versions of the potential were registered: number and ms since 1970.
    pub versions: Vec<(u32, i64)>,
}

impl CampaignHistory {
    /// Reads the history until `now`, ms since 1970.
    pub async fn read(store: &Store, now: i64) -> Result<Self, StoreError> {
        let versions = store.versions().await?;
        let registered = versions.iter().filter(|version| version.state == store::VersionState::Registered);
        Ok(Self {
            samples: thinned(store.history().await?),
            limits: store.budget(now).await?.0,
            versions: registered.map(|version| (version.number, version.time)).collect(),
        })
    }

    /// The samples of each run, in order.
    pub fn runs(&self) -> impl Iterator<Item = &[HistorySample]> {
        self.samples.chunk_by(|a, b| a.run == b.run)
    }
}

/// Leaves out samples that are close to their neighbours, but never the first or last of a run.
fn thinned(samples: Vec<HistorySample>) -> Vec<HistorySample> {
    let (Some(first), Some(last)) = (samples.first(), samples.last()) else { return samples };
    if samples.len() <= MAX_SAMPLES {
        return samples;
    }
    let interval = (last.time - first.time) / MAX_SAMPLES as i64 + 1;
    let begin = first.time;
    let mut kept = Vec::<HistorySample>::new();
    for (place, sample) in samples.iter().enumerate() {
        let bucket = |time: i64| (time - begin) / interval;
        let is_first = kept.last().is_none_or(|before| before.run != sample.run);
        let is_last = samples.get(place + 1).is_none_or(|next| next.run != sample.run);
        if is_first || is_last || kept.last().is_none_or(|before| bucket(before.time) != bucket(sample.time))
        {
            kept.push(sample.clone());
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_samples_are_thinned_but_runs_keep_their_ends() {
        let sample = |k: i64| HistorySample { time: 1000 * k, run: k / 5000, ..HistorySample::default() };
        let history = CampaignHistory {
            samples: thinned((0..10_000).map(sample).collect()),
            ..CampaignHistory::default()
        };
        assert!(
            (MAX_SAMPLES / 2..=MAX_SAMPLES + 4).contains(&history.samples.len()),
            "{}",
            history.samples.len()
        );
        let ends: Vec<_> = history.runs().map(|run| (run[0].time, run[run.len() - 1].time)).collect();
        assert_eq!(ends, [(0, 4_999_000), (5_000_000, 9_999_000)]);
        let few: Vec<_> = (0..10).map(sample).collect();
        assert_eq!(thinned(few.clone()), few);
    }
}
