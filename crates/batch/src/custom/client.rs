//! Runs the commands of a custom batch system.

use std::ffi::OsString;
use std::fs::File;
use std::io;
use std::path::Path;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process_group};
use tokio::io::{AsyncBufReadExt, AsyncRead, BufReader};
use tokio::process::{Child, Command};

use super::answer::{CommandOutput, PolledState};
use super::error::CustomError;
use super::request::JobRequest;
use super::settings::CustomScheduler;
use super::template::TemplateFault;
use crate::full_pause::FullPause;
use crate::job_id::JobId;

const SUBMIT: &str = "launch.custom.submit";
const POLL: &str = "launch.custom.poll";
const CANCEL: &str = "launch.custom.cancel";

/// A custom batch system, through its commands on this host.
#[derive(Clone, Debug)]
pub struct CustomClient {
    scheduler: CustomScheduler,
    timeout: Duration,
    /// Environment of the commands in place of the current process's.
    environment: Option<Vec<(OsString, OsString)>>,
}

/// How a command ended, and what it printed.
struct CommandAnswer {
    status: ExitStatus,
    output: CommandOutput,
}

impl CustomClient {
    /// A client whose commands may take at most this time.
    pub fn new(scheduler: CustomScheduler, timeout: Duration) -> Self {
        Self { scheduler, timeout, environment: None }
    }

    /// Runs commands with this environment in place of the current process's.
    pub fn with_environment(self, environment: Vec<(OsString, OsString)>) -> Self {
        Self { environment: Some(environment), ..self }
    }

    /// The batch system.
    pub fn scheduler(&self) -> &CustomScheduler {
        &self.scheduler
    }

    /// The script of a job.
    ///
    /// # Errors
    /// A placeholder of a value that the job does not have.
    pub fn job_script(&self, job: &JobRequest) -> Result<String, CustomError> {
        let filled = self.scheduler.fill_script(job);
        filled.map_err(|fault| template_error("launch.custom.script", &self.scheduler.script, &fault))
    }

    /// The command that submits a script, of a job that starts after another one.
    ///
    /// # Errors
    /// A path that is not UTF-8.
    pub fn submit_command(&self, script: &Path, start_after: Option<&JobId>) -> Result<String, CustomError> {
        let path = script.to_str().ok_or_else(|| CustomError::Template {
            key: SUBMIT,
            found: script.display().to_string(),
            expected: "a script whose path is UTF-8".to_owned(),
        })?;
        let command = self.scheduler.submit_command(path, start_after.map(JobId::as_str));
        command.map_err(|fault| template_error(SUBMIT, &self.scheduler.submit, &fault))
    }

    /// The command that cancels a job.
    ///
    /// # Errors
    /// An unknown placeholder.
    pub fn cancel_command(&self, id: &JobId) -> Result<String, CustomError> {
        let command = self.scheduler.with_id(&self.scheduler.cancel, id.as_str());
        command.map_err(|fault| template_error(CANCEL, &self.scheduler.cancel, &fault))
    }

    /// Submits a job and returns its id. Waits while the batch system accepts no further job, however long that takes, and calls
    /// `on_full` with the error when it starts to wait.
    ///
    /// # Errors
    /// See [`CustomError`], also for the following functions.
    pub async fn submit(
        &self,
        script: &Path,
        start_after: Option<&JobId>,
        on_full: impl FnOnce(&CustomError),
    ) -> Result<JobId, CustomError> {
        let command = self.submit_command(script, start_after)?;
        let (mut on_full, mut pause) = (Some(on_full), FullPause::new());
        loop {
            match self.try_submit(&command, script).await {
                Err(full @ CustomError::Full { .. }) => {
                    if let Some(on_full) = on_full.take() {
                        on_full(&full);
                    }
                }
                result => return result,
            }
            pause.wait().await;
        }
    }

    async fn try_submit(&self, command: &str, script: &Path) -> Result<JobId, CustomError> {
        let opened = File::open(script);
        let input = opened.map_err(|source| CustomError::Script { path: script.to_owned(), source })?;
        let answer = self.answer(SUBMIT, command, input.into()).await?;
        if let Some(reason) = self.scheduler.full_queue(&answer.output) {
            let (name, reason) = (self.scheduler.name.clone(), reason.to_owned());
            return Err(CustomError::Full { name, reason });
        }
        answer.check(SUBMIT, command)?;
        let id = self.scheduler.submitted_id(&answer.output);
        id.ok_or_else(|| CustomError::UnexpectedOutput {
            key: SUBMIT,
            command: command.to_owned(),
            found: answer.output.stdout.trim().to_owned(),
            expected: match self.scheduler.id_after.as_str() {
                "" => "the id of the job".to_owned(),
                after => format!("the id of the job after {after:?} (launch.custom.id_after)"),
            },
        })
    }

    /// The state of a job.
    pub async fn poll(&self, id: &JobId) -> Result<PolledState, CustomError> {
        let CustomScheduler { poll, state_after, .. } = &self.scheduler;
        let command = self.scheduler.with_id(poll, id.as_str());
        let command = command.map_err(|fault| template_error(POLL, poll, &fault))?;
        let answer = self.answer(POLL, &command, Stdio::null()).await?;
        if let Some(state) = self.scheduler.polled_state(&answer.output) {
            return Ok(state);
        }
        answer.check(POLL, &command)?;
        Err(CustomError::UnexpectedOutput {
            key: POLL,
            found: answer.output.stdout.trim().to_owned(),
            command,
            expected: match state_after.as_str() {
                "" => "the state of the job".to_owned(),
                after => format!("the state of the job after {after:?} (launch.custom.state_after)"),
            },
        })
    }

    /// Cancels a job. Ignores one that has ended.
    pub async fn cancel(&self, id: &JobId) -> Result<(), CustomError> {
        let command = self.cancel_command(id)?;
        let answer = self.answer(CANCEL, &command, Stdio::null()).await?;
        if answer.output.success || answer.output.says_any(&self.scheduler.vanished) {
            return Ok(());
        }
        match self.poll(id).await {
            Ok(state) if !state.is_alive() => Ok(()),
            _ => answer.check(CANCEL, &command),
        }
    }

    /// Runs a command of the shell. Kills it, with what it has started, at the time limit.
    async fn answer(
        &self,
        key: &'static str,
        command: &str,
        input: Stdio,
    ) -> Result<CommandAnswer, CustomError> {
        let mut shell = Command::new("sh");
        shell.args(["-c", command]).stdin(input).stdout(Stdio::piped()).stderr(Stdio::piped());
        shell.process_group(0).kill_on_drop(true);
        if let Some(environment) = &self.environment {
            shell.env_clear().envs(environment.iter().map(|(name, value)| (name, value)));
        }
        let failed = |source| CustomError::NotStarted { key, command: command.to_owned(), source };
        let mut child = shell.spawn().map_err(failed)?;
        let group = child.id();
        match tokio::time::timeout(self.timeout, self.output(&mut child)).await {
            Ok(answer) => answer.map_err(failed),
            Err(_) => {
                kill(group);
                let (command, seconds) = (command.to_owned(), self.timeout.as_secs());
                Err(CustomError::TimedOut { key, command, seconds })
            }
        }
    }

    async fn output(&self, child: &mut Child) -> io::Result<CommandAnswer> {
        let group = child.id();
        let (out, err) = (child.stdout.take(), child.stderr.take());
        let (stdout, stderr) = tokio::join!(self.lines(out, group), self.lines(err, group));
        let status = child.wait().await?;
        let output = CommandOutput { success: status.success(), stdout: stdout?, stderr: stderr? };
        Ok(CommandAnswer { status, output })
    }

    /// What is written into a pipe. Kills a command that waits for a place in the queue: its id would come after minutes, and a
    /// caller who gave up meanwhile would not know whether there is a job.
    async fn lines(&self, pipe: Option<impl AsyncRead + Unpin>, group: Option<u32>) -> io::Result<String> {
        let (mut all, mut last) = (Vec::new(), 0);
        let Some(pipe) = pipe else { return Ok(String::new()) };
        let mut lines = BufReader::new(pipe);
        while lines.read_until(b'\n', &mut all).await? > 0 {
            let line = String::from_utf8_lossy(&all[last..]);
            if self.scheduler.queue_full.iter().any(|text| line.contains(text)) {
                kill(group);
            }
            last = all.len();
        }
        Ok(String::from_utf8_lossy(&all).into_owned())
    }
}

impl CommandAnswer {
    /// Whether the command has ended well.
    fn check(&self, key: &'static str, command: &str) -> Result<(), CustomError> {
        let CommandOutput { success, stdout, stderr } = &self.output;
        if *success {
            return Ok(());
        }
        let said = [stderr.trim(), stdout.trim()].into_iter().find(|text| !text.is_empty());
        let output = said.unwrap_or("it printed nothing").to_owned();
        Err(CustomError::Failed { key, command: command.to_owned(), status: self.status, output })
    }
}

/// Kills a command that has a process group of its own.
fn kill(group: Option<u32>) {
    if let Some(group) = group.and_then(|group| i32::try_from(group).ok()).and_then(Pid::from_raw) {
        // It may have ended.
        let _ = kill_process_group(group, Signal::KILL);
    }
}

fn template_error(key: &'static str, template: &str, fault: &TemplateFault) -> CustomError {
    CustomError::Template { key, found: fault.place(template), expected: fault.expected() }
}
