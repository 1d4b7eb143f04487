//! The log: what this process does, one line an event at the end of a file (docs/log.md). Processes that write to the same file do
//! not tear each other's lines: each is one write to a file that is opened to append.

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

/// The packages of this program. Of what libraries have to say, only warnings and errors are kept.
const WORKSPACE_CRATES: [&str; 5] = ["calmwalk", "orchestrator", "store", "wire", "workers"];

/// What children are told.
static CONFIG: OnceLock<LogConfig> = OnceLock::new();

/// Arguments of commands that run for long.
#[derive(Clone, Debug, clap::Args)]
pub struct Options {
    /// Write down what happens at the end of this file, also that of the processes that this one starts (docs/log.md)
    #[arg(long = "log", value_name = "FILE")]
    file: Option<PathBuf>,
    /// How much is written down
    #[arg(long = "log-level", value_name = "LEVEL", requires = "file", default_value = "info")]
    level: LogLevel,
    /// How
    #[arg(long = "log-format", value_name = "FORMAT", requires = "file", default_value = "text")]
    format: Format,
}

/// How much is written down: this and what is more serious.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LogLevel {
    /// What ends a process.
    Error,
    /// What should not be, and is dealt with.
    Warn,
    /// What happens to the campaign.
    Info,
    /// Every turn, commit and lease.
    Debug,
}

/// How a line is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// For people.
    Text,
    /// One JSON object a line.
    Json,
}

/// What the log of a process is.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct LogConfig {
    /// The file, wherever a process works.
    file: PathBuf,
    level: LogLevel,
    format: Format,
}

impl Options {
    /// Begins the log of this process, if there is to be one.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn init(&self, process: &'static str) -> Result<(), Failure> {
        let Some(file) = &self.file else { return Ok(()) };
        let file = std::path::absolute(file).map_err(|error| cannot_write(file, &error))?;
        init(Some(LogConfig { file, level: self.level, format: self.format }), process, None)
    }
}

/// What a process that this one starts is to log.
pub fn child_config() -> Option<LogConfig> {
    CONFIG.get().cloned()
}

/// Begins the log of a process that others have started: what it is called, and its number among its like.
pub fn init(setup: Option<LogConfig>, process: &'static str, number: Option<u32>) -> Result<(), Failure> {
    let Some(setup) = setup else { return Ok(()) };
    let opened = OpenOptions::new().append(true).create(true).mode(0o600).open(&setup.file);
    let file = opened.map_err(|error| cannot_write(&setup.file, &error))?;
    let name = number.map_or_else(|| process.to_owned(), |number| format!("{process} {number}"));
    let log = Log { file, level: setup.level.into(), format: setup.format, name };
    // A process has one log, which begins with its command.
    if tracing::subscriber::set_global_default(log).is_ok() {
        let _ = CONFIG.set(setup);
    }
    Ok(())
}

fn cannot_write(file: &Path, error: &std::io::Error) -> Failure {
    Failure::Input(format!("--log: cannot write to {}: {error}", file.display()))
}

/// Where events go.
struct Log {
    file: File,
    level: Level,
    format: Format,
    /// What process this is.
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
        // That it cannot be kept stops no work.
        let _ = (&self.file).write_all(text.as_bytes());
    }

    // Spans of libraries, which are never enabled.
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
