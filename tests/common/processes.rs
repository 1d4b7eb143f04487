//! Finds and signals the processes of a campaign.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, PgConnection};
use wire::shm_dir::ShmDir;

/// A process in a directory: its pid and its command.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Process {
    pub pid: u32,
    pub command: String,
}

/// All running processes of the program in `directory`.
pub fn processes_in(directory: &Path) -> Vec<Process> {
    let directory = directory.canonicalize().expect("the campaign's directory");
    let numbers = fs::read_dir("/proc").expect("/proc").flatten();
    let numbers = numbers.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    let process = |pid: u32| {
        let here = fs::read_link(format!("/proc/{pid}/cwd")).ok()? == directory;
        let line = fs::read_to_string(format!("/proc/{pid}/cmdline")).ok()?;
        let mut words = line.split('\0');
        let ours = words.next()?.ends_with("calmwalk") && here;
        ours.then(|| words.next().map(|command| Process { pid, command: command.to_owned() }))?
    };
    numbers.filter_map(process).collect()
}

/// Pids of the processes that run `command`.
pub fn processes_running(directory: &Path, command: &str) -> Vec<u32> {
    processes_in(directory).into_iter().filter(|p| p.command == command).map(|p| p.pid).collect()
}

/// Waits for a process that runs `command`.
pub fn wait_for_process(directory: &Path, command: &str) -> u32 {
    let mut found = None;
    wait_until(&format!("a {command} is running"), || {
        found = processes_running(directory, command).first().copied();
        found.is_some()
    });
    found.expect("a process")
}

/// Processes that calculations in directories below `scratch` have started: pids with their command lines.
pub fn calculation_processes(scratch: &Path) -> Vec<(u32, String)> {
    let mark = format!("CALMWALK_CALCULATION={}/", scratch.display());
    let numbers = fs::read_dir("/proc").expect("/proc").flatten();
    let numbers = numbers.filter_map(|entry| entry.file_name().to_str()?.parse().ok());
    let marked = |pid: u32| {
        let environment = fs::read(format!("/proc/{pid}/environ")).ok()?;
        let command = fs::read_to_string(format!("/proc/{pid}/cmdline")).ok()?.replace('\0', " ");
        String::from_utf8_lossy(&environment).contains(&mark).then_some((pid, command))
    };
    numbers.filter_map(marked).collect()
}

/// Sends a signal. Ignores a process that has ended.
pub fn signal(pid: u32, name: &str) {
    kill_command(pid, name).output().expect("kill runs");
}

fn kill_command(pid: u32, signal: &str) -> Command {
    let mut command = Command::new("kill");
    command.args([format!("-{signal}"), pid.to_string()]);
    command
}

/// Processes that SIGSTOP has stopped, until [`Self::resume`]. Dropping this kills them, so that a test that fails leaves no
/// stopped process behind.
#[must_use = "dropping it kills the processes"]
pub struct PausedProcesses(Vec<u32>);

impl PausedProcesses {
    /// Stops these processes.
    pub fn new(pids: impl Into<Vec<u32>>) -> Self {
        let paused = Self(pids.into());
        paused.0.iter().for_each(|pid| signal(*pid, "STOP"));
        paused
    }

    /// Stops these processes, but none within a transaction, which would block other writers. `store` is the campaign's
    /// directory or URL.
    pub fn outside_transactions(pids: impl Into<Vec<u32>>, store: &str) -> Self {
        let paused = Self(pids.into());
        for pid in &paused.0 {
            wait_until("it is stopped outside of a transaction", || {
                signal(*pid, "STOP");
                let others_can_write = can_write(store);
                if !others_can_write {
                    signal(*pid, "CONT");
                }
                others_can_write
            });
        }
        paused
    }

    pub fn pids(&self) -> &[u32] {
        &self.0
    }

    /// Lets the processes continue.
    pub fn resume(mut self) {
        self.0.iter().for_each(|pid| signal(*pid, "CONT"));
        self.0.clear();
    }
}

impl Drop for PausedProcesses {
    fn drop(&mut self) {
        for pid in &self.0 {
            // SIGKILL also ends a stopped process. The test may be failing already.
            let _ = kill_command(*pid, "KILL").output();
        }
    }
}

/// Whether the job table can be locked within a second.
fn can_write(store: &str) -> bool {
    tokio::runtime::Runtime::new().expect("a runtime").block_on(async {
        let Some((server, schema)) = store.split_once("?schema=") else {
            let options = SqliteConnectOptions::new().filename(Path::new(store).join("campaign.sqlite"));
            let mut connection =
                options.busy_timeout(Duration::from_secs(1)).connect().await.expect("a database");
            return sqlx::raw_sql("BEGIN IMMEDIATE; ROLLBACK").execute(&mut connection).await.is_ok();
        };
        let mut connection = PgConnection::connect(server).await.expect("a server");
        let sql = format!("SET lock_timeout = '1s'; SELECT 1 FROM {schema}.job FOR UPDATE");
        sqlx::raw_sql(AssertSqlSafe(sql)).execute(&mut connection).await.is_ok()
    })
}

/// Stops all walkers as soon as there are `number` of them. The campaign cannot end until they are resumed.
pub fn pause_walkers(directory: &Path, number: usize) -> PausedProcesses {
    let mut walkers = Vec::new();
    wait_until(&format!("there are {number} walkers"), || {
        walkers = processes_running(directory, "walker");
        walkers.len() == number
    });
    PausedProcesses::new(walkers)
}

/// Waits until a condition holds.
pub fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !is_so() {
        assert!(begun.elapsed() < Duration::from_secs(300), "timed out waiting until {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Checks that a finished campaign left no process and nothing in shared memory.
pub fn assert_no_leftovers(directory: &Path) {
    wait_until("all processes have exited", || processes_in(directory).is_empty());
    let place = ShmDir::for_campaign(directory).expect("the campaign's directory");
    assert!(!place.directory().exists(), "{} is left", place.directory().display());
    let files = fs::read_dir("/dev/shm").expect("/dev/shm").flatten();
    let left: Vec<_> = files.map(|file| file.file_name().to_string_lossy().into_owned()).collect();
    assert!(!left.iter().any(|name| name.starts_with(place.prefix())), "{left:?}");
}
