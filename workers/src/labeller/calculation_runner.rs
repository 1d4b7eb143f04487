//! The runner of a calculation: a process that starts the program, enforces its limits and records how it ended. It
//! outlives the labeller that started it, so a calculation of a killed labeller is finished all the same.
//!
//! The runner is this program again, with a [`RunnerRequest`] on its standard input. It starts nothing before the
//! request arrives, so that the labeller can first record which process it is. A second process of the same kind
//! starts the program: it ties itself to the runner and then executes the program.

use std::fs::{self, File};
use std::io::{self, BufRead, ErrorKind, Write};
use std::os::fd::AsFd;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use dft::{Exit, PassedEnvironment, result_file};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{
    Pid, PidfdFlags, Signal, geteuid, getpid, getppid, pidfd_open, set_child_subreaper,
    set_parent_process_death_signal, setsid,
};
use serde::{Deserialize, Serialize};

use super::private_directory;
use super::process_tree::{self, ChildReaper, MARK};
use super::remove_tree::remove_tree;

/// Working directory of the program, in the directory of the calculation.
pub(super) const WORK: &str = "work";
/// Written there by the runner when the calculation has ended.
const END: &str = "end.json";
/// Time between two checks of memory use and of ended processes.
const POLL_INTERVAL: Duration = Duration::from_millis(500);
/// Environment variable in which Slurm gives the node of a job.
const SLURM_NODE_VARIABLE: &str = "SLURMD_NODENAME";
/// Environment variable in which the script of a job gives its node to the runner.
pub(super) const NODE_VARIABLE: &str = "CALMWALK_NODE";
/// A batch system kills the processes of a job one after the other: the runner may outlive its program for this time.
const JOB_KILL_TIME: Duration = Duration::from_secs(5);
/// Written there by the second process if it could not execute the program.
const NOT_STARTED: &str = "not-started";

/// The task of this process, one line of JSON.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum RunnerRequest {
    /// Run a calculation.
    Run(Calculation),
    /// Execute its program.
    Exec { runner: u32, directory: PathBuf, command: Vec<String> },
}

/// A calculation and its limits.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Calculation {
    pub directory: PathBuf,
    pub command: Vec<String>,
    pub environment: Vec<(String, String)>,
    /// Variables that the program gets from the environment of the runner.
    #[serde(default)]
    pub pass_environment: PassedEnvironment,
    /// Seconds.
    pub time_limit: f64,
    /// Maximum memory of all its processes together, bytes.
    pub memory_limit: Option<u64>,
    /// How to start a runner.
    pub runner: RunnerCommand,
}

/// The program, with its arguments, that calls [`run_calculation`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunnerCommand {
    /// Path of the program.
    pub program: PathBuf,
    /// Its arguments.
    pub arguments: Vec<String>,
}

impl Default for RunnerCommand {
    /// `calmwalk calculation-runner`, of this very program, even if its file was replaced meanwhile.
    fn default() -> Self {
        Self { program: "/proc/self/exe".into(), arguments: vec!["calculation-runner".to_owned()] }
    }
}

impl RunnerCommand {
    pub(super) fn command(&self) -> Command {
        let mut command = Command::new(&self.program);
        // The name that users see in process lists.
        command.arg0(std::env::args_os().next().unwrap_or_else(|| "calmwalk".into())).args(&self.arguments);
        command
    }
}

/// How a calculation ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CalculationEnd {
    /// By what.
    pub how: EndReason,
    /// The program, as the command names it.
    pub program: PathBuf,
    /// From the program's start to its end, s.
    pub seconds: f64,
    /// Largest observed memory of all its processes together, bytes; 0 if it was not observed.
    pub memory: u64,
    /// Node of the batch system on which it ran.
    #[serde(default)]
    pub node: Option<String>,
    /// Further information if another process determined the end, because the runner left none.
    #[serde(default)]
    pub remark: Option<String>,
}

/// See [`CalculationEnd`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum EndReason {
    /// By itself, or at a limit.
    Ended(#[serde(with = "ExitOnFile")] Exit),
    /// The program does not exist or cannot be executed: the error number of the system.
    NotStarted(i32),
}

/// [`Exit`] in its stored form.
#[derive(Serialize, Deserialize)]
#[serde(remote = "Exit")]
enum ExitOnFile {
    Code(i32),
    Signal(i32),
    TimeLimit,
    OutOfMemory,
    LostNode,
}

impl CalculationEnd {
    /// Whether the program could not be started.
    pub fn is_not_started(&self) -> bool {
        matches!(self.how, EndReason::NotStarted(_))
    }

    /// Reads the end that a runner left in the directory, if the calculation has ended.
    pub(super) fn read(directory: &Path) -> Option<Self> {
        serde_json::from_slice(&result_file::read(&directory.join(END)).ok()?).ok()
    }

    /// The file appears as a whole, and only when everything else is done.
    pub(super) fn write(&self, directory: &Path) -> io::Result<()> {
        let (unfinished, finished) = (directory.join(format!("{END}.new")), directory.join(END));
        // The program may have left anything under these names.
        remove_existing(&unfinished)?;
        let mut file = File::options().write(true).create_new(true).open(&unfinished)?;
        file.write_all(&serde_json::to_vec(self)?)?;
        remove_existing(&finished)?;
        fs::rename(unfinished, finished)
    }
}

/// Removes whatever has that name.
fn remove_existing(path: &Path) -> io::Result<()> {
    match fs::symlink_metadata(path) {
        Ok(found) if found.is_dir() => remove_tree(path),
        Ok(_) => fs::remove_file(path),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        Err(error) => Err(error),
    }
}

/// Reads a request from standard input: runs a calculation, or executes its program. Call it on the main thread of
/// a process that does nothing else.
///
/// # Errors
/// Errors of the operating system. Without a request, because the process that started this one has ended, it does
/// nothing.
pub fn run_calculation() -> io::Result<()> {
    let stdin = io::stdin();
    // A batch job reads its request from a file, which another user might have replaced.
    let request = rustix::fs::fstat(&stdin)?;
    if rustix::fs::FileType::from_raw_mode(request.st_mode).is_file() && request.st_uid != geteuid().as_raw()
    {
        return Err(io::Error::other(format!(
            "the request is a file of user {}, expected a file of this user",
            request.st_uid
        )));
    }
    let mut line = String::new();
    stdin.lock().read_line(&mut line)?;
    // A truncated request counts as none.
    match line.ends_with('\n').then(|| serde_json::from_str(&line)) {
        None => Ok(()),
        Some(Err(error)) => Err(error.into()),
        Some(Ok(RunnerRequest::Run(calculation))) => calculation.run(),
        Some(Ok(RunnerRequest::Exec { runner, directory, command })) => {
            Err(exec_program(runner, &directory, &command))
        }
    }
}

/// Returns only on failure.
fn exec_program(runner: u32, directory: &Path, command: &[String]) -> io::Error {
    // SIGTERM, not SIGKILL: a program that starts processes on other nodes has to end them.
    if let Err(error) = set_parent_process_death_signal(Some(Signal::TERM)) {
        return error.into();
    }
    // It may have ended before.
    if getppid().map(|pid| pid.as_raw_nonzero().get().unsigned_abs()) != Some(runner) {
        return io::Error::other("the runner of this calculation has ended");
    }
    let [program, arguments @ ..] = command else { return ErrorKind::InvalidInput.into() };
    let error = Command::new(program).args(arguments).stdin(Stdio::null()).exec();
    let number = error.raw_os_error().unwrap_or_default();
    match fs::write(directory.join(NOT_STARTED), number.to_string()) {
        Ok(()) => error,
        Err(error) => error,
    }
}

impl Calculation {
    /// One hour of a program with 2 GB, for tests of what runs it.
    #[cfg(test)]
    pub(super) fn example(directory: &Path, runner: RunnerCommand) -> Self {
        Self {
            directory: directory.to_owned(),
            command: vec!["abinit".to_owned()],
            environment: Vec::new(),
            pass_environment: PassedEnvironment::default(),
            time_limit: 3600.0,
            memory_limit: Some(2_000_000_000),
            runner,
        }
    }

    /// Starts the program, waits for it, and ends it at a limit.
    fn run(self) -> io::Result<()> {
        if !private_directory::is_own(&self.directory) {
            let message = format!("{} is not a directory of this user", self.directory.display());
            return Err(io::Error::other(message));
        }
        // Neither Ctrl-C nor the end of the labeller's process group reaches this process or its program.
        setsid()?;
        // All descendants of the program stay below this process, even if their parents end.
        set_child_subreaper(Some(getpid()))?;
        let kills = out_of_memory_kills();
        let started = Instant::now();
        let program = self.start()?;
        let program = i32::try_from(program.id()).ok().and_then(Pid::from_raw);
        let program = program.ok_or(ErrorKind::InvalidInput)?;
        let mut children = ChildReaper::new(program);
        let (limit, memory) = self.wait(program, &mut children, started)?;
        let status = children.terminate()?;
        let seconds = started.elapsed().as_secs_f64();
        let node = [SLURM_NODE_VARIABLE, NODE_VARIABLE].iter().find_map(|name| std::env::var(name).ok());
        if node.is_some() && limit.is_none() && !status.success() {
            // If the batch system is killing the job, this process is killed here as well, and the batch system reports the
            // reason.
            std::thread::sleep(JOB_KILL_TIME);
        }
        let how = match (self.not_started(), limit) {
            (Some(number), _) => EndReason::NotStarted(number),
            (None, Some(limit)) => EndReason::Ended(limit),
            (None, None) if !status.success() && out_of_memory_kills() > kills => {
                EndReason::Ended(Exit::OutOfMemory)
            }
            (None, None) => EndReason::Ended(exit(status)),
        };
        let program = self.command.first().map(PathBuf::from).unwrap_or_default();
        CalculationEnd { how, program, seconds, memory, node, remark: None }.write(&self.directory)
    }

    fn start(&self) -> io::Result<Child> {
        let work = self.directory.join(WORK);
        let mut child = self
            .runner
            .command()
            .current_dir(&work)
            .env_clear()
            .envs(self.pass_environment.from_current_process())
            .envs(self.environment.iter().map(|(name, value)| (name, value)))
            .env(MARK, &self.directory)
            .stdin(Stdio::piped())
            .stdout(File::create(work.join("stdout"))?)
            .stderr(File::create(work.join("stderr"))?)
            .process_group(0)
            .spawn()?;
        let (runner, directory) = (std::process::id(), self.directory.clone());
        let request = RunnerRequest::Exec { runner, directory, command: self.command.clone() };
        match child.stdin.take() {
            Some(stdin) => send_request(stdin, &request).map(|()| child),
            None => Err(ErrorKind::BrokenPipe.into()),
        }
    }

    /// Waits until the program has ended or reaches a limit, or until the directory of the calculation is removed. Returns why the program
    /// must end, if it must, and the largest observed memory.
    fn wait(
        &self,
        program: Pid,
        children: &mut ChildReaper,
        started: Instant,
    ) -> io::Result<(Option<Exit>, u64)> {
        let end = pidfd_open(program, PidfdFlags::empty())?;
        let limit = Duration::try_from_secs_f64(self.time_limit).unwrap_or(Duration::MAX);
        let mut most = 0;
        loop {
            let left = limit.saturating_sub(started.elapsed());
            if left.is_zero() {
                return Ok((Some(Exit::TimeLimit), most));
            }
            if has_ended(&end, left.min(POLL_INTERVAL))? {
                return Ok((None, most));
            }
            children.reap()?;
            // No labeller can read its results any more.
            let found = self.directory.symlink_metadata();
            if found.is_err_and(|error| error.kind() == ErrorKind::NotFound) {
                return Ok((Some(Exit::LostNode), most));
            }
            if let Some(limit) = self.memory_limit {
                most = most.max(process_tree::memory());
                if most > limit {
                    return Ok((Some(Exit::OutOfMemory), most));
                }
            }
        }
    }

    fn not_started(&self) -> Option<i32> {
        let number = result_file::read(&self.directory.join(NOT_STARTED)).ok()?;
        String::from_utf8(number).ok()?.parse().ok()
    }
}

/// Sends a request to a process that waits for one.
pub(super) fn send_request(mut stdin: impl Write, request: &RunnerRequest) -> io::Result<()> {
    let mut line = serde_json::to_vec(request)?;
    line.push(b'\n');
    stdin.write_all(&line)
}

/// Waits for the end of a process, up to the timeout.
fn has_ended(process: &impl AsFd, timeout: Duration) -> io::Result<bool> {
    // At most a day: the caller checks the time again.
    let timeout = timeout.min(Duration::from_secs(86_400));
    let timeout = Timespec::try_from(timeout).map_err(io::Error::other)?;
    match poll(&mut [PollFd::new(process, PollFlags::IN)], Some(&timeout)) {
        Ok(ready) => Ok(ready > 0),
        Err(rustix::io::Errno::INTR) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

fn exit(status: ExitStatus) -> Exit {
    match status.code() {
        Some(code) => Exit::Code(code),
        None => Exit::Signal(status.signal().unwrap_or_default()),
    }
}

/// Number of processes in this control group that the system has killed because memory ran out; 0 if it does not
/// tell.
fn out_of_memory_kills() -> u64 {
    let count = || {
        let groups = fs::read_to_string("/proc/self/cgroup").ok()?;
        let group = groups.lines().find_map(|line| line.strip_prefix("0::/"))?;
        let events =
            fs::read_to_string(Path::new("/sys/fs/cgroup").join(group).join("memory.events")).ok()?;
        events.lines().find_map(|line| line.strip_prefix("oom_kill "))?.parse().ok()
    };
    count().unwrap_or_default()
}
