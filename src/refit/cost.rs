//! What a refit costs, summed over interruptions.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::atomic_file::{AtomicFile, cannot_write};
use crate::exit_status::CommandError;

/// Wall-clock and processor time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RefitCost {
    /// Wall-clock time, s.
    pub seconds: f64,
    /// Processor time of the refit and its children, s.
    pub core_seconds: f64,
}

/// The cost until now, kept in a file.
pub struct CostMeter {
    path: PathBuf,
    before: RefitCost,
    begun: Instant,
}

impl CostMeter {
    /// Goes on from the file in this directory, if there is one.
    pub fn new(directory: &Path) -> Self {
        let path = directory.join("cost.json");
        let before = fs::read(&path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok());
        Self { path, before: before.unwrap_or_default(), begun: Instant::now() }
    }

    /// The cost until now.
    pub fn now(&self) -> RefitCost {
        RefitCost {
            seconds: self.before.seconds + self.begun.elapsed().as_secs_f64(),
            core_seconds: self.before.core_seconds + processor_time(),
        }
    }

    /// Keeps it.
    pub fn save(&self) -> Result<(), CommandError> {
        let mut file = AtomicFile::create(&self.path)?;
        let text = serde_json::to_string(&self.now()).map_err(CommandError::failed)?;
        file.write_all(text.as_bytes()).map_err(|error| cannot_write(&self.path, error))?;
        file.finish()
    }
}

/// Processor time of this process and of its children that have ended, s; 0 if the system does not say.
fn processor_time() -> f64 {
    let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The name of the program, in brackets, may contain spaces.
    let fields = stat.rsplit_once(')').map_or("", |(_, rest)| rest).split_ascii_whitespace();
    let ticks: u64 = fields.skip(11).take(4).filter_map(|field| field.parse::<u64>().ok()).sum();
    ticks as f64 / rustix::param::clock_ticks_per_second() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cost_is_summed_over_interruptions() {
        let directory = tempfile::tempdir().unwrap();
        let meter = CostMeter {
            before: RefitCost { seconds: 100.0, core_seconds: 200.0 },
            ..CostMeter::new(directory.path())
        };
        meter.save().unwrap();
        let RefitCost { seconds, core_seconds } = CostMeter::new(directory.path()).now();
        assert!((100.0..160.0).contains(&seconds) && core_seconds >= 200.0, "{seconds} {core_seconds}");
    }
}
