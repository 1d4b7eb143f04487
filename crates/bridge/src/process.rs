//! The server's process: lines to it, and what comes back.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use tracing::debug;

use crate::settings::PythonSettings;

/// Lines of standard error that are kept for error messages.
const KEPT_LINES: usize = 12;
/// How often an exit is looked for before the process is killed.
const EXIT_POLLS: u32 = 20;

/// Events of a server process.
#[derive(Debug)]
pub(crate) enum ServerEvent {
    /// A line of its standard output.
    Line(String),
    /// It has closed its standard output: it has exited, or will.
    Ended,
}

/// A running server. Dropping it ends it.
#[derive(Debug)]
pub(crate) struct ServerProcess {
    child: Child,
    /// Its standard input, until it is asked to end.
    input: Option<ChildStdin>,
    last_lines: Arc<Mutex<VecDeque<String>>>,
}

impl ServerProcess {
    /// Starts a server, whose package is in `package`. Its events go to `events`, changed by `tag`.
    ///
    /// # Errors
    /// Why it could not be started, with the names of adapter and environment.
    pub fn start<E: Send + 'static>(
        settings: &PythonSettings,
        package: &Path,
        events: Sender<E>,
        tag: impl Fn(ServerEvent) -> E + Send + 'static,
    ) -> Result<Self, String> {
        let program = settings.program();
        let mut words = settings.launcher.iter().map(std::ffi::OsStr::new).chain([program.as_os_str()]);
        let mut command = Command::new(words.next().unwrap_or_default());
        command.args(words).args(["-m", "calmwalk.server"]);
        // Modules of the working directory would come before those of the environment. A launcher may have words that are relative paths.
        if settings.launcher.is_empty() {
            command.current_dir(package);
        } else {
            command.env("PYTHONSAFEPATH", "1");
        }
        let path = match std::env::var_os("PYTHONPATH").filter(|path| !path.is_empty()) {
            None => package.as_os_str().to_owned(),
            Some(others) => {
                let mut both = package.as_os_str().to_owned();
                both.push(":");
                both.push(others);
                both
            }
        };
        let threads = settings.threads.to_string();
        command.env("PYTHONPATH", path).env("PYTHONDONTWRITEBYTECODE", "1").env("PYTHONUNBUFFERED", "1");
        for variable in ["OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"] {
            command.env(variable, &threads);
        }
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command
            .spawn()
            .map_err(|error| format!("{}: cannot start {}: {error}", settings.names(), program.display()))?;
        let (Some(input), Some(output), Some(errors)) =
            (child.stdin.take(), child.stdout.take(), child.stderr.take())
        else {
            return Err(format!("{}: the server has no standard streams", settings.names()));
        };
        let last_lines = Arc::new(Mutex::new(VecDeque::new()));
        let keep = Arc::clone(&last_lines);
        thread::spawn(move || read_errors(errors, &keep));
        thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                if events.send(tag(ServerEvent::Line(line))).is_err() {
                    return;
                }
            }
            let _ = events.send(tag(ServerEvent::Ended));
        });
        Ok(Self { child, input: Some(input), last_lines })
    }

    /// Sends a line.
    ///
    /// # Errors
    /// The server has exited.
    pub fn send(&mut self, line: &str) -> std::io::Result<()> {
        let input = self.input.as_mut().ok_or(ErrorKind::BrokenPipe)?;
        input.write_all(line.as_bytes())?;
        input.write_all(b"\n")?;
        input.flush()
    }

    /// The process.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Ends it and says how it ended, with the last lines that it wrote.
    pub fn end(mut self) -> String {
        let ended = self.close().map_or_else(|| "killed".to_owned(), |status| status.to_string());
        let lines = self.last_lines.lock().unwrap_or_else(PoisonError::into_inner);
        let lines: Vec<_> = lines.iter().map(String::as_str).collect();
        if lines.is_empty() { ended } else { format!("{ended}; its last lines:\n  {}", lines.join("\n  ")) }
    }
}

impl ServerProcess {
    /// Closes its standard input, which ends it, and says how it has ended. One that is in a call, or hangs, is killed.
    fn close(&mut self) -> Option<ExitStatus> {
        self.input = None;
        for _ in 0..EXIT_POLLS {
            if let Ok(Some(status)) = self.child.try_wait() {
                return Some(status);
            }
            thread::sleep(Duration::from_millis(10));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
        None
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        self.close();
    }
}

fn read_errors(errors: impl Read, keep: &Mutex<VecDeque<String>>) {
    for line in BufReader::new(errors).split(b'\n').map_while(Result::ok) {
        let line = String::from_utf8_lossy(&line).trim_end().to_owned();
        debug!(line, "python");
        let mut kept = keep.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.len() == KEPT_LINES {
            kept.pop_front();
        }
        kept.push_back(line);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    /// A program that a shell runs in place of Python.
    fn start(script: &str) -> ServerProcess {
        let mut settings = PythonSettings::new(Path::new("python"), "none", None);
        settings.launcher = ["sh", "-c", script].map(str::to_owned).to_vec();
        ServerProcess::start(&settings, Path::new("/"), mpsc::channel().0, |event| event).unwrap()
    }

    #[test]
    fn a_server_exits_at_the_end_of_its_input() {
        assert_eq!(start("cat; exit 0").end(), "exit status: 0");
        assert_eq!(start("trap '' TERM; while :; do sleep 1; done").end(), "killed");
    }

    #[test]
    fn dropping_a_server_ends_it() {
        let server = start("exec sleep 600");
        let process = format!("/proc/{}", server.pid());
        assert!(Path::new(&process).exists());
        drop(server);
        assert!(!Path::new(&process).exists());
    }
}
