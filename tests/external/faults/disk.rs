//! The disk of a campaign or the host's shared memory is full.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use tempfile::TempDir;

use super::must;
use crate::common::campaign::{Counters, Small, outcome};
use crate::common::hosts::{started, uninterrupted_outcome};
use crate::common::processes::{assert_no_leftovers, pause_walkers, processes_in, signal, wait_until};
use crate::common::{Running, program, random, through};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "."];

fn small() -> Small {
    Small { steps: 1600, max_per_walk: 12, ..Small::default() }
}

/// A small disk.
struct Disk {
    at: PathBuf,
    /// Directory of the mount point, which also stores the standard error of `run`.
    home: TempDir,
}

impl Disk {
    fn new(megabytes: u32) -> Self {
        let home = tempfile::tempdir().unwrap();
        let at = home.path().join("disk");
        fs::create_dir(&at).unwrap();
        must(&format!("mount -t tmpfs -o size={megabytes}m tmpfs {}", at.display()));
        Self { at, home }
    }

    /// Fills the remaining space.
    fn fill(&self) {
        let filler = self.at.join("filler");
        let to = format!("of={}", filler.display());
        let written = Command::new("dd").args(["if=/dev/zero", "bs=64k", &to]).output().unwrap();
        assert!(!written.status.success(), "the disk is too large");
    }

    fn make_space(&self) {
        fs::remove_file(self.at.join("filler")).unwrap();
    }

    fn run(&self) -> Running {
        let mut command = program(&self.at);
        started(command.args(RUN), &self.home.path().join("said"))
    }

    /// Standard error since the last call.
    fn said(&self) -> String {
        let path = self.home.path().join("said");
        let said = fs::read_to_string(&path).unwrap();
        fs::write(path, "").unwrap();
        said
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").args(["--lazy".as_ref(), self.at.as_os_str()]).status();
    }
}

/// `run` ends with a clear message, and continues when there is space. Labellers keep their results until then.
#[test]
fn a_full_disk_ends_a_run_and_loses_nothing() {
    let disk = Disk::new(256);
    small().write(&disk.at);
    let mut before = Counters::read(".", &disk.at);
    for full in 0..2 {
        let mut run = disk.run();
        wait_until("the campaign advances", || Counters::read(".", &disk.at).sent > before.sent);
        std::thread::sleep(Duration::from_millis(random(full) % 200));
        // The campaign must not end before the disk is full.
        let held = pause_walkers(&disk.at, 2);
        before = Counters::read(".", &disk.at);
        disk.fill();
        held.resume();
        assert_eq!(run.0.wait().unwrap().code(), Some(1));
        let said = disk.said();
        let words =
            "the disk is full: nothing was written, and earlier commits are safe; free space and start again";
        assert!(said.contains(words), "{said}");
        // A new `run` does not start either.
        assert_eq!(disk.run().0.wait().unwrap().code(), Some(1));
        let said = disk.said();
        assert!(said.contains("the disk is full"), "{said}");
        disk.make_space();
        let after = Counters::read(".", &disk.at);
        assert!(after.has_not_decreased_since(&before), "{before:?} {after:?}");
    }
    assert_eq!(disk.run().0.wait().unwrap().code(), Some(0), "{}", disk.said());
    assert_eq!(outcome(&disk.at), uninterrupted_outcome(&small()));
    assert_no_leftovers(&disk.at);
}

/// A campaign reserves the shared memory that it needs when it starts.
#[test]
fn shared_memory_that_others_fill_does_no_harm() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    small().write(here);
    let sleeping = Command::new("unshare").args(["--mount", "sleep", "3600"]).spawn();
    let host = Running(sleeping.expect("unshare, of util-linux"));
    let namespace = format!("/proc/{}/ns/mnt", host.0.id());
    let own = fs::read_link("/proc/self/ns/mnt").unwrap();
    wait_until("there is a namespace (as root)", || {
        fs::read_link(Path::new(&namespace)).is_ok_and(|other| other != own)
    });
    let inside = format!("nsenter --mount={namespace}");
    must(&format!("{inside} mount -t tmpfs -o size=64m tmpfs /dev/shm"));
    let starter = ["nsenter".into(), format!("--mount={namespace}"), format!("--wd={}", here.display())];
    let said = here.join("said");
    let mut run = started(through(&starter, here).args(RUN), &said);
    wait_until("walkers are running", || Counters::read(".", here).sent > 0);
    let held = pause_walkers(here, 2);
    must(&format!("{inside} sh -c '! dd if=/dev/zero of=/dev/shm/filler bs=64k'"));
    // Walkers started from now on find it full.
    signal(held.pids()[0], "KILL");
    held.resume();
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", fs::read_to_string(&said).unwrap());
    wait_until("all processes have exited", || processes_in(here).is_empty());
    must(&format!("{inside} sh -c 'rm /dev/shm/filler && ! ls /dev/shm | grep ^cw-'"));
    assert_eq!(outcome(here), uninterrupted_outcome(&small()));
}
