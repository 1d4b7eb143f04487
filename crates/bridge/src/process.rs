//! The server's process: lines to it, and what comes back.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read, Write};
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

/// What a server has to say.
#[derive(Debug)]
pub(crate) enum ServerEvent {
    /// A line of its standard output.
    Line(String),
    /// It has closed its standard output: it has exited, or will.
    Ended,
}

/// A running server.
#[derive(Debug)]
pub(crate) struct ServerProcess {
    child: Child,
    input: ChildStdin,
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
        // Modules of the working directory would come before those of the environment.
        command.args(words).args(["-m", "calmwalk.server"]).current_dir(package);
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
        Ok(Self { child, input, last_lines })
    }

    /// Sends a line.
    ///
    /// # Errors
    /// The server has exited.
    pub fn send(&mut self, line: &str) -> std::io::Result<()> {
        self.input.write_all(line.as_bytes())?;
        self.input.write_all(b"\n")?;
        self.input.flush()
    }

    /// The process.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Ends it and says how it ended, with the last lines that it wrote.
    pub fn end(mut self) -> String {
        let ended = match self.wait_for_exit() {
            Some(status) => status.to_string(),
            None => {
                let _ = self.child.kill();
                let _ = self.child.wait();
                "killed".to_owned()
            }
        };
        let lines = self.last_lines.lock().unwrap_or_else(PoisonError::into_inner);
        let lines: Vec<_> = lines.iter().map(String::as_str).collect();
        if lines.is_empty() { ended } else { format!("{ended}; its last lines:\n  {}", lines.join("\n  ")) }
    }
}

impl ServerProcess {
    /// How it has ended. Who closes its standard output ends a moment later.
    fn wait_for_exit(&mut self) -> Option<ExitStatus> {
        for _ in 0..EXIT_POLLS {
            if let Ok(Some(status)) = self.child.try_wait() {
                return Some(status);
            }
            thread::sleep(Duration::from_millis(10));
        }
        None
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
