//! Measures how fast walks advance, from the reactor's notices, and stores it every few seconds for display. It
//! affects no decision.

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use orchestrator::reactor::Notice;
use store::{Store, TotalThroughput, WalkProgressRecord, unix_milliseconds};
use tokio::time::{MissedTickBehavior, interval};
use wire::WalkId;
use wire::messages::WalkProgress;

/// Interval between writes.
const WRITE_INTERVAL: Duration = Duration::from_secs(3);
/// Shortest time over which a speed is measured, s.
const MIN_INTERVAL: f64 = 1.0;
/// Time constant of the moving average, s.
const AVERAGING_TIME: f64 = 30.0;

/// Throughput of the walks of a run.
#[derive(Debug, Default)]
pub struct Throughput {
    walks: BTreeMap<u32, WalkThroughput>,
    /// Walks with changes since the last write.
    changed: BTreeSet<u32>,
    all: Speed,
    busy: Busy,
    /// Steps of all walks in this run.
    steps: u64,
}

#[derive(Debug, Default)]
struct WalkThroughput {
    record: WalkProgressRecord,
    speed: Speed,
    /// Steps in this run, including repeated ones.
    steps: u64,
}

/// Moving average of the share of walkers that are busy.
#[derive(Debug, Default)]
struct Busy {
    /// The share since a time, ms.
    now: Option<(f64, i64)>,
    average: Option<f64>,
}

impl Busy {
    /// Takes the share that holds from now on, or measures up to now.
    fn update(&mut self, share: Option<f64>, now: i64) {
        if let Some((held, since)) = self.now {
            let weight = 1.0 - (-((now - since) as f64 / 1000.0) / AVERAGING_TIME).exp();
            self.average = Some(self.average.map_or(held, |average| average + weight * (held - average)));
            self.now = Some((held, now));
        }
        if let Some(share) = share {
            self.now = Some((share, now));
        }
    }
}

/// Exponential moving average of steps per second.
#[derive(Debug, Default)]
struct Speed {
    /// Number of steps and time (ms) of the last update.
    from: Option<(u64, i64)>,
    average: Option<f64>,
}

impl Speed {
    fn update(&mut self, steps: u64, now: i64) {
        let (before, since) = *self.from.get_or_insert((steps, now));
        let seconds = (now - since) as f64 / 1000.0;
        if seconds < MIN_INTERVAL {
            return;
        }
        let found = (steps - before) as f64 / seconds;
        let weight = 1.0 - (-seconds / AVERAGING_TIME).exp();
        self.average = Some(self.average.map_or(found, |average| average + weight * (found - average)));
        self.from = Some((steps, now));
    }
}

impl Throughput {
    /// Takes a notice of the reactor at the time `now`, ms since 1970.
    pub fn notice(&mut self, notice: &Notice<'_>, now: i64) {
        match notice {
            Notice::Progress(walk, progress) => self.update(*walk, progress, now),
            Notice::Committed(commit) => {
                let has_begun =
                    |progress: &WalkProgress| progress.step > 0 || progress.reference_step.is_some();
                let begun = commit.walks.iter().filter(|record| has_begun(&record.progress));
                begun.for_each(|record| self.update(record.walk, &record.progress, now));
            }
            Notice::Walkers { busy, all } if *all > 0 => {
                self.busy.update(Some(*busy as f64 / *all as f64), now);
            }
            Notice::Walkers { .. } | Notice::QueueFull(_) => {}
        }
    }

    fn update(&mut self, walk: WalkId, progress: &WalkProgress, now: i64) {
        let known = self.walks.contains_key(&walk.0);
        let entry = self.walks.entry(walk.0).or_default();
        // The steps of earlier runs do not count, and neither does a rollback to a checkpoint, or the end of a reference run.
        let before = (entry.record.segment, entry.record.reference_step.is_some());
        if known && before == (progress.segment, progress.reference_step.is_some()) {
            let from = entry.record.reference_step.unwrap_or(entry.record.step);
            let made = progress.reference_step.unwrap_or(progress.step).saturating_sub(from);
            entry.steps += made;
            self.steps += made;
        }
        entry.speed.update(entry.steps, now);
        entry.record = WalkProgressRecord {
            walk: walk.0,
            seen: now,
            segment: progress.segment,
            step: progress.step,
            reference_step: progress.reference_step,
            steps_per_second: entry.speed.average,
            tau: Some(progress.tau),
            temperature: Some(progress.temperature),
            relative_volume: Some(progress.relative_volume),
            gamma_max: Some(progress.gamma_max),
        };
        self.changed.insert(walk.0);
    }

    /// The changed walks, and the throughput of all.
    fn take_changes(&mut self, now: i64) -> (Vec<WalkProgressRecord>, TotalThroughput) {
        self.all.update(self.steps, now);
        self.busy.update(None, now);
        let changed = std::mem::take(&mut self.changed);
        let all = TotalThroughput { steps_per_second: self.all.average, walkers_busy: self.busy.average };
        (changed.iter().map(|walk| self.walks[walk].record.clone()).collect(), all)
    }
}

/// Writes the throughput periodically, for ever. Ignores errors: other writers report a broken database.
pub async fn record(store: &Store, throughput: &Mutex<Throughput>) -> Infallible {
    let mut write = interval(WRITE_INTERVAL);
    write.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        write.tick().await;
        let now = unix_milliseconds();
        let (changed, all) = throughput.lock().unwrap_or_else(PoisonError::into_inner).take_changes(now);
        let _ = store.set_walk_progress(&changed, all, now).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(segment: u32, step: u64) -> WalkProgress {
        WalkProgress { segment, step, temperature: 300.0, ..WalkProgress::default() }
    }

    #[test]
    fn waiting_time_counts_towards_the_speed() {
        let mut throughput = Throughput::default();
        let walk = WalkId(3);
        // Continues at step 1000 with 50 steps per second on average: it waits every other second.
        for second in 0..200_i64 {
            let step = 1000 + 100 * (second as u64 / 2);
            throughput.notice(&Notice::Progress(walk, at(0, step)), 1000 * second);
        }
        let (changed, _) = throughput.take_changes(200_000);
        let speed = changed[0].steps_per_second.unwrap();
        assert!((speed - 50.0).abs() < 2.0, "{speed}");
        assert_eq!((changed[0].walk, changed[0].step, changed[0].seen), (3, 10_900, 199_000));
        assert_eq!(throughput.take_changes(201_000).0, [], "nothing new was heard");
    }

    #[test]
    fn walkers_are_busy_for_a_share_of_the_time() {
        let mut throughput = Throughput::default();
        // Four walkers, three of which wait every other second.
        for second in 0..300_i64 {
            let busy = if second % 2 == 0 { 4 } else { 1 };
            throughput.notice(&Notice::Walkers { busy, all: 4 }, 1000 * second);
        }
        let busy = throughput.take_changes(300_000).1.walkers_busy.unwrap();
        assert!((busy - 0.625).abs() < 0.02, "{busy}");
        // All walkers are gone.
        throughput.notice(&Notice::Walkers { busy: 0, all: 0 }, 301_000);
        assert!(throughput.take_changes(302_000).1.walkers_busy.is_some());
    }

    #[test]
    fn steps_of_a_reference_run_count_towards_the_speed() {
        let mut throughput = Throughput::default();
        throughput.take_changes(0);
        let in_reference = |step| WalkProgress { reference_step: Some(step), ..at(0, 0) };
        for (progress, now) in
            [(in_reference(100), 0), (in_reference(300), 1000), (at(0, 10), 2000), (at(0, 210), 3000)]
        {
            throughput.notice(&Notice::Progress(WalkId(0), progress), now);
            let reference_step = throughput.walks[&0].record.reference_step;
            assert_eq!(reference_step.is_some(), now < 2000, "{now}");
        }
        let (changed, all) = throughput.take_changes(4000);
        assert_eq!(all.steps_per_second, Some(100.0), "400 steps in 4 s");
        assert_eq!((changed[0].step, changed[0].reference_step), (210, None));
    }

    #[test]
    fn rollbacks_do_not_count_as_steps() {
        let mut throughput = Throughput::default();
        throughput.take_changes(0);
        for (segment, step, now) in [(0, 500, 0), (0, 600, 1000), (1, 100, 2000), (1, 200, 3000)] {
            throughput.notice(&Notice::Progress(WalkId(0), at(segment, step)), now);
        }
        let (_, all) = throughput.take_changes(4000);
        assert_eq!(all.steps_per_second, Some(50.0), "200 steps in 4 s");
    }
}
