//! Progress of a pass: a bar on a terminal, otherwise a line now and then.

use std::cell::Cell;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::part::BuildPart;
use super::workers::Counters;
use crate::output::{self, Bar, print_stderr};

/// Time between two lines.
const LINE_INTERVAL: Duration = Duration::from_secs(30);

const BAR: &str = "{bar:32} {percent} %  {msg}";

/// Passes of a build.
const PASSES: usize = 3;

/// The bar counts in these parts of the whole.
const PARTS: u64 = 10_000;

/// The progress of one pass.
pub struct PassProgress<'a> {
    pass: usize,
    /// Passes that this process takes after it.
    later: usize,
    /// Number of structures, if it is known and all are this process's.
    total: Option<u64>,
    /// Size of the files.
    bytes: u64,
    counters: &'a Counters,
    bar: Bar,
    begun: Instant,
    line: Cell<Instant>,
}

impl<'a> PassProgress<'a> {
    /// Begins a pass. A process that makes a `part` ends with it, and has no `total`.
    pub fn new(
        pass: usize,
        part: Option<BuildPart>,
        total: Option<u64>,
        bytes: u64,
        counters: &'a Counters,
    ) -> Self {
        let now = Instant::now();
        let bar = Bar::new(Some(PARTS), BAR);
        let whole = part.is_none();
        let (later, total) = (if whole { PASSES - pass } else { 0 }, total.filter(|_| whole));
        Self { pass, later, total, bytes, counters, bar, begun: now, line: Cell::new(now) }
    }

    /// Shows where the pass is.
    pub fn show(&self) {
        let text = || self.text(self.begun.elapsed().as_secs_f64());
        self.bar.set((self.share() * PARTS as f64) as u64, text);
        if !self.bar.is_shown() && self.line.get().elapsed() > LINE_INTERVAL {
            self.line.set(Instant::now());
            print_stderr(text());
        }
    }

    /// Says that the pass is over.
    pub fn end(&self, structures: u64) {
        let (structures, shards) =
            (output::count(structures, "structure"), self.counters.shards.load(Ordering::Relaxed));
        let mut line = format!("pass {} of 3: {structures} in {}", self.pass, output::count(shards, "shard"));
        let left_out = self.counters.left_out.load(Ordering::Relaxed);
        if left_out > 0 {
            line += &format!(", {left_out} left out by --where");
        }
        self.bar.suspend(|| print_stderr(line));
    }

    /// Structures that this process went through: computed, and skipped in finished shards.
    fn structures(&self) -> (f64, f64) {
        let read = |counter: &std::sync::atomic::AtomicU64| counter.load(Ordering::Relaxed) as f64;
        (read(&self.counters.computed), read(&self.counters.skipped))
    }

    /// Of the whole pass, from 0 to 1. The number of structures is unknown in pass 1, where the files' bytes count.
    fn share(&self) -> f64 {
        let (computed, skipped) = self.structures();
        let (done, all) = match self.total {
            Some(total) => (computed + skipped, total as f64),
            None => (self.counters.bytes.load(Ordering::Relaxed) as f64, self.bytes as f64),
        };
        (done / all.max(1.0)).min(1.0)
    }

    /// After this many seconds.
    fn text(&self, seconds: f64) -> String {
        let (computed, skipped) = self.structures();
        let (share, shards) =
            (self.share(), output::count(self.counters.shards.load(Ordering::Relaxed), "shard"));
        let mut text = format!("pass {} of 3: {shards} done", self.pass);
        if computed > 0.0 {
            let rate = computed / seconds.max(1e-9);
            // Skipped structures take no time. Later passes take as long as this one, or less where they read stored features.
            let whole = seconds * (computed + skipped) / (share * computed).max(1e-9);
            let left = whole * (1.0 - share);
            text += &format!(", {rate:.1} structures/s, {} left in this pass", duration(left));
            if self.later > 0 {
                text += &format!(", at most {} in all", duration(left + self.later as f64 * whole));
            }
        }
        text
    }
}

fn duration(seconds: f64) -> indicatif::HumanDuration {
    indicatif::HumanDuration(Duration::from_secs_f64(seconds.clamp(0.0, 1e10)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is said after 10 s, in which 50 structures were computed; 50 others had been before.
    fn text(pass: usize, part: Option<&str>, total: Option<u64>) -> String {
        let counters = Counters::default();
        counters.bytes.store(300, Ordering::Relaxed);
        counters.computed.store(50, Ordering::Relaxed);
        counters.skipped.store(50, Ordering::Relaxed);
        counters.shards.store(4, Ordering::Relaxed);
        let part = part.map(|part| part.parse().unwrap());
        PassProgress::new(pass, part, total, 1200, &counters).text(10.0)
    }

    #[test]
    fn rate_and_expected_end_follow_from_what_was_computed() {
        // 300 of 400 structures are left: 60 s. A whole pass takes 80 s, and there are two more.
        let begin = "pass 1 of 3: 4 shards done, 5.0 structures/s, ";
        assert_eq!(
            text(1, None, None),
            format!("{begin}60 seconds left in this pass, at most 4 minutes in all")
        );
        // 500 of 600 structures are left, 100 s, and one more pass of 120 s.
        let begin = "pass 2 of 3: 4 shards done, 5.0 structures/s, ";
        let found = text(2, None, Some(600));
        assert_eq!(found, format!("{begin}2 minutes left in this pass, at most 4 minutes in all"));
        // A part ends with its pass, and knows its share of the files only.
        assert_eq!(text(2, Some("1/3"), Some(600)), format!("{begin}60 seconds left in this pass"));
        let begin = "pass 3 of 3: 4 shards done, 5.0 structures/s, ";
        assert_eq!(text(3, None, Some(150)), format!("{begin}10 seconds left in this pass"));
        // Nothing is known yet.
        let counters = Counters::default();
        assert_eq!(PassProgress::new(1, None, None, 0, &counters).text(0.0), "pass 1 of 3: 0 shards done");
    }
}
