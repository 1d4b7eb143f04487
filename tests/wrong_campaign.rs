//! Directories and databases in which a campaign cannot run: each is reported and left unchanged.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use tempfile::TempDir;

use crate::common::campaign::{Small, outcome};
use crate::common::hosts::uninterrupted_outcome;
use crate::common::processes::PausedProcesses;
use crate::common::{Running, calmwalk, program, refuse, stderr, succeed};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "here"];

/// A campaign that is small enough to run repeatedly.
fn small() -> Small {
    Small { steps: 60, ..Small::default() }
}

fn written(small: &Small) -> TempDir {
    let directory = tempfile::tempdir().unwrap();
    small.write(directory.path());
    directory
}

fn assert_plain(output: &Output, code: i32) -> String {
    let message = stderr(output);
    assert_eq!(output.status.code(), Some(code), "{message}");
    assert!(!message.contains("panicked") && !message.contains("RUST_BACKTRACE"), "{message}");
    message
}

#[test]
fn other_files_in_the_place_of_the_database_are_refused_unchanged() {
    let directory = written(&small());
    succeed(directory.path(), RUN);
    let database = directory.path().join("here/campaign.sqlite");
    let good = fs::read(&database).unwrap();
    // https://www.sqlite.org/fileformat.html: user version at byte 60, application id at byte 68, big-endian.
    let patched = |place: usize, value: u32| {
        let mut bytes = good.clone();
        bytes[place..place + 4].copy_from_slice(&value.to_be_bytes());
        bytes
    };
    let known = u32::from_be_bytes(good[60..64].try_into().unwrap());
    let refused =
        |version: u32| format!("has schema version {version}, and this program reads up to version {known}");
    for (content, words) in [
        (patched(60, known + 1), refused(known + 1).as_str()),
        (patched(60, 0), refused(0).as_str()),
        (patched(68, 5), "is a database of another program (application id 0x5,"),
        (
            b"units metal\natom_style atomic\n".to_vec(),
            "is not an SQLite database: it begins with 'units metal",
        ),
        (Vec::new(), "is not an SQLite database: it begins with ''"),
    ] {
        fs::write(&database, &content).unwrap();
        let message = assert_plain(&calmwalk(directory.path(), RUN), 2);
        assert!(message.contains("here/campaign.sqlite ") && message.contains(words), "{message}");
        assert_eq!(fs::read(&database).unwrap(), content);
    }
    fs::write(&database, &good).unwrap();
    succeed(directory.path(), RUN);
}

#[test]
fn a_damaged_database_is_reported_and_left_unchanged() {
    let directory = written(&small());
    succeed(directory.path(), RUN);
    let database = directory.path().join("here/campaign.sqlite");
    let good = fs::read(&database).unwrap();
    let damaged = |range: std::ops::Range<usize>| {
        let mut bytes = good.clone();
        bytes[range].fill(0xa5);
        bytes
    };
    let n = good.len();
    for content in [damaged(4096..n), damaged(n / 20..n / 2), good[..n / 2].to_vec(), good[..100].to_vec()] {
        fs::write(&database, &content).unwrap();
        let message = assert_plain(&calmwalk(directory.path(), RUN), 1);
        assert!(message.contains("campaign in here: damaged database: "), "{message}");
        assert!(message.contains("restore the campaign from a backup"), "{message}");
        assert_eq!(fs::read(&database).unwrap(), content);
    }
    fs::write(&database, &good).unwrap();
    succeed(directory.path(), RUN);
}

#[test]
fn a_path_that_is_not_a_directory_is_reported() {
    let directory = written(&small());
    let text = fs::read(directory.path().join("campaign.toml")).unwrap();
    for (place, reason) in [("campaign.toml", "it is a file"), ("campaign.toml/here", "Not a directory")] {
        let message = refuse(directory.path(), ["run", "campaign.toml", "--directory", place]);
        assert!(message.contains(&format!("cannot use the directory {place} ({reason}")), "{message}");
    }
    assert_eq!(fs::read(directory.path().join("campaign.toml")).unwrap(), text);
    let message = refuse(directory.path(), ["status", "."]);
    assert!(message.contains("there is no campaign in .: it has no campaign.sqlite"), "{message}");
}

#[test]
fn names_need_not_be_utf_8_except_for_sqlite() {
    let above = tempfile::tempdir().unwrap();
    let directory = above.path().join(OsStr::from_bytes(b"no \xff text"));
    fs::create_dir(&directory).unwrap();
    small().write(&directory);
    let config = directory.join("campaign.toml");
    succeed(above.path(), [OsStr::new("validate"), config.as_os_str()]);
    let run = |place: &OsStr| {
        [OsStr::new("run"), config.as_os_str(), OsStr::new("--directory"), place].map(OsString::from)
    };
    let message = refuse(above.path(), run(directory.as_os_str()));
    assert!(message.contains("(its name is not UTF-8, which SQLite requires)"), "{message}");
    assert!(succeed(above.path(), run(OsStr::new("here"))).contains("; next:"));
}

/// The program as an unprivileged user; `None` if this process cannot change its user.
fn unprivileged(directory: &Path) -> Option<Command> {
    let rights = ["--reuid=65534", "--regid=65534", "--clear-groups"];
    let program = env!("CARGO_BIN_EXE_calmwalk");
    let works = Command::new("setpriv").args(rights).args([program, "--version"]).output();
    if !works.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: cannot become an unprivileged user here");
        return None;
    }
    let mut command = Command::new("setpriv");
    command.args(rights).arg(program).current_dir(directory);
    Some(command)
}

#[test]
fn a_directory_without_write_permission_is_reported() {
    let directory = written(&small());
    fs::set_permissions(directory.path(), fs::Permissions::from_mode(0o755)).unwrap();
    let Some(mut command) = unprivileged(directory.path()) else { return };
    let message = assert_plain(&command.args(RUN).output().unwrap(), 2);
    assert!(message.contains("cannot use the directory here (Permission denied"), "{message}");
    assert!(!directory.path().join("here").exists());

    // The user cannot continue another user's campaign either.
    succeed(directory.path(), RUN);
    let database = directory.path().join("here/campaign.sqlite");
    let before = fs::read(&database).unwrap();
    let mut command = unprivileged(directory.path()).expect("as before");
    let message = assert_plain(&command.args(RUN).output().unwrap(), 2);
    assert!(message.contains("cannot use the directory here (Permission denied"), "{message}");
    assert_eq!(fs::read(&database).unwrap(), before);
}

/// A small file system, unmounted on drop.
struct Disk<'a>(&'a Path);

impl<'a> Disk<'a> {
    fn mount(place: &'a Path, size: &str) -> Option<Self> {
        let arguments = ["-t", "tmpfs", "-o", size, "tmpfs"];
        let mounted = Command::new("mount").args(arguments).arg(place).output();
        mounted.is_ok_and(|output| output.status.success()).then_some(Self(place))
    }

    fn enlarge(&self) {
        let status = Command::new("mount").args(["-o", "remount,size=50m"]).arg(self.0).status();
        assert!(status.unwrap().success());
    }
}

impl Drop for Disk<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(self.0).status();
    }
}

#[test]
fn a_full_disk_loses_nothing() {
    let small = Small::default();
    let expected = uninterrupted_outcome(&small);
    // The disk is full when the database is created, published or opened, or during the campaign.
    for size in ["size=4k", "size=64k", "size=200k", "size=300k", "size=600k", "size=800k"] {
        let directory = written(&small);
        let here = directory.path().join("here");
        fs::create_dir(&here).unwrap();
        let Some(disk) = Disk::mount(&here, size) else {
            eprintln!("skipped: cannot mount a file system here");
            return;
        };
        let message = assert_plain(&calmwalk(directory.path(), RUN), 1);
        assert!(message.contains("the disk is full: nothing was written"), "{size}: {message}");
        disk.enlarge();
        succeed(directory.path(), RUN);
        assert_eq!(outcome(&here), expected, "{size}");
    }
}

#[test]
fn a_log_that_cannot_be_kept_stops_no_campaign() {
    let directory = written(&small());
    let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let output = program(directory.path()).args(RUN).stderr(full).output().unwrap();
    assert_eq!(output.status.code(), Some(0));
    // The summary is the requested output, so failing to print it is an error; the next run prints it.
    let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let output = program(directory.path()).args(RUN).stdout(full).output().unwrap();
    let message = assert_plain(&output, 1);
    assert!(message.contains("cannot write to the standard output: No space left"), "{message}");
    assert_eq!(succeed(directory.path(), RUN).lines().next(), Some("walks            2 biased, 2 control"));
}

#[test]
fn a_second_run_of_a_campaign_names_the_first() {
    let small = Small::default();
    let directory = written(&small);
    let mut first = program(directory.path());
    let first = first.args(RUN).stdout(Stdio::null()).stderr(Stdio::null());
    let mut first = Running(first.spawn().unwrap());
    let lock = directory.path().join("here/campaign.lock");
    while !fs::read_to_string(&lock).is_ok_and(|text| text.contains("process")) {
        assert!(first.0.try_wait().unwrap().is_none(), "the first run ended before the second began");
        std::thread::yield_now();
    }
    // Pause the first run, so that it cannot end before the second starts.
    let held = PausedProcesses::new([first.0.id()]);
    let second = calmwalk(directory.path(), RUN);
    held.resume();
    let message = assert_plain(&second, 2);
    assert!(message.contains(&format!("being run by process {} (calmwalk run)", first.0.id())), "{message}");
    assert_eq!(first.0.wait().unwrap().code(), Some(0));
    assert_eq!(outcome(&directory.path().join("here")), uninterrupted_outcome(&small));
}

#[test]
fn labels_that_fail_do_not_stop_a_campaign() {
    let small = small();
    let directory = written(&small);
    let text = small.text().replace("[label]", "[label]\nmax_force = 1e-6\nmax_attempts = 2");
    fs::write(directory.path().join("campaign.toml"), text).unwrap();
    let summary = succeed(directory.path(), RUN);
    assert!(summary.contains("labels           0 biased and 0 control structures labelled"), "{summary}");
    assert!(summary.contains("calmwalk queue here list --state failed"), "{summary}");
    let status = succeed(directory.path(), ["status", "here", "--json"]);
    let status: serde_json::Value = serde_json::from_str(&status).unwrap();
    assert!(status["labels"]["failed"].as_u64().unwrap() > 0, "{status}");
    assert_eq!((&status["labels"]["queued"], &status["finished"]), (&0.into(), &true.into()), "{status}");
    let jobs = succeed(directory.path(), ["queue", "here", "list", "--state", "failed", "--json"]);
    let jobs: serde_json::Value = serde_json::from_str(&jobs).unwrap();
    let candidate = jobs[0]["candidate"].as_str().unwrap();
    let details = succeed(directory.path(), ["queue", "here", "show", candidate]);
    assert_eq!(details.matches("beyond label.max_force").count(), 2, "{details}");
}
