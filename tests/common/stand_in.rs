//! Batch systems on this host: stand-ins for the commands of PBS and LSF, with the examples of `configs/`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

use super::config;

/// A batch system on this host. When it is dropped, its jobs are killed.
pub struct StandIn {
    name: &'static str,
    queue: TempDir,
}

impl StandIn {
    /// `pbs` or `lsf`.
    pub fn new(name: &'static str) -> Self {
        Self { name, queue: tempfile::tempdir().unwrap() }
    }

    /// The table `[launch.custom]` of the example.
    pub fn table(&self) -> String {
        fs::read_to_string(config(&format!("{}.toml", self.name))).unwrap()
    }

    /// Lets a command call the batch system.
    pub fn known_to(&self, command: &mut Command) {
        let commands = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/stand_ins").join(self.name);
        let path = std::env::var_os("PATH").unwrap();
        let path = std::env::join_paths([commands].into_iter().chain(std::env::split_paths(&path)));
        command.env("PATH", path.unwrap()).env("STAND_IN_QUEUE", self.queue.path());
    }

    /// Holds back jobs that have not started, or releases them.
    pub fn hold(&self, on: bool) {
        let path = self.queue.path().join("hold");
        if on { fs::write(path, "").unwrap() } else { fs::remove_file(path).unwrap() }
    }

    /// Numbers and states of all jobs, oldest first.
    pub fn jobs(&self) -> Vec<(u32, String)> {
        let entries = fs::read_dir(self.queue.path()).unwrap().flatten();
        let number = |entry: fs::DirEntry| entry.file_name().to_str()?.parse().ok();
        let mut numbers: Vec<u32> = entries.filter_map(number).collect();
        numbers.sort_unstable();
        numbers.into_iter().map(|number| (number, self.about(number, "state"))).collect()
    }

    /// Numbers of the jobs in this state: `PEND`, `RUN`, `DONE`, `EXIT`.
    pub fn in_state(&self, state: &str) -> Vec<u32> {
        self.jobs().into_iter().filter(|(_, found)| found == state).map(|(number, _)| number).collect()
    }

    /// A file of a job.
    pub fn about(&self, number: u32, file: &str) -> String {
        let text = fs::read_to_string(self.queue.path().join(number.to_string()).join(file));
        text.unwrap_or_default().trim().to_owned()
    }

    /// Cancels a job, as its user does.
    pub fn cancel(&self, number: u32) {
        let (program, id) = match self.name {
            "pbs" => ("qdel", format!("{number}.pbs01")),
            _ => ("bkill", number.to_string()),
        };
        let mut command = Command::new("sh");
        command.args(["-c", &format!("{program} {id}")]);
        self.known_to(&mut command);
        assert!(command.output().unwrap().status.success(), "{program} {id}");
    }

    /// The recorded jobs of a campaign: roles with ids.
    pub fn recorded(&self, directory: &Path) -> Vec<(String, String)> {
        let path: PathBuf = directory.join("jobs/jobs.json");
        let records: Value = serde_json::from_slice(&fs::read(path).unwrap()).unwrap();
        let job = |job: &Value| {
            let name = job["name"].as_str().unwrap().splitn(3, '-').nth(2).unwrap().to_owned();
            (name, job["id"].as_str().unwrap().to_owned())
        };
        records["jobs"].as_array().unwrap().iter().map(job).collect()
    }
}

impl Drop for StandIn {
    fn drop(&mut self) {
        for number in self.in_state("RUN") {
            let session = self.about(number, "session");
            let list = Command::new("ps").args(["-o", "pid=", "-s", &session]).output();
            let Ok(list) = list else { continue };
            for pid in String::from_utf8_lossy(&list.stdout).split_whitespace() {
                let _ = Command::new("kill").args(["-KILL", pid]).output();
            }
        }
    }
}
