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

use super::lines::{Lines, says_why};
use crate::supervisor::Ending;

/// How long the last words of a process are waited for when it has ended. They are in the pipe already; only what it
/// started itself and left behind can keep the pipe open.
pub(super) const LAST_WORDS: Duration = Duration::from_millis(100);

/// No more than so many bytes are in a pipe, as Linux has it.
const LARGEST_PIPE: usize = 1 << 20;

/// What there is to tell of a process.
#[derive(Debug)]
pub(super) enum News {
    Said(String),
    Ended(Ending),
}

/// Tells of one process, under its number.
#[derive(Clone, Debug)]
pub(super) struct Teller {
    pub number: u32,
    pub news: mpsc::Sender<(u32, News)>,
}

impl Teller {
    async fn tell(&self, news: News) {
        // Nobody wants to know any more when the receiver is gone.
        let _ = self.news.send((self.number, news)).await;
    }
}

/// Gives a child what it is to read, tells what it says, waits for its end and reaps it.
pub(super) async fn child(mut child: Child, setup: Vec<u8>, teller: Teller) {
    if let Some(stdin) = child.stdin.take() {
        tokio::spawn(feed(stdin, setup));
    }
    let mut words = Words::new(child.stderr.take());
    let status = loop {
        tokio::select! {
            status = child.wait() => break status,
            Some(line) = words.next() => teller.tell(News::Said(line)).await,
        }
    };
    words.read_last().await;
    while let Some(line) = words.next().await {
        teller.tell(News::Said(line)).await;
    }
    teller.tell(News::Ended(ending(status, words.last))).await;
}

/// Waits for the end of a process that is not our child.
pub(super) async fn stranger(end: AsyncFd<OwnedFd>, teller: Teller) {
    // An error would be that this process's runtime shuts down.
    let _ = end.readable().await;
    teller.tell(News::Ended(Ending::Unseen)).await;
}

async fn feed(mut stdin: ChildStdin, setup: Vec<u8>) {
    // A child that does not want to read will have its reason, and say it.
    let _ = stdin.write_all(&setup).await;
}

fn ending(status: io::Result<ExitStatus>, words: Option<String>) -> Ending {
    match status.map(|status| (status.code(), status.signal())) {
        Ok((Some(code), _)) => Ending::Exit { code, words },
        Ok((None, Some(signal))) => Ending::Signal { signal, words },
        Ok((None, None)) | Err(_) => Ending::Unseen,
    }
}

/// What a child writes to its standard error, line by line.
struct Words {
    stderr: Option<ChildStderr>,
    lines: Lines,
    /// The last line that may say why it ended.
    last: Option<String>,
}

impl Words {
    fn new(stderr: Option<ChildStderr>) -> Self {
        Self { stderr, lines: Lines::default(), last: None }
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
        if says_why(&line) {
            self.last = Some(line.clone());
        }
        Some(line)
    }

    /// Reads what is in the pipe when the process has ended, however slowly the lines are taken; nothing is read after it.
    async fn read_last(&mut self) {
        let all = async {
            let mut left = LARGEST_PIPE;
            while left > 0
                && let Some(length) = self.read().await
            {
                left = left.saturating_sub(length);
            }
        };
        // Whatever came until the time is over counts.
        let _ = tokio::time::timeout(LAST_WORDS, all).await;
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
