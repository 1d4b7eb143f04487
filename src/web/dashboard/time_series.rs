//! How a campaign stood at instants since somebody began to look: what the plots over time are drawn from.

use std::collections::BTreeMap;

use serde::Serialize;
use store::Status;

/// Samples that are kept. Of more every second one goes, so that they reach back to the first however long it is looked at.
const MAX_SAMPLES: usize = 600;
/// Walks whose γ is kept, each with a line of its own.
const MAX_WALKS: usize = 12;

/// How it stood at an instant.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Sample {
    /// ms since 1970.
    pub time: i64,
    /// Candidates of biased walks so far.
    pub seen: u64,
    /// Accepted of them.
    pub accepted: u64,
    /// Labels made.
    pub labels: u64,
    /// Label jobs that wait.
    pub queued: u64,
    /// Label jobs in work.
    pub leased: u64,
    /// Steps of all walks a second.
    pub steps_per_second: Option<f64>,
    /// Largest γ of the last graded step of walks under way, by walk.
    pub gamma: BTreeMap<u32, f64>,
}

/// Samples in the order of their times, thinned out.
#[derive(Clone, Debug, Default)]
pub struct TimeSeries {
    samples: Vec<Sample>,
    /// So many of those that come make one that is kept.
    every: usize,
    passed: usize,
}

impl Sample {
    /// Of a campaign that stands so now.
    pub fn new(status: &Status, time: i64) -> Self {
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
    /// Adds the newest.
    pub fn add(&mut self, sample: Sample) {
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

    /// Those that are kept, oldest first.
    pub fn samples(&self) -> &[Sample] {
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
            samples.add(Sample::new(&Status::default(), time));
        }
        let times: Vec<_> = samples.samples().iter().map(|sample| sample.time).collect();
        assert!((MAX_SAMPLES / 2..=MAX_SAMPLES).contains(&times.len()), "{}", times.len());
        assert_eq!(times[0], 0);
        let step = times[1];
        assert!(times.windows(2).all(|pair| pair[1] - pair[0] == step), "{times:?}");
        assert!(99_999 - times.last().unwrap() < step);
    }
}
