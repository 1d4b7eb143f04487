//! How a campaign stood at instants since somebody began to look: what the plots over time are drawn from.

use std::collections::BTreeMap;

use serde::Serialize;
use store::Status;

/// Samples that are kept. Of more every second one goes, so that they reach back to the first however long it is looked at.
const ROOM: usize = 600;
/// Walks whose γ is kept, each with a line of its own.
const WALKS: usize = 12;

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
pub struct Samples {
    kept: Vec<Sample>,
    /// So many of those that come make one that is kept.
    every: usize,
    passed: usize,
}

impl Sample {
    /// Of a campaign that stands so now.
    pub fn of(status: &Status, time: i64) -> Self {
        let under_way =
            status.walks.iter().filter(|walk| matches!(walk.state.as_str(), "waiting" | "running"));
        let gamma = under_way.filter_map(|walk| Some((walk.walk, walk.gamma_max?))).take(WALKS).collect();
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

impl Samples {
    /// Adds the newest.
    pub fn push(&mut self, sample: Sample) {
        let every = self.every.max(1);
        if self.passed == 0 {
            self.kept.push(sample);
        }
        self.passed = (self.passed + 1) % every;
        if self.kept.len() > ROOM {
            let mut place = 0;
            self.kept.retain(|_| {
                place += 1;
                place % 2 == 1
            });
            (self.every, self.passed) = (2 * every, 1);
        }
    }

    /// Those that are kept, oldest first.
    pub fn kept(&self) -> &[Sample] {
        &self.kept
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_samples_reach_back_to_the_first_at_even_distances() {
        let mut samples = Samples::default();
        for time in 0..100_000 {
            samples.push(Sample::of(&Status::default(), time));
        }
        let times: Vec<_> = samples.kept().iter().map(|sample| sample.time).collect();
        assert!((ROOM / 2..=ROOM).contains(&times.len()), "{}", times.len());
        assert_eq!(times[0], 0);
        let step = times[1];
        assert!(times.windows(2).all(|pair| pair[1] - pair[0] == step), "{times:?}");
        assert!(99_999 - times.last().unwrap() < step);
    }
}
