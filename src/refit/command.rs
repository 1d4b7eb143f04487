//! Training by a program of the user.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use tokio::process::{Child, Command};
use tokio_util::sync::CancellationToken;
use workers::labeller::{CALCULATION_MARK, terminate_marked};

use super::failure::RefitFailure;
use super::settings::RefitterConfig;
use crate::atomic_file::{AtomicFile, cannot_write};
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
/// File with the mark of the processes of the last start.
const MARK: &str = "command.mark";
/// Option of `calmwalk refitter` with which it ends the processes with a mark when its standard input is closed.
pub const END_MARKED: &str = "--end-marked";

/// Runs the program in the directory of the refit, where it has to leave [`MODEL`]. `None` after a cancellation of `stop`.
///
/// The program learns from its environment where its files are. It is ended, with all processes that it has started, when this process
/// is asked to stop or is killed, and when the time is over.
///
/// # Errors
/// Refused: a program that cannot be started, fails, takes too long, or leaves no model. Failed: an error of the system.
pub async fn run(
    command: &CommandRefit,
    config: &RefitterConfig,
    directory: &Path,
    labels: (&Path, Option<&Path>),
    stop: &CancellationToken,
) -> Result<Option<()>, RefitFailure> {
    let log = directory.join(LOG);
    let failed = |problem: String| RefitFailure::Refused(format!("{problem}{}", last_lines(&log)));
    let Some(program) = command.program.first() else {
        return Err(RefitFailure::refused("refit.method.command.program is empty"));
    };
    end_earlier(directory).await?;
    let mark = directory.join(format!("command-{}", std::process::id()));
    write_mark(directory, &mark)?;
    // Its standard input is closed when this process is gone, however it ends.
    let guard = start_guard(&mark).map_err(CommandError::failed)?;
    let mut process = prepare(command, config, directory, labels, &log)?;
    process.env(CALCULATION_MARK, &mark);
    let child = process.spawn();
    let mut child = child.map_err(|error| failed(format!("{program}: cannot be started: {error}")))?;
    let limit = command.time_limit.map_or(NO_LIMIT, |limit| limit.get());
    let ended = tokio::select! {
        status = child.wait() => Some(status.map_err(CommandError::failed)?),
        () = stop.cancelled() => None,
        () = tokio::time::sleep(limit) => None,
    };
    end_processes(mark).await?;
    drop(guard);
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

/// The program with its environment. A model that an earlier start left unfinished is removed.
fn prepare(
    command: &CommandRefit,
    config: &RefitterConfig,
    directory: &Path,
    (train, held_out): (&Path, Option<&Path>),
    log: &Path,
) -> Result<Command, CommandError> {
    let model = directory.join(MODEL);
    match fs::remove_file(&model) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(cannot_write(&model, error)),
        _ => {}
    }
    let output = File::create(log).map_err(|error| cannot_write(log, error))?;
    // The program has another working directory than this process.
    let absolute = |path: &Path| std::path::absolute(path).map_err(CommandError::failed);
    let replay = config.settings.replay.iter().map(|file| Ok(absolute(&file.path)?.into_os_string()));
    let replay = replay.collect::<Result<Vec<_>, CommandError>>()?.join(OsStr::new(":"));
    let held_out = held_out.map_or(Ok(PathBuf::new()), absolute)?;
    let mut process = Command::new(command.program.first().map_or("", String::as_str));
    process
        .args(command.program.iter().skip(1))
        .current_dir(directory)
        .stdin(Stdio::null())
        .stdout(output.try_clone().map_err(CommandError::failed)?)
        .stderr(output)
        .env("CALMWALK_REFIT_DIRECTORY", absolute(directory)?)
        .env("CALMWALK_PARENT_MODEL", absolute(&config.begin().path)?)
        .env("CALMWALK_PARENT_MIXTURE", absolute(&config.parent_mixture.path)?)
        .env("CALMWALK_TRAIN", absolute(train)?)
        .env("CALMWALK_HELD_OUT", held_out)
        .env("CALMWALK_REPLAY", replay)
        .env("CALMWALK_RNG_SEED", config.rng_seed.to_string())
        .process_group(0)
        .kill_on_drop(true);
    Ok(process)
}

/// Ends what a refit that was killed has left of its program.
async fn end_earlier(directory: &Path) -> Result<(), CommandError> {
    let path = directory.join(MARK);
    match fs::read(&path) {
        Ok(mark) => end_processes(PathBuf::from(std::ffi::OsString::from_vec(mark))).await,
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(CommandError::Failed(format!("cannot read {}: {error}", path.display()))),
    }
}

/// Another mark for each start: the guard of an earlier one may still be at work.
fn write_mark(directory: &Path, mark: &Path) -> Result<(), CommandError> {
    let path = directory.join(MARK);
    let mut file = AtomicFile::create(&path)?;
    file.write_all(mark.as_os_str().as_bytes()).map_err(|error| cannot_write(&path, error))?;
    file.finish()
}

/// Starts a process that runs [`end_marked_when_alone`].
fn start_guard(mark: &Path) -> io::Result<Child> {
    let mut guard = Command::new("/proc/self/exe");
    guard.arg0("calmwalk").args(["refitter", END_MARKED]).arg(mark).current_dir("/").process_group(0);
    guard.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null()).spawn()
}

/// Waits until standard input is closed, and ends every process with this mark.
///
/// # Errors
/// A process that cannot be ended.
pub fn end_marked_when_alone(mark: &Path) -> Result<(), CommandError> {
    io::copy(&mut io::stdin().lock(), &mut io::sink()).map_err(CommandError::failed)?;
    terminate_marked(mark).map_err(CommandError::failed)
}

/// Ends every process that the program with this mark has started.
async fn end_processes(mark: PathBuf) -> Result<(), CommandError> {
    let ended = tokio::task::spawn_blocking(move || terminate_marked(&mark)).await;
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
