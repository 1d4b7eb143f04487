//! Walkers and labellers are separate processes: whatever happens to one of them, the campaign has the same outcome.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use serde_json::Value;
use store::Store;

use crate::common;
use crate::common::campaign::{Small, outcome};
use crate::common::hosts::uninterrupted_outcome;
use crate::common::processes::{
    PausedProcesses, assert_no_leftovers, pause_walkers, processes_in, processes_running, signal,
    wait_for_process, wait_until,
};
use crate::common::{Running, calmwalk, config, program, refuse, succeed};

const RUN: [&str; 4] = ["run", "campaign.toml", "--directory", "."];

fn start(directory: &Path) -> Running {
    let errors = fs::File::create(directory.join("stderr")).expect("a file");
    let mut command = program(directory);
    Running(command.args(RUN).stdout(Stdio::null()).stderr(errors).spawn().expect("the program starts"))
}

fn wait(running: &mut Running) -> Option<i32> {
    running.0.wait().expect("a child").code()
}

/// Standard error of the run so far.
fn said(directory: &Path) -> String {
    fs::read_to_string(directory.join("stderr")).expect("its standard error")
}

/// Long enough for processes to fail and be replaced.
fn long() -> Small {
    Small { steps: 900, ..Small::default() }
}

/// Adds keys to the section `[run]`.
fn with_keys(path: &Path, keys: &str) {
    let text = fs::read_to_string(path).unwrap().replace("[run]", &format!("[run]\n{keys}"));
    fs::write(path, text).unwrap();
}

/// Waits for the end of the campaign, and checks its exit code, outcome and that nothing remains.
fn ends_as_undisturbed(mut running: Running, directory: &Path, small: &Small) {
    assert_eq!(wait(&mut running), Some(0), "{}", said(directory));
    assert_eq!(outcome(directory), uninterrupted_outcome(small));
    assert_no_leftovers(directory);
}

/// Runs a long campaign to its end. `disturb` runs once the walkers are working, and must not change the outcome.
fn disturbed(keys: &str, disturb: impl FnOnce(&Path)) -> tempfile::TempDir {
    let small = long();
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    with_keys(&small.write(here), keys);
    let running = start(here);
    wait_for_work(here);
    disturb(here);
    ends_as_undisturbed(running, here, &small);
    directory
}

/// Writes a campaign with a copy of the model, which a test can damage.
fn with_own_model(small: &Small, directory: &Path) {
    let path = small.write(directory);
    let model = config("data/al_eam_1l/kokkos.npz");
    fs::copy(&model, directory.join("model.npz")).unwrap();
    let text = fs::read_to_string(&path).unwrap().replace(&model.display().to_string(), "model.npz");
    fs::write(path, text).unwrap();
}

/// The processes in `status`.
fn shown(directory: &Path) -> Vec<Value> {
    let output = calmwalk(directory, ["status", ".", "--json"]);
    // The database may not exist yet.
    let Ok(status) = serde_json::from_slice::<Value>(&output.stdout) else { return Vec::new() };
    status["processes"].as_array().cloned().unwrap_or_default()
}

/// Details of the operations of this kind.
fn operations(directory: &Path, kind: &str) -> Vec<Value> {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let operations = runtime.block_on(async {
        let store = Store::open_read_only(directory).await.unwrap();
        store.operations(0, 10_000).await.unwrap()
    });
    let found = operations.into_iter().filter(|operation| operation.kind == kind);
    found.map(|operation| operation.detail).collect()
}

/// Entries of the operations log about ended processes.
fn endings(directory: &Path) -> Vec<String> {
    operations(directory, "process_ended").iter().map(Value::to_string).collect()
}

/// Checks that a failed run is recorded as failed with its reason, not as killed.
fn recorded_as_failed(directory: &Path, reason: &str) {
    let left = shown(directory);
    assert!(left.iter().all(|process| process["kind"] == "labeller"), "{left:?}");
    let ends = operations(directory, "ended");
    let last = ends.last().expect("the end of the run");
    assert!(last["how"] == "failed" && last["error"].as_str().unwrap().contains(reason), "{last}");
}

/// Waits until both walkers are working.
fn wait_for_work(directory: &Path) {
    wait_until("walkers advance", || {
        let output = calmwalk(directory, ["status", ".", "--json"]);
        let status = serde_json::from_slice::<Value>(&output.stdout).unwrap_or_default();
        status["mixture_version"].as_u64().is_some_and(|version| version > 0)
    });
    wait_until("both walkers are running", || processes_running(directory, "walker").len() == 2);
}

#[test]
fn a_hung_walker_is_killed_and_replaced() {
    let mut hung = 0;
    let directory = disturbed("heartbeat_timeout = \"5s\"", |here| {
        hung = wait_for_process(here, "walker");
        signal(hung, "STOP");
    });
    assert!(!processes_in(directory.path()).iter().any(|process| process.pid == hung));
    let endings = endings(directory.path());
    let hung =
        |ending: &String| ending.contains("silent for 5 s, killed") && ending.contains(r#""kind":"walker""#);
    assert_eq!(endings.iter().filter(|ending| hung(ending)).count(), 1, "{endings:?}");
}

#[test]
fn a_terminated_walker_leaves_its_walk_to_another() {
    let directory = disturbed("", |here| signal(wait_for_process(here, "walker"), "TERM"));
    let endings = endings(directory.path());
    assert!(endings.iter().any(|ending| ending.contains("exit code 130")), "{endings:?}");
}

#[test]
fn a_terminated_labeller_is_replaced() {
    disturbed("", |here| {
        let held = pause_walkers(here, 2);
        let labeller = wait_for_process(here, "labeller");
        signal(labeller, "TERM");
        wait_until("another labeller is running", || {
            processes_running(here, "labeller").first().is_some_and(|other| *other != labeller)
        });
        held.resume();
    });
}

#[test]
fn a_walker_that_cannot_start_is_given_up_and_the_others_continue() {
    let small = long();
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    with_own_model(&small, here);
    with_keys(&here.join("campaign.toml"), "max_restarts = 1");
    let running = start(here);
    wait_for_work(here);
    // The other walker must not end the campaign before this one is given up.
    let held = pause_walkers(here, 2);
    let model = fs::read(here.join("model.npz")).unwrap();
    fs::write(here.join("model.npz"), b"spoiled").unwrap();
    signal(held.pids()[0], "KILL");
    let failed = |process: &Value| {
        let remark = process["remark"].as_str().unwrap_or_default();
        process["kind"] == "walker" && process["state"] == "failed" && remark.contains("another content")
    };
    wait_until("status shows it", || shown(here).iter().any(failed));
    let table = succeed(here, ["status", "."]);
    let failed = |line: &str| line.starts_with("walker") && line.contains("  failed  ");
    assert!(table.lines().any(failed) && table.contains("another content"), "{table}");
    fs::write(here.join("model.npz"), model).unwrap();
    held.resume();
    ends_as_undisturbed(running, here, &small);
}

/// Limits of open files of a process: soft and hard.
fn descriptors(pid: u32) -> Vec<String> {
    let limits = fs::read_to_string(format!("/proc/{pid}/limits")).unwrap();
    let line = limits.lines().find_map(|line| line.strip_prefix("Max open files")).unwrap().to_owned();
    line.split_whitespace().take(2).map(str::to_owned).collect()
}

#[test]
fn a_run_may_have_more_descriptors_than_its_walkers() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    Small::default().write(here);
    let script =
        format!("ulimit -n 600; ulimit -Sn 300; exec {} {}", env!("CARGO_BIN_EXE_calmwalk"), RUN.join(" "));
    let mut command = Command::new("sh");
    command.args(["-c", &script]).current_dir(here).stdout(Stdio::null()).stderr(Stdio::null());
    let mut running = Running(command.spawn().unwrap());
    let held = pause_walkers(here, 2);
    assert_eq!(descriptors(running.0.id()), ["600", "600"]);
    for child in held.pids().iter().chain(&processes_running(here, "labeller")) {
        assert_eq!(descriptors(*child), ["300", "600"]);
    }
    held.resume();
    assert_eq!(wait(&mut running), Some(0));
    assert_no_leftovers(here);
}

#[test]
fn without_any_walker_the_campaign_fails_and_can_continue() {
    let small = long();
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    with_own_model(&small, here);
    with_keys(&here.join("campaign.toml"), "max_restarts = 1");
    let mut running = start(here);
    wait_for_work(here);
    let held = pause_walkers(here, 2);
    let model = fs::read(here.join("model.npz")).unwrap();
    fs::write(here.join("model.npz"), b"spoiled").unwrap();
    // This kills the walkers.
    drop(held);
    assert_eq!(wait(&mut running), Some(1), "{}", said(here));
    let message = said(here);
    assert!(message.contains("no walker is left") && message.contains("another content"), "{message}");
    assert_no_leftovers(here);
    recorded_as_failed(here, "no walker is left");
    fs::write(here.join("model.npz"), model).unwrap();
    ends_as_undisturbed(start(here), here, &small);
}

#[test]
fn walkers_end_with_their_orchestrator_and_labellers_are_adopted() {
    let small = long();
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    small.write(here);
    let mut running = start(here);
    wait_for_work(here);
    let labellers = processes_running(here, "labeller");
    assert_eq!(labellers.len(), 1);
    // Pause it, so that it does not look for an orchestrator and exit.
    let held = PausedProcesses::outside_transactions(&*labellers, here.to_str().unwrap());
    running.0.kill().unwrap();
    running.0.wait().unwrap();
    wait_until("the walkers have exited", || processes_running(here, "walker").is_empty());
    let is_killed = |process: &Value| process["kind"] == "orchestrator" && process["state"] == "dead";
    assert!(shown(here).iter().any(is_killed), "{:?}", shown(here));
    let running = start(here);
    wait_until("there are walkers again", || processes_running(here, "walker").len() == 2);
    // The campaign cannot end while a labeller is paused.
    let second = refuse(here, RUN);
    assert!(second.contains(&format!("process {}", running.0.id())), "{second}");
    held.resume();
    assert_eq!(processes_running(here, "labeller"), labellers);
    ends_as_undisturbed(running, here, &small);
}

#[test]
fn a_labeller_finishes_the_queue_without_an_orchestrator_and_leaves() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    long().write(here);
    let mut running = start(here);
    wait_for_work(here);
    running.0.kill().unwrap();
    running.0.wait().unwrap();
    wait_until("all processes have exited", || processes_in(here).is_empty());
    let status: Value = serde_json::from_str(&succeed(here, ["status", ".", "--json"])).unwrap();
    let labels = &status["labels"];
    assert_eq!((&labels["queued"], &labels["leased"]), (&0.into(), &0.into()), "{labels}");
    assert!(labels["labelled"].as_u64().unwrap() > 0);
    succeed(here, ["clean"]);
    assert_no_leftovers(here);
}

#[test]
fn two_campaigns_on_one_host_do_not_see_each_other() {
    let small = Small::default();
    let directories = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let mut running: Vec<_> = directories
        .iter()
        .map(|directory| {
            small.write(directory.path());
            start(directory.path())
        })
        .collect();
    for (running, directory) in running.iter_mut().zip(&directories) {
        assert_eq!(wait(running), Some(0), "{}", said(directory.path()));
    }
    let expected = uninterrupted_outcome(&small);
    for directory in &directories {
        assert_eq!(outcome(directory.path()), expected);
        assert_no_leftovers(directory.path());
    }
}

#[test]
fn clean_removes_what_killed_processes_left_and_nothing_else() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    long().write(here);
    let mut running = start(here);
    wait_for_work(here);
    let message = refuse(here, ["clean", "."]);
    assert!(message.contains(&format!("process {}", running.0.id())), "{message}");
    processes_in(here).iter().for_each(|process| signal(process.pid, "KILL"));
    running.0.wait().unwrap();
    wait_until("all processes have exited", || processes_in(here).is_empty());
    let place = wire::shm_dir::ShmDir::for_campaign(here).unwrap();
    assert!(place.directory().exists());
    let dry = succeed(here, ["clean", ".", "--dry-run"]);
    assert!(place.directory().exists());
    let said = succeed(here, ["clean", "."]);
    assert!(said.contains("files from shared memory") && !said.contains(" 0 files"), "{said}");
    assert_eq!(dry, said.replace("removed", "would remove") + "nothing was changed\n");
    assert_no_leftovers(here);
}

/// The program with its own shared memory of `megabytes`, of which `filled` are used.
fn with_shared_memory(directory: &Path, megabytes: u32, filled: u32) -> Option<Command> {
    let mut unshare = Command::new("unshare");
    unshare.args(["--user", "--map-root-user", "--mount"]).current_dir(directory);
    let permitted = Command::new("unshare").args(["--user", "--map-root-user", "--mount", "true"]).output();
    if !permitted.is_ok_and(|output| output.status.success()) {
        assert!(std::env::var_os("CI").is_none(), "unshare(1) must be permitted in CI");
        eprintln!("not tested: unshare(1) is not permitted here");
        return None;
    }
    let script = format!(
        "mount -t tmpfs -o size={megabytes}m tmpfs /dev/shm && head -c {filled}M /dev/zero > /dev/shm/filled && exec {} {}",
        env!("CARGO_BIN_EXE_calmwalk"),
        RUN.join(" ")
    );
    unshare.args(["sh", "-c", &script]);
    Some(unshare)
}

#[test]
fn sixteen_megabytes_of_shared_memory_are_enough_or_the_need_is_reported() {
    let small = Small::default();
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    small.write(here);
    let Some(mut full) = with_shared_memory(here, 16, 15) else { return };
    let output = full.output().unwrap();
    let message = common::stderr(&output);
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains("MB of shared memory") && message.contains("--shm-size"), "{message}");
    recorded_as_failed(here, "MB of shared memory");
    let Some(mut enough) = with_shared_memory(here, 16, 0) else { return };
    let output = enough.output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", common::stderr(&output));
    assert_eq!(outcome(here), uninterrupted_outcome(&small));
}

#[test]
fn shared_memory_is_the_users_alone() {
    use std::os::unix::fs::MetadataExt;
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    long().write(here);
    let mut running = start(here);
    wait_for_work(here);
    let held = pause_walkers(here, 2);
    let shm_dir = wire::shm_dir::ShmDir::for_campaign(here).unwrap();
    assert_eq!(fs::metadata(shm_dir.directory()).unwrap().mode() & 0o777, 0o700);
    let mut segments = 0;
    for file in fs::read_dir("/dev/shm").unwrap().flatten() {
        // Unused segments may be removed at any time.
        let (name, Ok(data)) = (file.file_name(), file.metadata()) else { continue };
        if name.to_string_lossy().starts_with(shm_dir.prefix()) {
            segments += 1;
            assert_eq!(data.mode() & 0o077, 0, "{:?} {:o}", file.path(), data.mode());
        }
    }
    assert!(segments > 0);
    signal(running.0.id(), "TERM");
    held.resume();
    assert_eq!(wait(&mut running), Some(130));
    assert_no_leftovers(here);
}
