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
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

use self::format::{Fields, LogLine};
use crate::exit_status::Failure;

/// The packages of this program. Only warnings and errors are logged from other crates.
const WORKSPACE_CRATES: [&str; 5] = ["calmwalk", "orchestrator", "store", "wire", "workers"];

/// Configuration for child processes.
static CONFIG: OnceLock<LogConfig> = OnceLock::new();

/// Options of long-running commands.
#[derive(Clone, Debug, clap::Args)]
pub struct Options {
    /// Append the log of this process and its children to this file (docs/log.md)
    #[arg(long = "log", value_name = "FILE")]
    file: Option<PathBuf>,
    /// Log level: log events of this and higher severity
    #[arg(long = "log-level", value_name = "LEVEL", requires = "file", default_value = "info")]
    level: LogLevel,
    /// Log format
    #[arg(long = "log-format", value_name = "FORMAT", requires = "file", default_value = "text")]
    format: Format,
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
pub enum Format {
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
    format: Format,
}

impl Options {
    /// Initializes the log of this process if one is requested.
    ///
    /// # Errors
    /// Fails if the file cannot be written.
    pub fn init(&self, process: &'static str) -> Result<(), Failure> {
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
pub fn init(setup: Option<LogConfig>, process: &'static str, number: Option<u32>) -> Result<(), Failure> {
    let Some(setup) = setup else { return Ok(()) };
    let opened = OpenOptions::new().append(true).create(true).mode(0o600).open(&setup.file);
    let file = opened.map_err(|error| cannot_write(&setup.file, &error))?;
    let name = number.map_or_else(|| process.to_owned(), |number| format!("{process} {number}"));
    let log = Log { file, level: setup.level.into(), format: setup.format, name };
    // A process has one log, initialized by its command.
    if tracing::subscriber::set_global_default(log).is_ok() {
        let _ = CONFIG.set(setup);
    }
    Ok(())
}

fn cannot_write(file: &Path, error: &std::io::Error) -> Failure {
    Failure::Input(format!("--log: cannot write to {}: {error}", file.display()))
}

/// Subscriber that writes events to the file.
struct Log {
    file: File,
    level: Level,
    format: Format,
    /// Name of the process.
    name: String,
}

impl Subscriber for Log {
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        let package = metadata.target().split("::").next().unwrap_or_default();
        let level =
            if WORKSPACE_CRATES.contains(&package) { self.level } else { self.level.min(Level::WARN) };
        metadata.is_event() && *metadata.level() <= level
    }

    fn event(&self, event: &Event<'_>) {
        let mut fields = Fields::default();
        event.record(&mut fields);
        fields.remove_wrong_hint();
        let line = LogLine {
            time: store::unix_milliseconds(),
            level: *event.metadata().level(),
            process: &self.name,
            pid: std::process::id(),
            target: event.metadata().target(),
            fields,
        };
        let text = match self.format {
            Format::Text => line.text(),
            Format::Json => line.json(),
        };
        // A log that cannot be written stops no work.
        let _ = (&self.file).write_all(text.as_bytes());
    }

    // Only libraries create spans, and they are never enabled.
    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }
    fn record(&self, _: &Id, _: &Record<'_>) {}
    fn record_follows_from(&self, _: &Id, _: &Id) {}
    fn enter(&self, _: &Id) {}
    fn exit(&self, _: &Id) {}
}

impl From<LogLevel> for Level {
    fn from(level: LogLevel) -> Self {
        match level {
            LogLevel::Error => Self::ERROR,
            LogLevel::Warn => Self::WARN,
            LogLevel::Info => Self::INFO,
            LogLevel::Debug => Self::DEBUG,
        }
    }
}
