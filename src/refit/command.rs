//! Training by a program of the user.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use tokio::process::Command;
use tokio_util::sync::CancellationToken;
use workers::labeller::{CALCULATION_MARK, terminate_marked};

use super::settings::RefitterConfig;
use crate::config::CommandRefit;
use crate::exit_status::CommandError;

/// Longer than any training.
const NO_LIMIT: Duration = Duration::from_secs(1 << 32);
/// Output of the program.
const LOG: &str = "command.log";
/// The end of the log that a message shows, bytes.
const SHOWN: u64 = 600;
/// The new model.
pub const MODEL: &str = "model.npz";

/// Runs the program in the directory of the refit, where it has to leave [`MODEL`]. `None` after a cancellation of `stop`.
///
/// The program learns from its environment where its files are. It is ended, with all processes that it has started, when this process
/// is asked to stop and when the time is over; those of a refit that was killed before the program is started again.
///
/// # Errors
/// A program that cannot be started, fails, takes too long, or leaves no model.
pub async fn run(
    command: &CommandRefit,
    config: &RefitterConfig,
    directory: &Path,
    (train, held_out): (&Path, Option<&Path>),
    stop: &CancellationToken,
) -> Result<Option<()>, CommandError> {
    let log = directory.join(LOG);
    let failed = |problem: String| CommandError::Input(format!("{problem}{}", last_lines(&log)));
    let Some((program, arguments)) = command.program.split_first() else {
        return Err(CommandError::input("refit.method.command.program is empty"));
    };
    let output = File::create(&log).map_err(CommandError::failed)?;
    let replay: Vec<_> = config.settings.replay.iter().map(|file| file.path.as_os_str()).collect();
    let mut process = Command::new(program);
    process
        .args(arguments)
        .current_dir(directory)
        .stdin(Stdio::null())
        .stdout(output.try_clone().map_err(CommandError::failed)?)
        .stderr(output)
        .env("CALMWALK_REFIT_DIRECTORY", directory)
        .env("CALMWALK_PARENT_MODEL", &config.begin().path)
        .env("CALMWALK_PARENT_MIXTURE", &config.parent_mixture.path)
        .env("CALMWALK_TRAIN", train)
        .env("CALMWALK_HELD_OUT", held_out.unwrap_or(Path::new("")))
        .env("CALMWALK_REPLAY", replay.join(std::ffi::OsStr::new(":")))
        .env("CALMWALK_RNG_SEED", config.rng_seed.to_string())
        .env(CALCULATION_MARK, directory);
    // A refit that was killed may have left them.
    end_processes(directory).await?;
    let child = process.process_group(0).kill_on_drop(true).spawn();
    let mut child = child.map_err(|error| failed(format!("{program}: cannot be started: {error}")))?;
    let limit = command.time_limit.map_or(NO_LIMIT, |limit| limit.get());
    let ended = tokio::select! {
        status = child.wait() => Some(status.map_err(CommandError::failed)?),
        () = stop.cancelled() => None,
        () = tokio::time::sleep(limit) => None,
    };
    end_processes(directory).await?;
    let Some(status) = ended else {
        if stop.is_cancelled() {
            return Ok(None);
        }
        let seconds = limit.as_secs_f64();
        return Err(failed(format!("{program}: ended after {seconds} s (refit.method.command.time_limit)")));
    };
    if !status.success() {
        return Err(failed(format!("{program}: {status}")));
    }
    if !directory.join(MODEL).is_file() {
        return Err(failed(format!("{program} left no {MODEL} in its directory")));
    }
    Ok(Some(()))
}

/// Ends every process that the program of this directory has started.
async fn end_processes(directory: &Path) -> Result<(), CommandError> {
    let directory = directory.to_owned();
    let ended = tokio::task::spawn_blocking(move || terminate_marked(&directory)).await;
    ended.map_err(CommandError::failed)?.map_err(CommandError::failed)
}

/// The end of the log, for a message.
fn last_lines(log: &Path) -> String {
    let mut text = Vec::new();
    let read = File::open(log).and_then(|mut file| {
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(SHOWN)))?;
        file.read_to_end(&mut text)
    });
    let text = String::from_utf8_lossy(&text);
    match (read, text.trim()) {
        (Ok(_), "") | (Err(_), _) => String::new(),
        (Ok(_), text) => format!("; its last lines: {text}"),
    }
}
