//! Turns Ctrl-C and SIGTERM into the cancellation of a token.

use std::io::{IsTerminal, stdin};
use std::process;
use std::thread;
use std::time::{Duration, Instant};

use tokio::signal::unix::{SignalKind, signal};
use tokio_util::sync::CancellationToken;

use crate::exit_status::CommandError;
use crate::output::log_and_print;

/// A batch system signals every process of a job, with SIGTERM or SIGINT, and the job script forwards the signal it receives. LSF sends
/// SIGTERM 10 s after SIGINT. Signals within this time count as one request.
const SIGNAL_MERGE_WINDOW: Duration = Duration::from_secs(15);

/// Cancels `stop` and prints `message` on the first Ctrl-C, SIGTERM or hang-up. A second Ctrl-C at a terminal exits at
/// once, which is safe too. Other signals within [`SIGNAL_MERGE_WINDOW`] of the first are the same request; a later one exits at once.
pub fn cancel_on_signal(stop: CancellationToken, message: &'static str) -> Result<(), CommandError> {
    let mut interrupt = signal(SignalKind::interrupt()).map_err(CommandError::failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(CommandError::failed)?;
    let mut hangup = signal(SignalKind::hangup()).map_err(CommandError::failed)?;
    let at_terminal = stdin().is_terminal();
    tokio::spawn(async move {
        let mut asked: Option<Instant> = None;
        loop {
            let may_be_same = tokio::select! {
                _ = interrupt.recv() => !at_terminal,
                _ = hangup.recv() => !at_terminal,
                _ = terminate.recv() => true,
            };
            if may_be_same && asked.is_some_and(|asked| asked.elapsed() < SIGNAL_MERGE_WINDOW) {
                continue;
            }
            if asked.replace(Instant::now()).is_some() {
                process::exit(130);
            }
            stop.cancel();
            log_and_print(message);
        }
    });
    Ok(())
}

/// For commands without a runtime: returns a token that the first Ctrl-C or SIGTERM cancels, so that work can stop in
/// order. The second signal exits at once.
pub fn stop_token() -> Result<CancellationToken, CommandError> {
    let runtime =
        tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(CommandError::failed)?;
    let guard = runtime.enter();
    let mut interrupt = signal(SignalKind::interrupt()).map_err(CommandError::failed)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(CommandError::failed)?;
    drop(guard);
    let stop = CancellationToken::new();
    let asked = stop.clone();
    thread::spawn(move || {
        runtime.block_on(async {
            loop {
                tokio::select! { _ = interrupt.recv() => (), _ = terminate.recv() => () };
                if asked.is_cancelled() {
                    process::exit(130);
                }
                asked.cancel();
            }
        });
    });
    Ok(stop)
}
