//! Samples of a campaign's state for the plots over time.

use std::collections::BTreeMap;

use serde::Serialize;
use store::CampaignStatus;

/// Largest number of samples. Beyond it every second one is dropped, so that they always reach back to the first.
const MAX_SAMPLES: usize = 600;
/// Largest number of walks whose γ is sampled. Each has its own line.
const MAX_WALKS: usize = 12;

/// State of a campaign at one time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TimeSeriesPoint {
    /// ms since 1970.
    pub time: i64,
    /// Candidates of biased walks so far.
    pub seen: u64,
    /// Accepted candidates.
    pub accepted: u64,
    /// Labels made.
    pub labels: u64,
    /// Queued label jobs.
    pub queued: u64,
    /// Leased label jobs.
    pub leased: u64,
    /// Steps of all walks per second.
    pub steps_per_second: Option<f64>,
    /// Largest γ of the last graded step of each running walk, by walk.
    pub gamma: BTreeMap<u32, f64>,
}

/// Samples by time, thinned out.
#[derive(Clone, Debug, Default)]
pub struct TimeSeries {
    samples: Vec<TimeSeriesPoint>,
    /// One of this many samples is kept.
    every: usize,
    passed: usize,
}

impl TimeSeriesPoint {
    /// The current state of a campaign.
    pub fn new(status: &CampaignStatus, time: i64) -> Self {
        let under_way =
            status.walks.iter().filter(|walk| matches!(walk.state.as_str(), "waiting" | "running"));
        let gamma = under_way.filter_map(|walk| Some((walk.walk, walk.gamma_max?))).take(MAX_WALKS).collect();
        Self {
            time,
            seen: status.candidates.seen,
            accepted: status.candidates.accepted,
            labels: status.budget.used.labels,
            queued: status.labels.queued,
            leased: status.labels.leased,
            steps_per_second: status.steps_per_second,
            gamma,
        }
    }
}

impl TimeSeries {
    /// Adds the newest sample.
    pub fn add(&mut self, sample: TimeSeriesPoint) {
        let every = self.every.max(1);
        if self.passed == 0 {
            self.samples.push(sample);
        }
        self.passed = (self.passed + 1) % every;
        if self.samples.len() > MAX_SAMPLES {
            let mut place = 0;
            self.samples.retain(|_| {
                place += 1;
                place % 2 == 1
            });
            (self.every, self.passed) = (2 * every, 1);
        }
    }

    /// The samples, oldest first.
    pub fn samples(&self) -> &[TimeSeriesPoint] {
        &self.samples
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_samples_reach_back_to_the_first_at_even_distances() {
        let mut samples = TimeSeries::default();
        for time in 0..100_000 {
            samples.add(TimeSeriesPoint::new(&CampaignStatus::default(), time));
        }
        let times: Vec<_> = samples.samples().iter().map(|sample| sample.time).collect();
        assert!((MAX_SAMPLES / 2..=MAX_SAMPLES).contains(&times.len()), "{}", times.len());
        assert_eq!(times[0], 0);
        let step = times[1];
        assert!(times.windows(2).all(|pair| pair[1] - pair[0] == step), "{times:?}");
        assert!(99_999 - times.last().unwrap() < step);
    }
}
