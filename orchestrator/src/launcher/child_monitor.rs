//! What a process says and how it ends, told as it happens.

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

/// How long the last words of a process are waited for when it has ended. They are in the pipe already; only what it
/// started itself and left behind can keep the pipe open.
pub(super) const STDERR_DRAIN_TIMEOUT: Duration = Duration::from_millis(100);

/// No more than so many bytes are in a pipe, as Linux has it.
const MAX_PIPE_BYTES: usize = 1 << 20;

/// What there is to tell of a process.
#[derive(Debug)]
pub(super) enum ChildNews {
    Stderr(String),
    Ended(ExitReason),
}

/// Tells of one process, under its number.
#[derive(Clone, Debug)]
pub(super) struct ChildReporter {
    pub number: u32,
    pub news: mpsc::Sender<(u32, ChildNews)>,
}

impl ChildReporter {
    async fn report(&self, news: ChildNews) {
        // Nobody wants to know any more when the receiver is gone.
        let _ = self.news.send((self.number, news)).await;
    }
}

/// Gives a child what it is to read, tells what it says, waits for its end and reaps it.
pub(super) async fn monitor_child(mut child: Child, setup: Vec<u8>, reporter: ChildReporter) {
    if let Some(stdin) = child.stdin.take() {
        tokio::spawn(feed(stdin, setup));
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

/// Waits for the end of a process that is not our child.
pub(super) async fn monitor_adopted(end: AsyncFd<OwnedFd>, reporter: ChildReporter) {
    // An error would be that this process's runtime shuts down.
    let _ = end.readable().await;
    reporter.report(ChildNews::Ended(ExitReason::Unknown)).await;
}

async fn feed(mut stdin: ChildStdin, setup: Vec<u8>) {
    // A child that does not want to read will have its reason, and say it.
    let _ = stdin.write_all(&setup).await;
}

fn exit_reason(status: io::Result<ExitStatus>, last_line: Option<String>) -> ExitReason {
    match status.map(|status| (status.code(), status.signal())) {
        Ok((Some(code), _)) => ExitReason::Exit { code, last_line },
        Ok((None, Some(signal))) => ExitReason::Signal { signal, last_line },
        Ok((None, None)) | Err(_) => ExitReason::Unknown,
    }
}

/// What a child writes to its standard error, line by line.
struct StderrLines {
    stderr: Option<ChildStderr>,
    lines: LineSplitter,
    /// The last line that may say why it ended.
    last: Option<String>,
}

impl StderrLines {
    fn new(stderr: Option<ChildStderr>) -> Self {
        Self { stderr, lines: LineSplitter::default(), last: None }
    }

    /// The next line; `None` when there will be no more. Dropped while it waits, it has lost nothing.
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

    /// Reads what is in the pipe when the process has ended, however slowly the lines are taken; nothing is read after it.
    async fn read_last(&mut self) {
        let all = async {
            let mut left = MAX_PIPE_BYTES;
            while left > 0
                && let Some(length) = self.read().await
            {
                left = left.saturating_sub(length);
            }
        };
        // Whatever came until the time is over counts.
        let _ = tokio::time::timeout(STDERR_DRAIN_TIMEOUT, all).await;
        self.stderr = None;
    }

    /// Reads some bytes; `None` at the end.
    async fn read(&mut self) -> Option<usize> {
        let mut bytes = [0; 4096];
        // An error is an end, too.
        let length = self.stderr.as_mut()?.read(&mut bytes).await.unwrap_or(0);
        if length == 0 {
            self.stderr = None;
            return None;
        }
        self.lines.push(&bytes[..length]);
        Some(length)
    }
}
