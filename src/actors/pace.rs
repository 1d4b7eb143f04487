//! How fast walks advance: heard from the reactor, and written down every few seconds for those who watch. Decides nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use orchestrator::reactor::Notice;
use store::{Store, WalkProgress, unix_milliseconds};
use tokio::time::{MissedTickBehavior, interval};
use wire::WalkId;
use wire::messages::Progress;

/// Between two times that it is written down.
const WRITE: Duration = Duration::from_secs(3);
/// A speed is told of no less time than this, s.
const LEAST: f64 = 1.0;
/// Time over which speeds are averaged, s.
const MEMORY: f64 = 30.0;

/// How the walks of a run advance.
#[derive(Debug, Default)]
pub struct Paces {
    walks: BTreeMap<u32, Walk>,
    /// Those that were heard of since it was last written down.
    changed: BTreeSet<u32>,
    all: Speed,
    /// Steps of all walks in this run.
    steps: u64,
}

#[derive(Debug, Default)]
struct Walk {
    pace: WalkProgress,
    speed: Speed,
    /// Steps in this run, also those that were made twice.
    steps: u64,
}

/// Steps per second, the latest counting most.
#[derive(Debug, Default)]
struct Speed {
    /// Steps at a time (ms) from which on they are counted.
    from: Option<(u64, i64)>,
    average: Option<f64>,
}

impl Speed {
    fn at(&mut self, steps: u64, now: i64) {
        let (before, since) = *self.from.get_or_insert((steps, now));
        let seconds = (now - since) as f64 / 1000.0;
        if seconds < LEAST {
            return;
        }
        let found = (steps - before) as f64 / seconds;
        let weight = 1.0 - (-seconds / MEMORY).exp();
        self.average = Some(self.average.map_or(found, |average| average + weight * (found - average)));
        self.from = Some((steps, now));
    }
}

impl Paces {
    /// Takes in what the reactor tells at the time `now`, ms since 1970.
    pub fn notice(&mut self, notice: &Notice<'_>, now: i64) {
        match notice {
            Notice::Progress(walk, progress) => self.heard(*walk, progress, now),
            Notice::Committed(commit) => {
                let begun = commit.walks.iter().filter(|record| record.progress.step > 0);
                begun.for_each(|record| self.heard(record.walk, &record.progress, now));
            }
            Notice::QueueFull(_) => {}
        }
    }

    fn heard(&mut self, walk: WalkId, progress: &Progress, now: i64) {
        let known = self.walks.contains_key(&walk.0);
        let entry = self.walks.entry(walk.0).or_default();
        // Where it stood when this run began is no step of this run; nor is a return to a checkpoint.
        if known && entry.pace.segment == progress.segment {
            let made = progress.step.saturating_sub(entry.pace.step);
            entry.steps += made;
            self.steps += made;
        }
        entry.speed.at(entry.steps, now);
        entry.pace = WalkProgress {
            walk: walk.0,
            seen: now,
            segment: progress.segment,
            step: progress.step,
            steps_per_second: entry.speed.average,
            tau: Some(progress.tau),
            temperature: Some(progress.temperature),
            relative_volume: Some(progress.relative_volume),
            gamma_max: Some(progress.gamma_max),
        };
        self.changed.insert(walk.0);
    }

    /// Those to be written down, and steps of all walks per second.
    fn take(&mut self, now: i64) -> (Vec<WalkProgress>, Option<f64>) {
        self.all.at(self.steps, now);
        let changed = std::mem::take(&mut self.changed);
        (changed.iter().map(|walk| self.walks[walk].pace.clone()).collect(), self.all.average)
    }
}

/// Writes it down without end. Nobody is told if that fails: whoever has more to write finds out.
pub async fn keep(store: &Store, paces: &Mutex<Paces>) -> Infallible {
    let mut write = interval(WRITE);
    write.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        write.tick().await;
        let now = unix_milliseconds();
        let (changed, all) = paces.lock().unwrap_or_else(PoisonError::into_inner).take(now);
        let _ = store.set_walk_progress(&changed, all, now).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(segment: u32, step: u64) -> Progress {
        Progress { segment, step, temperature: 300.0, ..Progress::default() }
    }

    #[test]
    fn a_walk_is_as_fast_as_its_steps_over_all_its_time() {
        let mut paces = Paces::default();
        let walk = WalkId(3);
        // Goes on at step 1000 with 50 steps a second, of which it waits every other second.
        for second in 0..200_i64 {
            let step = 1000 + 100 * (second as u64 / 2);
            paces.notice(&Notice::Progress(walk, at(0, step)), 1000 * second);
        }
        let (changed, _) = paces.take(200_000);
        let pace = changed[0].steps_per_second.unwrap();
        assert!((pace - 50.0).abs() < 2.0, "{pace}");
        assert_eq!((changed[0].walk, changed[0].step, changed[0].seen), (3, 10_900, 199_000));
        assert_eq!(paces.take(201_000).0, [], "nothing new was heard");
    }

    #[test]
    fn what_a_return_takes_back_is_no_speed() {
        let mut paces = Paces::default();
        paces.take(0);
        for (segment, step, now) in [(0, 500, 0), (0, 600, 1000), (1, 100, 2000), (1, 200, 3000)] {
            paces.notice(&Notice::Progress(WalkId(0), at(segment, step)), now);
        }
        let (_, all) = paces.take(4000);
        assert_eq!(all, Some(50.0), "200 steps in 4 s");
    }
}
