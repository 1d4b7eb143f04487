//! The line of a run about labels that are being made: a bar on a terminal while walks are displayed, otherwise plain lines.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::ProgressBar;

use crate::output::print_progress;

/// Interval between plain lines.
const LINE_INTERVAL: Duration = Duration::from_secs(60);

/// Where the line is shown; clones share it.
#[derive(Clone, Debug)]
pub struct LabelLine(Arc<Mutex<Shown>>);

#[derive(Debug)]
struct Shown {
    bar: Option<ProgressBar>,
    last_line: Instant,
}

impl Default for LabelLine {
    fn default() -> Self {
        Self(Arc::new(Mutex::new(Shown { bar: None, last_line: Instant::now() })))
    }
}

impl LabelLine {
    /// Shows the line in this bar, or in plain lines again.
    pub fn set_bar(&self, bar: Option<ProgressBar>) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).bar = bar;
    }

    /// Shows the line; an empty one clears the bar.
    pub fn show(&self, line: &str) {
        let mut shown = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(bar) = &shown.bar {
            bar.set_message(line.to_owned());
        } else if !line.is_empty() && shown.last_line.elapsed() > LINE_INTERVAL {
            shown.last_line = Instant::now();
            print_progress(line);
        }
    }
}
