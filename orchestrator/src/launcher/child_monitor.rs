//! Monitoring of a process: its standard error and its exit.

use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::Duration;

use tokio::io::unix::AsyncFd;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::process::{Child, ChildStderr, ChildStdin};
use tokio::sync::mpsc;

use super::line_splitter::{LineSplitter, is_failure_reason};
use crate::supervisor::ExitReason;

/// Time to read the standard error of a process after its exit. Its output is already in the pipe; only processes that
/// it left behind can keep the pipe open.
pub(super) const STDERR_DRAIN_TIMEOUT: Duration = Duration::from_millis(100);

/// Maximum capacity of a pipe on Linux.
const MAX_PIPE_BYTES: usize = 1 << 20;

/// News of a process.
#[derive(Debug)]
pub(super) enum ChildNews {
    Stderr(String),
    Ended(ExitReason),
}

/// Reports news of one process, with its number.
#[derive(Clone, Debug)]
pub(super) struct ChildReporter {
    pub number: u32,
    pub news: mpsc::Sender<(u32, ChildNews)>,
}

impl ChildReporter {
    async fn report(&self, news: ChildNews) {
        // If the receiver is dropped, the news is not needed.
        let _ = self.news.send((self.number, news)).await;
    }
}

/// Writes the setup of a child process, reports its standard error, waits for its exit and reports that.
pub(super) async fn monitor_child(mut child: Child, setup: Vec<u8>, reporter: ChildReporter) {
    if let Some(stdin) = child.stdin.take() {
        tokio::spawn(write_setup(stdin, setup));
    }
    let mut stderr = StderrLines::new(child.stderr.take());
    let status = loop {
        tokio::select! {
            status = child.wait() => break status,
            Some(line) = stderr.next() => reporter.report(ChildNews::Stderr(line)).await,
        }
    };
    stderr.read_last().await;
    while let Some(line) = stderr.next().await {
        reporter.report(ChildNews::Stderr(line)).await;
    }
    reporter.report(ChildNews::Ended(exit_reason(status, stderr.last))).await;
}

/// Waits for the exit of a process that is not our child.
pub(super) async fn monitor_adopted(end: AsyncFd<OwnedFd>, reporter: ChildReporter) {
    // An error means that the runtime is shutting down.
    let _ = end.readable().await;
    reporter.report(ChildNews::Ended(ExitReason::Unknown)).await;
}

async fn write_setup(mut stdin: ChildStdin, setup: Vec<u8>) {
    // A child that does not read its setup reports the reason itself.
    let _ = stdin.write_all(&setup).await;
}

fn exit_reason(status: io::Result<ExitStatus>, last_line: Option<String>) -> ExitReason {
    match status.map(|status| (status.code(), status.signal())) {
        Ok((Some(code), _)) => ExitReason::Exit { code, last_line },
        Ok((None, Some(signal))) => ExitReason::Signal { signal, last_line },
        Ok((None, None)) | Err(_) => ExitReason::Unknown,
    }
}

/// Standard error of a child, line by line.
struct StderrLines {
    stderr: Option<ChildStderr>,
    lines: LineSplitter,
    /// The last line that may explain its exit.
    last: Option<String>,
}

impl StderrLines {
    fn new(stderr: Option<ChildStderr>) -> Self {
        Self { stderr, lines: LineSplitter::default(), last: None }
    }

    /// The next line; `None` at the end. Cancel safe.
    async fn next(&mut self) -> Option<String> {
        let line = loop {
            match self.lines.next_line() {
                Some(line) => break line,
                None if self.stderr.is_none() => break self.lines.rest()?,
                None => {
                    self.read().await;
                }
            }
        };
        if is_failure_reason(&line) {
            self.last = Some(line.clone());
        }
        Some(line)
    }

    /// Reads the rest of the pipe after the process has exited, however slowly the lines are consumed; nothing is read
    /// afterwards.
    async fn read_last(&mut self) {
        let all = async {
            let mut left = MAX_PIPE_BYTES;
            while left > 0
                && let Some(length) = self.read().await
            {
                left = left.saturating_sub(length);
            }
        };
        // Keeps what was read before the timeout.
        let _ = tokio::time::timeout(STDERR_DRAIN_TIMEOUT, all).await;
        self.stderr = None;
    }

    /// Reads some bytes; `None` at the end.
    async fn read(&mut self) -> Option<usize> {
        let mut bytes = [0; 4096];
        // Handles an error as the end.
        let length = self.stderr.as_mut()?.read(&mut bytes).await.unwrap_or(0);
        if length == 0 {
            self.stderr = None;
            return None;
        }
        self.lines.push(&bytes[..length]);
        Some(length)
    }
}
