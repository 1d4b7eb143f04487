//! What a job asks for.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::template::TemplateFault;

/// Bytes of a megabyte of a batch system.
const MEBIBYTE: u64 = 1 << 20;

/// What a job asks for, as the placeholders of [`super::CustomScheduler::script`] show it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JobRequest {
    /// Name of the job.
    pub name: String,
    /// Number of processor cores.
    pub cores: u32,
    /// Number of GPUs.
    pub gpus: u32,
    /// Memory, bytes.
    pub memory: Option<u64>,
    /// Longest time that it may run.
    pub time_limit: Option<Duration>,
    /// Working directory.
    pub directory: PathBuf,
    /// File for its output and for what the batch system says about it.
    pub output: PathBuf,
    /// Shell command that it runs.
    pub command: String,
}

impl JobRequest {
    /// The values of the placeholders.
    pub(super) fn values(&self) -> Result<[(&'static str, Option<String>); 9], TemplateFault> {
        let minutes = |time: Duration| time.as_secs().div_ceil(60).to_string();
        Ok([
            ("name", Some(self.name.clone())),
            ("cores", Some(self.cores.to_string())),
            ("gpus", (self.gpus > 0).then(|| self.gpus.to_string())),
            ("memory_mb", self.memory.map(|bytes| bytes.div_ceil(MEBIBYTE).to_string())),
            ("time_limit", self.time_limit.map(clock)),
            ("minutes", self.time_limit.map(minutes)),
            ("directory", Some(text(&self.directory)?)),
            ("output", Some(text(&self.output)?)),
            ("command", Some(self.command.clone())),
        ])
    }

    /// A job that has every value, to try a script with.
    pub(super) fn example() -> Self {
        Self {
            name: "calmwalk-1a2b-agent-0".to_owned(),
            cores: 16,
            gpus: 1,
            memory: Some(MEBIBYTE),
            time_limit: Some(Duration::from_secs(86_400)),
            directory: "/campaign".into(),
            output: "/campaign/jobs/agent-0.out".into(),
            command: "true".to_owned(),
        }
    }
}

/// `24:00:00`
fn clock(time: Duration) -> String {
    let seconds = time.as_secs();
    format!("{:02}:{:02}:{:02}", seconds / 3600, seconds / 60 % 60, seconds % 60)
}

fn text(path: &Path) -> Result<String, TemplateFault> {
    let text = path.to_str().filter(|text| !text.contains('\n')).map(str::to_owned);
    text.ok_or_else(|| TemplateFault {
        line: 0,
        message: format!("paths in UTF-8 without line breaks; one is {}", path.display()),
    })
}
