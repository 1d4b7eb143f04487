//! Labelling programs that leave arbitrary files and processes behind: the labeller survives, and other users of the host
//! cannot interfere.

use std::fs::{self, Permissions};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;
use std::process::{Command, Output};

use atoms::extxyz::{Frame, write_frame};
use atoms::{Cell, Structure};
use store::JobState;

use crate::common;
use crate::common::campaign::Small;
use crate::common::label_campaign::{LabelCampaign, WRITE_FIXED_LABEL, on_store, queue};
use crate::common::processes::{calculation_processes, pause_walkers, wait_until};
use crate::common::{program, stderr};

/// Name, shell command, and expected message of each kind of output.
const LEFT: [(&str, &str, &str); 13] = [
    ("pipe", "mkfifo label.extxyz", "label.extxyz is a named pipe, expected a regular file"),
    ("link", "ln -s /dev/zero label.extxyz", "label.extxyz is a symbolic link, expected a regular file"),
    (
        "sparse",
        "truncate -s 4G label.extxyz",
        "label.extxyz has 4294967296 bytes, expected at most 268435456",
    ),
    ("directory", "mkdir label.extxyz", "label.extxyz is a directory, expected a regular file"),
    ("device", "mknod label.extxyz c 1 5 || mkfifo label.extxyz", "expected a regular file"),
    ("nothing", ":", "label.extxyz is missing"),
    ("noise", "head -c 100000 /dev/urandom > label.extxyz; echo >> label.extxyz", "label.extxyz"),
    ("zeros", "head -c 1000000 /dev/zero > label.extxyz; echo >> label.extxyz", "label.extxyz"),
    ("logs", "rm stdout stderr; mkfifo stdout; ln -s /dev/zero stderr; exit 1", "ended with exit code 1"),
    ("end", "mkfifo ../end.json.new; mkdir -p ../end.json/in; exit 1", "ended with exit code 1"),
    (
        "closed",
        "mkdir -p closed/in; echo > closed/in/file; chmod 0 closed/in closed; exit 1",
        "ended with exit code 1",
    ),
    ("names", "echo > \"$(printf 'caf\\351\\nnew \\001')\"; exit 1", "ended with exit code 1"),
    (
        "deep",
        // A path of 5000 directories exceeds the system's maximum path length.
        "thousand=$(printf 'd/%.0s' $(seq 1000)); for times in 1 2 3 4 5; do mkdir -p $thousand; cd -P $thousand; done; exit 1",
        "ended with exit code 1",
    ),
];

/// A script that produces one kind of [`LEFT`] for each structure, and a label on the second attempt.
fn script(home: &Path) -> String {
    let home = home.display();
    let mut script = format!(
        "stat -c '%a %u' .. ../.. >> {home}/modes\npwd -P >> {home}/places\nleft=$(md5sum < structure.extxyz | cut -d' ' -f1)\n\
         if mkdir {home}/seen/$left 2> /dev/null; then kind=$(ls {home}/kinds | head -n 1); fi\n\
         if [ -n \"$kind\" ]; then rmdir {home}/kinds/$kind; echo \"this is $kind\"; fi\ncase \"$kind\" in\n"
    );
    for (kind, left, _) in LEFT {
        script += &format!("{kind}) {left}; exit ;;\n");
    }
    script + "esac\n" + WRITE_FIXED_LABEL
}

/// Two atoms, 2.5 Å and `number` hundredths of an Å apart.
fn pair(number: usize) -> Structure {
    Structure {
        species: vec!["Al".parse().unwrap(); 2],
        positions: vec![[0.0; 3], [2.5 + 0.01 * number as f64, 0.0, 0.0]],
        cell: Cell::orthorhombic(8.0, 8.0, 8.0),
        periodic: [true; 3],
    }
}

#[test]
fn arbitrary_output_of_a_program_costs_one_attempt() {
    let home = tempfile::tempdir().unwrap();
    let home = home.path().canonicalize().unwrap();
    let scratch = home.join("scratch");
    for name in ["scratch", "seen", "kinds"] {
        fs::create_dir(home.join(name)).unwrap();
    }
    // The mode of /tmp.
    fs::set_permissions(&scratch, Permissions::from_mode(0o1777)).unwrap();
    let command = r#"{ command = { command = ["sh", "label.sh"], files = ["label.sh"], version = "1" } }"#;
    let keys = format!(
        "[label]\nconcurrency = 0\nscratch = {:?}\nmethod = {command} # ",
        scratch.display().to_string()
    );
    let small = Small { walkers: 1, steps: 60, ..Small::default() };
    let place = LabelCampaign::new(&small, &[("[label]\nmethod", &keys)]);
    fs::write(place.path().join("label.sh"), script(&home)).unwrap();
    let mut run = place.run();
    let walkers = pause_walkers(place.path(), 1);
    // A directory that another user could have created beforehand.
    let campaign = on_store(place.location(), async |store| store.campaign().await.unwrap().id);
    let trap = scratch.join(format!("calmwalk-{campaign}"));
    fs::create_dir(&trap).unwrap();
    fs::set_permissions(&trap, Permissions::from_mode(0o777)).unwrap();
    let queued: Vec<_> =
        (0..LEFT.len()).map(|k| queue(place.location(), k as u64, pair(k), Vec::new())).collect();
    LEFT.iter().for_each(|(kind, ..)| fs::create_dir(home.join("kinds").join(kind)).unwrap());
    let mut label = place.label(&["--wait-timeout", "2m"]);
    wait_until("every kind has been left once", || fs::read_dir(home.join("kinds")).unwrap().count() == 0);
    walkers.resume();
    assert_eq!(run.0.wait().unwrap().code(), Some(0), "{}", place.said());
    assert_eq!(label.0.wait().unwrap().code(), Some(0), "{}", place.said());

    let mut logs = Vec::new();
    for candidate in queued {
        let job = place.job(&candidate);
        let outcomes: Vec<_> = job.attempts_made.iter().map(|attempt| attempt.outcome.as_deref()).collect();
        assert_eq!(job.job.state, JobState::Labelled, "{job:?}");
        assert_eq!(outcomes, [Some("failed"), Some("labelled")], "{job:?}");
        logs.push(job.attempts_made[0].log.clone().unwrap_or_default());
    }
    for (kind, _, expected) in LEFT {
        let told = logs.iter().any(|log| {
            log.contains(expected) && (kind == "logs" || log.contains(&format!("this is {kind}")))
        });
        assert!(told, "{kind}: {logs:#?}");
    }
    // No labeller was restarted, nothing remains, and nothing was written where others can write.
    assert!(!place.said().contains("backing off"), "{}", place.said());
    assert_eq!(calculation_processes(&scratch), []);
    let left: Vec<_> = fs::read_dir(&scratch).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert_eq!(left.as_slice(), std::slice::from_ref(&trap));
    assert_eq!(fs::read_dir(&trap).unwrap().count(), 0);
    let modes = fs::read_to_string(home.join("modes")).unwrap();
    let own = format!("700 {}", fs::metadata(&home).unwrap().uid());
    assert!(modes.lines().all(|line| line == own), "{modes}");
    let places = fs::read_to_string(home.join("places")).unwrap();
    assert!(!places.contains(&format!("{}/", trap.display())), "{places}");
}

/// A directory to label one structure without a campaign.
struct Once {
    home: tempfile::TempDir,
}

impl Once {
    fn new(script: &str, keys: &str) -> Self {
        let home = tempfile::tempdir().unwrap();
        let here = home.path();
        fs::create_dir(here.join("scratch")).unwrap();
        let script = script.replace("$HERE", &here.display().to_string());
        fs::write(here.join("label.sh"), script + WRITE_FIXED_LABEL).unwrap();
        let config = format!(
            "[label]\nscratch = {:?}\n{keys}\nmethod = {{ command = {{ command = [\"sh\", \"label.sh\"], files = [\"label.sh\"], \
             version = \"1\" }} }}\n",
            here.join("scratch").display().to_string()
        );
        fs::write(here.join("label.toml"), config).unwrap();
        let mut frame = Vec::new();
        write_frame(&mut frame, &Frame::from(pair(0))).unwrap();
        fs::write(here.join("pair.extxyz"), frame).unwrap();
        Self { home }
    }

    fn command(&self) -> Command {
        let mut command = program(self.home.path());
        command.args(["label-file", "pair.extxyz", "--config", "label.toml"]);
        command
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.home.path().join(name)).unwrap()
    }

    fn assert_no_leftovers(&self) {
        assert_eq!(fs::read_dir(self.home.path().join("scratch")).unwrap().count(), 0);
    }
}

fn label(output: Output) {
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
}

#[test]
fn a_scratch_directory_that_others_can_write_to_is_refused() {
    let once = Once::new("", "");
    let scratch = once.home.path().join("scratch");
    fs::set_permissions(&scratch, Permissions::from_mode(0o777)).unwrap();
    let output = once.command().output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let said = stderr(&output);
    let expected =
        format!("cannot use {} (others may write to it (mode 0777, no sticky bit)", scratch.display());
    assert!(said.contains(&expected) && said.contains("set label.scratch to it"), "{said}");
    fs::set_permissions(&scratch, Permissions::from_mode(0o1777)).unwrap();
    label(once.command().output().unwrap());
    once.assert_no_leftovers();
}

#[test]
fn programs_get_the_environment_that_they_need_and_no_password() {
    let once = Once::new(
        "env > $HERE/program; tr '\\0' '\\n' < /proc/$PPID/environ > $HERE/runner\n",
        "pass_environment = [\"MYSITE_*\", \"MY_TOKEN\"]",
    );
    let mut command = once.command();
    let given = [
        ("PGPASSWORD", "hunter2"),
        ("PGUSER", "someone"),
        ("HF_TOKEN", "hunter2"),
        ("SOMETHING", "else"),
        ("MYSITE_A", "1"),
        ("MYSITE_PASSWORD", "hunter2"),
        ("MY_TOKEN", "2"),
        ("SLURM_JOB_ID", "3"),
        ("LD_LIBRARY_PATH", "/none"),
    ];
    label(command.envs(given).output().unwrap());
    for who in ["program", "runner"] {
        let environment = once.read(who);
        let lines: Vec<_> = environment.lines().collect();
        for line in ["MYSITE_A=1", "MY_TOKEN=2", "SLURM_JOB_ID=3", "LD_LIBRARY_PATH=/none"] {
            assert!(lines.contains(&line), "{who} {line}: {environment}");
        }
        assert!(lines.iter().any(|line| line.starts_with("PATH=")), "{environment}");
        for secret in ["hunter2", "PGUSER", "SOMETHING"] {
            assert!(!environment.contains(secret), "{who} has {secret}: {environment}");
        }
    }
    assert!(once.read("program").contains("CALMWALK_CORES=1\n"));
    once.assert_no_leftovers();
}

#[test]
fn walkers_have_no_password() {
    let directory = tempfile::tempdir().unwrap();
    Small { walkers: 1, ..Small::default() }.write(directory.path());
    let mut command = program(directory.path());
    command.args(["run", "campaign.toml", "--directory", "."]).env("PGPASSWORD", "hunter2").env("KEPT", "1");
    let _run = common::Running(command.stderr(std::process::Stdio::null()).spawn().unwrap());
    let walkers = pause_walkers(directory.path(), 1);
    let environment = fs::read(format!("/proc/{}/environ", walkers.pids()[0])).unwrap();
    let environment = String::from_utf8_lossy(&environment).replace('\0', "\n");
    assert!(environment.contains("KEPT=1\n") && !environment.contains("hunter2"), "{environment}");
}

/// A daemon with its own session, no parent and an empty environment.
const DAEMON: &str = "env -i setsid sh -c 'sh -c \"echo \\$\\$ > $HERE/daemon; trap : TERM; while true; do sleep 1000; done\" &' \
                      < /dev/null > /dev/null 2>&1 &\nwhile [ ! -s $HERE/daemon ]; do sleep 0.01; done\n";

#[test]
fn daemons_end_with_the_calculation() {
    let once = Once::new(DAEMON, "");
    label(once.command().output().unwrap());
    let daemon = once.read("daemon");
    assert!(!Path::new("/proc").join(daemon.trim()).exists(), "{daemon} is left");
    // The same when the calculation reaches its time limit.
    let once = Once::new(&format!("{DAEMON}sleep 1000\n"), "time_limit = \"1s\"");
    let output = once.command().output().unwrap();
    assert!(stderr(&output).contains("time limit"), "{}", stderr(&output));
    let daemon = once.read("daemon");
    assert!(!Path::new("/proc").join(daemon.trim()).exists(), "{daemon} is left");
    once.assert_no_leftovers();
}

/// An orphaned process becomes a child of the calculation runner, which must reap it.
#[test]
fn no_zombie_is_left_while_a_calculation_runs() {
    let once = Once::new(
        "for times in 1 2 3 4 5; do (sleep 0 &); done\n\
         zombies() { cat /proc/[0-9]*/stat 2> /dev/null | awk -v parent=$PPID '$3 == \"Z\" && $4 == parent' | wc -l; }\n\
         while [ $(zombies) -gt 0 ]; do sleep 0.05; done; echo none > $HERE/zombies\n",
        "time_limit = \"1m\"",
    );
    label(once.command().output().unwrap());
    assert_eq!(once.read("zombies"), "none\n");
}
