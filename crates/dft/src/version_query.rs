//! Queries the version of a program.

use std::collections::BTreeMap;
use std::io::Read;
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use crate::{PassedEnvironment, SetupError};

/// Programs answer at once, but a cold file system may be slow.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Runs `command` with further arguments in a temporary directory with these files (name, content) and returns
/// its output. Its environment consists of the `passed` variables of the current process and `environment`.
///
/// # Errors
/// [`SetupError::Program`] if it does not start, fails, or does not end.
pub(crate) fn run(
    command: &[String],
    arguments: &[&str],
    environment: &BTreeMap<String, String>,
    passed: &PassedEnvironment,
    files: &[(&str, &[u8])],
) -> Result<String, SetupError> {
    let (status, stdout, stderr) = output(command, arguments, environment, passed, files)?;
    if status.success() {
        return Ok(stdout);
    }
    let mut lines = stdout.lines().chain(stderr.lines()).filter(|line| !line.trim().is_empty());
    let last = lines.next_back().unwrap_or("nothing");
    let reason = format!("{status}; its last output is: {last}");
    Err(SetupError::Program { program: shown(command, arguments), reason })
}

/// As [`run`], without arguments and files, for a program that prints its version and then fails because it has no
/// input.
///
/// # Errors
/// [`SetupError::Program`] if it does not start or does not end.
pub(crate) fn run_without_input(
    command: &[String],
    environment: &BTreeMap<String, String>,
    passed: &PassedEnvironment,
) -> Result<String, SetupError> {
    output(command, &[], environment, passed, &[]).map(|(_, stdout, _)| stdout)
}

/// Command line for messages.
fn shown(command: &[String], arguments: &[&str]) -> String {
    command.iter().map(String::as_str).chain(arguments.iter().copied()).collect::<Vec<_>>().join(" ")
}

/// Status, standard output and standard error of a program.
fn output(
    command: &[String],
    arguments: &[&str],
    environment: &BTreeMap<String, String>,
    passed: &PassedEnvironment,
    files: &[(&str, &[u8])],
) -> Result<(ExitStatus, String, String), SetupError> {
    let wrong = |reason: String| SetupError::Program { program: shown(command, arguments), reason };
    let [program, first @ ..] = command else {
        return Err(wrong(
            "no command; name the program, as in command = [\"mpirun\", \"-np\", \"4\", \"abinit\"]".into(),
        ));
    };
    let directory = working_directory(files).map_err(|error| wrong(error.to_string()))?;
    let mut query = Command::new(program);
    query.args(first).args(arguments);
    query.env_clear().envs(passed.from_current_process()).envs(environment).current_dir(directory.path());
    output_of(query).map_err(|error| match error {
        ProgramError::Start(error) => {
            wrong(format!("does not start ({error}): install it, or correct `command`"))
        }
        other => wrong(other.to_string()),
    })
}

/// Why a program says nothing.
#[derive(Debug, thiserror::Error)]
pub enum ProgramError {
    /// It cannot be started.
    #[error("does not start: {0}")]
    Start(std::io::Error),
    /// It does not end.
    #[error("did not answer within {} s", TIMEOUT.as_secs())]
    Timeout,
    /// The system does not say how it ended.
    #[error(transparent)]
    Wait(std::io::Error),
}

/// Status, standard output and standard error of a program without input that ends soon.
///
/// # Errors
/// It does not start, or does not end within two minutes, after which it is killed.
pub fn output_of(mut program: Command) -> Result<(ExitStatus, String, String), ProgramError> {
    program.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = program.spawn().map_err(ProgramError::Start)?;
    let (stdout, stderr) = (drain(child.stdout.take()), drain(child.stderr.take()));
    let begin = Instant::now();
    let status = loop {
        match child.try_wait().map_err(ProgramError::Wait)? {
            Some(status) => break status,
            None if begin.elapsed() > TIMEOUT => {
                // It may have just ended.
                let _ = child.kill();
                let _ = child.wait();
                return Err(ProgramError::Timeout);
            }
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    };
    Ok((status, stdout.join().unwrap_or_default(), stderr.join().unwrap_or_default()))
}

/// Reads to the end, so that the program never blocks on a full pipe.
fn drain(pipe: Option<impl Read + Send + 'static>) -> std::thread::JoinHandle<String> {
    std::thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(mut pipe) = pipe {
            // What was read before an error is still useful.
            let _ = pipe.read_to_end(&mut bytes);
        }
        String::from_utf8_lossy(&bytes).into_owned()
    })
}

/// The environment of a calculation: one thread unless the settings say otherwise.
pub(crate) fn environment(settings: &BTreeMap<String, String>) -> BTreeMap<String, String> {
    let mut environment = BTreeMap::from([("OMP_NUM_THREADS".to_owned(), "1".to_owned())]);
    environment.extend(settings.iter().map(|(key, value)| (key.clone(), value.clone())));
    environment
}

/// A temporary directory with these files.
fn working_directory(files: &[(&str, &[u8])]) -> std::io::Result<tempfile::TempDir> {
    let directory = tempfile::Builder::new().prefix("calmwalk-").tempdir()?;
    for (name, content) in files {
        std::fs::write(directory.path().join(name), content)?;
    }
    Ok(directory)
}

/// The error for a program that is not the expected one.
pub(crate) fn wrong_program(command: &[String], reason: String) -> SetupError {
    SetupError::Program { program: command.join(" "), reason }
}
