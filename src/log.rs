//! The log of this process: one line per event, appended to a file (docs/log.md).
//!
//! Several processes may write to the same file. Each line is one write to a file opened for appending, so lines do
//! not interleave.

mod format;
#[cfg(test)]
mod tests;

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use serde::{Deserialize, Serialize};
use tracing::level_filters::LevelFilter;
use tracing::{Event, Subscriber};
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};
use tracing_subscriber::registry::Registry;

use crate::exit_status::CommandError;

/// The packages of this program. Only warnings and errors are logged from other crates.
const WORKSPACE_CRATES: [&str; 5] = ["calmwalk", "orchestrator", "store", "wire", "workers"];

/// Configuration for child processes.
static CONFIG: OnceLock<LogConfig> = OnceLock::new();

/// Options of long-running commands.
#[derive(Clone, Debug, clap::Args)]
pub struct LogArgs {
    /// Append the log of this process and its children to this file (docs/log.md)
    #[arg(long = "log", value_name = "FILE")]
    file: Option<PathBuf>,
    /// Log level: log events of this and higher severity
    #[arg(long = "log-level", value_name = "LEVEL", requires = "file", default_value = "info")]
    level: LogLevel,
    /// Log format
    #[arg(long = "log-format", value_name = "FORMAT", requires = "file", default_value = "text")]
    format: LogFormat,
}

/// The least serious level that is logged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LogLevel {
    /// Errors that end a process
    Error,
    /// Problems that were handled
    Warn,
    /// Events of the campaign
    Info,
    /// Every assignment, commit and lease
    Debug,
}

/// Format of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LogFormat {
    /// One line of text per event
    Text,
    /// One JSON object per line
    Json,
}

/// Configuration of the log of a process.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct LogConfig {
    /// Absolute path of the file.
    file: PathBuf,
    level: LogLevel,
    format: LogFormat,
}

impl LogArgs {
    /// Initializes the log of this process if one is requested.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn init(&self, process: &'static str) -> Result<(), CommandError> {
        let Some(file) = &self.file else { return Ok(()) };
        let file = std::path::absolute(file).map_err(|error| cannot_write(file, &error))?;
        init(Some(LogConfig { file, level: self.level, format: self.format }), process, None)
    }
}

/// The log configuration for child processes.
pub fn child_config() -> Option<LogConfig> {
    CONFIG.get().cloned()
}

/// Initializes the log of a child process. `process` is its kind and `number` its number among those of that kind.
pub fn init(
    setup: Option<LogConfig>,
    process: &'static str,
    number: Option<u32>,
) -> Result<(), CommandError> {
    let Some(setup) = setup else { return Ok(()) };
    let opened = OpenOptions::new().append(true).create(true).mode(0o600).open(&setup.file);
    let file = opened.map_err(|error| cannot_write(&setup.file, &error))?;
    let name = number.map_or_else(|| process.to_owned(), |number| format!("{process} {number}"));
    let log = LogFile { file, format: setup.format, process: name };
    // A process has one log, initialized by its command.
    if tracing::subscriber::set_global_default(log.with_level(setup.level)).is_ok() {
        let _ = CONFIG.set(setup);
    }
    Ok(())
}

fn cannot_write(file: &Path, error: &std::io::Error) -> CommandError {
    CommandError::Input(format!("--log: cannot write to {}: {error}", file.display()))
}

/// Writes events to the file.
struct LogFile {
    file: File,
    format: LogFormat,
    /// Name of the process, such as `walker 3`.
    process: String,
}

impl LogFile {
    /// The subscriber for events of this and higher severity, of libraries only for warnings and errors.
    fn with_level(self, level: LogLevel) -> impl Subscriber + Send + Sync {
        let level = LevelFilter::from(level);
        let targets = WORKSPACE_CRATES.map(|package| (package, level));
        let filter = Targets::new().with_default(level.min(LevelFilter::WARN)).with_targets(targets);
        Registry::default().with(filter).with(self)
    }
}

impl<S: Subscriber> Layer<S> for LogFile {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let line = format::line(self.format, &self.process, event);
        // A log that cannot be written stops no work.
        let _ = (&self.file).write_all(line.as_bytes());
    }
}

impl From<LogLevel> for LevelFilter {
    fn from(level: LogLevel) -> Self {
        match level {
            LogLevel::Error => Self::ERROR,
            LogLevel::Warn => Self::WARN,
            LogLevel::Info => Self::INFO,
            LogLevel::Debug => Self::DEBUG,
        }
    }
}
