//! The process that keeps a calculation: it starts the program, sees to its limits, and leaves behind how it ended. It
//! outlives the labeller that started it, so what a killed labeller had begun is finished all the same.
//!
//! It is this program again, with an [`RunnerRequest`] on its standard input. Until that has come nothing is started: whoever starts
//! a keeper writes down which process it is before. The program itself is started by a second process of the same kind,
//! which ties itself to the keeper and then becomes the program.

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
use super::process_tree::{self, Children};
use super::remove_tree::remove_tree;

/// Where the program works, in the directory of a calculation.
pub(super) const WORK: &str = "work";
/// What the keeper leaves there when the calculation has ended.
const END: &str = "end.json";
/// Between two looks at the memory in use, and for processes that have ended.
const POLL_INTERVAL: Duration = Duration::from_millis(500);
/// The variable by which everything that a calculation starts can be known: its directory.
pub(super) const MARK: &str = "CALMWALK_CALCULATION";
/// In this variable Slurm says on which node a job runs.
const NODE_VARIABLE: &str = "SLURMD_NODENAME";
/// Slurm ends all processes of a job, one after the other: the keeper may outlive its program for so long.
const SLURM_KILL_TIME: Duration = Duration::from_secs(5);
/// What the second process leaves there if it could not become the program.
const NOT_STARTED: &str = "not-started";

/// What this program is to be, one line of JSON.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum RunnerRequest {
    /// The keeper of a calculation.
    #[serde(rename = "Keep")]
    Run(Calculation),
    /// Its program.
    #[serde(rename = "Become")]
    Exec {
        #[serde(rename = "keeper")]
        runner: u32,
        directory: PathBuf,
        command: Vec<String>,
    },
}

/// What is to be calculated, and within which limits.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Calculation {
    pub directory: PathBuf,
    pub command: Vec<String>,
    pub environment: Vec<(String, String)>,
    /// What the program gets besides of the environment in which the keeper is started.
    #[serde(default)]
    pub pass_environment: PassedEnvironment,
    /// Seconds.
    pub time_limit: f64,
    /// Bytes that all its processes together may have in memory.
    pub memory_limit: Option<u64>,
    /// How a keeper is started.
    #[serde(rename = "keeper")]
    pub runner: RunnerCommand,
}

/// The program, with its arguments, that calls [`keep`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunnerCommand {
    /// A path.
    pub program: PathBuf,
    /// What it is started with.
    pub arguments: Vec<String>,
}

impl Default for RunnerCommand {
    /// `calmwalk keep`, of this very program, also when its file was replaced meanwhile.
    fn default() -> Self {
        Self { program: "/proc/self/exe".into(), arguments: vec!["keep".to_owned()] }
    }
}

impl RunnerCommand {
    pub(super) fn command(&self) -> Command {
        let mut command = Command::new(&self.program);
        // People look for that name in lists of processes.
        command.arg0(std::env::args_os().next().unwrap_or_else(|| "calmwalk".into())).args(&self.arguments);
        command
    }
}

/// How a calculation ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct CalculationEnd {
    pub how: EndReason,
    /// The program, as the command calls it.
    pub program: PathBuf,
    /// From the program's start to its end, s.
    pub seconds: f64,
    /// Most bytes that its processes were seen to have in memory together; 0 where nobody looked.
    pub memory: u64,
    /// Node of the batch system on which it ran.
    #[serde(default)]
    pub node: Option<String>,
    /// What is known of it if no keeper left this, but another found it out.
    #[serde(default)]
    pub remark: Option<String>,
}

/// See [`CalculationEnd`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum EndReason {
    /// By itself, or at a limit.
    Ended(#[serde(with = "ExitOnFile")] Exit),
    /// There is no such program, or it cannot be executed: the system's number of the error.
    NotStarted(i32),
}

/// [`Exit`] as it is written down.
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
    /// What a keeper left in the directory, if the calculation has ended.
    pub fn read(directory: &Path) -> Option<Self> {
        serde_json::from_slice(&result_file::read(&directory.join(END)).ok()?).ok()
    }

    /// It appears as a whole, and only when everything else is over.
    pub fn write(&self, directory: &Path) -> io::Result<()> {
        let (unfinished, finished) = (directory.join(format!("{END}.new")), directory.join(END));
        // The program may have left anything under these names.
        remove_existing(&unfinished)?;
        let mut file = File::options().write(true).create_new(true).open(&unfinished)?;
        file.write_all(&serde_json::to_vec(self)?)?;
        remove_existing(&finished)?;
        fs::rename(unfinished, finished)
    }
}

/// Removes what has that name, whatever it is.
fn remove_existing(path: &Path) -> io::Result<()> {
    match fs::symlink_metadata(path) {
        Ok(found) if found.is_dir() => remove_tree(path),
        Ok(_) => fs::remove_file(path),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        Err(error) => Err(error),
    }
}

/// Does what standard input says: keeps a calculation, or becomes its program. To be called on the main thread of a
/// process that does nothing else.
///
/// # Errors
/// What the system refused. Without an order, since whoever started this process is gone, nothing is done.
pub fn run_calculation() -> io::Result<()> {
    let stdin = io::stdin();
    // A batch job reads its order from a file, in whose place another user might have put one.
    let request = rustix::fs::fstat(&stdin)?;
    if rustix::fs::FileType::from_raw_mode(request.st_mode).is_file() && request.st_uid != geteuid().as_raw()
    {
        return Err(io::Error::other(format!(
            "the request is a file of user {}, expected one's own",
            request.st_uid
        )));
    }
    let mut line = String::new();
    stdin.lock().read_line(&mut line)?;
    // An order that was cut off was not given.
    match line.ends_with('\n').then(|| serde_json::from_str(&line)) {
        None => Ok(()),
        Some(Err(error)) => Err(error.into()),
        Some(Ok(RunnerRequest::Run(calculation))) => calculation.run(),
        Some(Ok(RunnerRequest::Exec { runner, directory, command })) => {
            Err(exec_program(runner, &directory, &command))
        }
    }
}

/// Returns only if that fails.
fn exec_program(runner: u32, directory: &Path, command: &[String]) -> io::Error {
    // A request: what starts others on other nodes has to end them.
    if let Err(error) = set_parent_process_death_signal(Some(Signal::TERM)) {
        return error.into();
    }
    // It may have died before.
    if getppid().map(|pid| pid.as_raw_nonzero().get().unsigned_abs()) != Some(runner) {
        return io::Error::other("the runner of this calculation is gone");
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
    /// Starts the program, waits for it, and ends it at a limit.
    fn run(self) -> io::Result<()> {
        if !private_directory::is_own(&self.directory) {
            let message = format!("{} is no directory of this user", self.directory.display());
            return Err(io::Error::other(message));
        }
        // Neither Ctrl-C nor the end of the labeller's group reaches this process or its program.
        setsid()?;
        // Whatever the program starts stays below this process, also when those that started it are gone.
        set_child_subreaper(Some(getpid()))?;
        let kills = out_of_memory_kills();
        let begun = Instant::now();
        let program = self.start()?;
        let program = i32::try_from(program.id()).ok().and_then(Pid::from_raw);
        let program = program.ok_or(ErrorKind::InvalidInput)?;
        let mut children = Children::new(program);
        let (limit, memory) = self.wait(program, &mut children, begun)?;
        let status = children.terminate()?;
        let seconds = begun.elapsed().as_secs_f64();
        let node = std::env::var(NODE_VARIABLE).ok();
        if node.is_some() && limit.is_none() && !status.success() {
            // If it was not the program's fault, this process ends here as well, and Slurm tells why.
            std::thread::sleep(SLURM_KILL_TIME);
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
            .envs(self.pass_environment.of_this_process())
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

    /// Waits until the program has ended, or must end: then the limit. The second is how much memory was seen in use.
    fn wait(&self, program: Pid, children: &mut Children, begun: Instant) -> io::Result<(Option<Exit>, u64)> {
        let end = pidfd_open(program, PidfdFlags::empty())?;
        let limit = Duration::try_from_secs_f64(self.time_limit).unwrap_or(Duration::MAX);
        let mut most = 0;
        loop {
            let left = limit.saturating_sub(begun.elapsed());
            if left.is_zero() {
                return Ok((Some(Exit::TimeLimit), most));
            }
            if has_ended(&end, left.min(POLL_INTERVAL))? {
                return Ok((None, most));
            }
            children.reap()?;
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

/// Gives an order to a process that waits for one.
pub(super) fn send_request(mut stdin: impl Write, request: &RunnerRequest) -> io::Result<()> {
    let mut line = serde_json::to_vec(request)?;
    line.push(b'\n');
    stdin.write_all(&line)
}

/// Waits for the end of a process, for so long.
fn has_ended(process: &impl AsFd, timeout: Duration) -> io::Result<bool> {
    // A day more or less: who waits looks at the clock again.
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

/// How many processes the system has killed in this control group because it had no memory left; 0 where it does not tell.
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
