//! `calmwalk watch` in a real terminal: the tests send keys and read the screen. Needs tmux (Debian: `tmux`):
//! `cargo test --test external watch::`. With `CALMWALK_POSTGRES=$(.ci/postgres start)` its campaigns are stored on that
//! server.

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::common;
use crate::common::campaign::Small;
use crate::common::label_campaign::{LabelCampaign, on_store};
use crate::common::processes::{processes_running, signal, wait_until};
use crate::common::{Running, succeed};

/// A terminal that runs the program, and then prints its exit code.
struct Terminal {
    socket: String,
}

impl Terminal {
    fn open(place: &LabelCampaign, name: &str, size: (u32, u32), environment: &str) -> Self {
        Self::watch(place.path(), place.argument(), name, size, environment)
    }

    fn watch(here: &Path, campaign: &str, name: &str, size: (u32, u32), environment: &str) -> Self {
        let terminal = Self { socket: format!("calmwalk-{}-{name}", std::process::id()) };
        let (width, height) = (size.0.to_string(), size.1.to_string());
        let program = env!("CARGO_BIN_EXE_calmwalk");
        let command =
            format!("{environment} {program} watch '{campaign}' --interval 200ms; echo code $?; exec cat");
        let here = here.display().to_string();
        let arguments = ["-f", "/dev/null", "new-session", "-d", "-c", &here, "-x", &width, "-y", &height];
        terminal.tmux(&[&arguments[..], &[&command]].concat());
        terminal
    }

    fn tmux(&self, arguments: &[&str]) -> String {
        let mut tmux = Command::new("tmux");
        tmux.args(["-u", "-L", &self.socket]).args(arguments).env("LC_ALL", "C.UTF-8").env_remove("NO_COLOR");
        let output = tmux.output().expect("tmux is needed: apt-get install tmux");
        assert!(output.status.success(), "{arguments:?}: {}", common::stderr(&output));
        String::from_utf8(output.stdout).expect("text")
    }

    fn press(&self, keys: &str) {
        keys.split(' ').for_each(|key| drop(self.tmux(&["send-keys", key])));
    }

    fn write(&self, text: &str) {
        self.tmux(&["send-keys", "-l", text]);
    }

    fn screen(&self) -> String {
        self.tmux(&["capture-pane", "-p"])
    }

    fn wait_for(&self, words: &str) -> String {
        self.wait_for_all(&[words])
    }

    /// Waits for all of these words, because the screen may be read before it is completely drawn.
    fn wait_for_all(&self, words: &[&str]) -> String {
        let mut screen = String::new();
        wait_until(&format!("the screen shows {words:?}; {}", self.screen()), || {
            screen = self.screen();
            words.iter().all(|words| screen.contains(words))
        });
        screen
    }

    /// Waits for this escape sequence. Returns the screen with its escape sequences.
    fn wait_for_sequence(&self, sequence: &str) -> String {
        let mut screen = String::new();
        wait_until(&format!("the screen has {sequence:?}"), || {
            screen = self.tmux(&["capture-pane", "-p", "-e"]);
            screen.contains(sequence)
        });
        screen
    }

    fn resize(&self, width: u32, height: u32) {
        self.tmux(&["resize-window", "-x", &width.to_string(), "-y", &height.to_string()]);
    }

    /// Checks that the program has exited with this code, and that the terminal is restored: screen, cursor and echo.
    fn is_restored(&self, code: &str) {
        let screen = self.wait_for(code);
        assert!(!screen.contains("1 walks"), "{screen}");
        let flags = self.tmux(&["display-message", "-p", "#{alternate_on} #{cursor_flag}"]);
        assert_eq!(flags.trim(), "0 1");
        self.write("typed");
        self.wait_for("typed");
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        let _ = Command::new("tmux").args(["-L", &self.socket, "kill-server"]).output();
    }
}

/// Two walks that collect nothing and run for a long time.
fn endless() -> (LabelCampaign, Running) {
    let place = LabelCampaign::new(
        &Small { steps: 1_000_000, ..Small::default() },
        &[("threshold = 1.0", "threshold = 1e6"), ("threshold = 1.0", "threshold = 1e6")],
    );
    let run = place.run();
    wait_until("both walks exist", || {
        place.status()["walks"].as_array().is_some_and(|walks| walks.len() == 2)
    });
    (place, run)
}

/// A campaign whose walks have ended and whose structures wait for labels. It has no labellers.
fn waiting() -> LabelCampaign {
    let place = LabelCampaign::new(&Small::default(), &[("[label]", "[label]\nconcurrency = 0")]);
    let mut run = place.run();
    let over = |walk: &Value| !["waiting", "running"].contains(&walk["state"].as_str().unwrap());
    wait_until("every walk has ended", || {
        // Two biased walks and their control walks.
        place.status()["walks"].as_array().is_some_and(|walks| walks.len() == 4 && walks.iter().all(over))
    });
    signal(run.0.id(), "INT");
    run.0.wait().unwrap();
    place
}

/// The step of each walk at its last checkpoint. `status` may show steps that are some seconds old.
fn steps(place: &LabelCampaign) -> Vec<u64> {
    let walks = on_store(place.location(), async |store| store.load_walks().await.unwrap());
    walks.iter().map(|walk| walk.progress.step).collect()
}

fn queue(place: &LabelCampaign, state: &str) -> Vec<Value> {
    let list = succeed(place.path(), ["queue", place.argument(), "list", "--state", state, "--json"]);
    serde_json::from_str(&list).unwrap()
}

#[test]
fn a_campaign_that_runs_is_watched_and_its_walks_are_paused() {
    let (place, _run) = endless();
    let terminal = Terminal::open(&place, "runs", (80, 24), "");
    let screen = terminal.wait_for_all(&[
        "reproducible mode: running",
        "1 walks: 2",
        "2 queue: 0",
        "3 decisions: 2",
        "fcc-100",
        "vacancy",
        "begun",
        "no candidates yet",
    ]);
    assert!(
        screen.lines().count() == 24 && screen.lines().all(|line| line.chars().count() <= 80),
        "{screen}"
    );
    terminal.wait_for("steps/s; mixture");

    // Pause the second walk; in reproducible mode the first one waits for it.
    terminal.press("Down p");
    terminal.wait_for("walk 1 paused");
    terminal.wait_for("2 running (1 paused)");
    let paused = |of: Value| {
        of["walks"].as_array().unwrap().iter().map(|walk| walk["paused"] == true).collect::<Vec<_>>()
    };
    assert_eq!(paused(place.status()), [false, true]);
    let mut before = steps(&place);
    wait_until("both walks have stopped", || {
        // A walk makes an assignment of 40 steps in a fraction of this time.
        std::thread::sleep(std::time::Duration::from_secs(1));
        std::mem::replace(&mut before, steps(&place)) == before
    });
    terminal.wait_for("paused");
    terminal.press("r");
    terminal.wait_for("walk 1 resumed");
    wait_until("both walks continue", || steps(&place).iter().zip(&before).all(|(now, before)| now > before));

    // Pausing all walks needs a confirmation.
    terminal.press("P");
    terminal.wait_for("pause all walks that have not ended?");
    terminal.press("n");
    terminal.wait_for("cancelled");
    assert_eq!(paused(place.status()), [false, false]);

    for (width, height) in [(160, 50), (60, 12), (20, 5), (80, 24)] {
        terminal.resize(width, height);
        wait_until("the screen is redrawn", || {
            let screen = terminal.screen();
            let fits = screen.lines().all(|line| line.chars().count() <= width as usize);
            let is_wide = screen.lines().any(|line| line.contains("1 walks") && line.contains("2 queue"));
            fits && screen.contains("1 walks") && is_wide == (width == 160)
        });
    }
    terminal.press("i");
    terminal.wait_for("calmwalk status --all: lines 1 to");
    terminal.press("End");
    terminal.wait_for("orchestrator");
    terminal.press("q q");
    terminal.is_restored("code 0");
}

#[test]
fn queued_structures_are_changed_and_candidates_explained() {
    let place = waiting();
    let queued = queue(&place, "queued");
    let short = |job: &Value| job["candidate"].as_str().unwrap().split_once('-').unwrap().1.to_owned();
    let terminal = Terminal::open(&place, "queue", (100, 40), "NO_COLOR=1");
    terminal.wait_for_all(&["not running", &format!("2 queue: {}", queued.len()), "accepted", "γ₀_max of "]);
    let colours = terminal.wait_for_sequence(";7m");
    assert!(!colours.contains("[38;5;"), "{colours:?}");

    // Move the third job to the front.
    terminal.press("2 Down Down = C-u");
    terminal.write("99");
    terminal.press("Enter");
    terminal.wait_for("now has priority 99");
    let now = queue(&place, "queued");
    assert_eq!((short(&now[0]), &now[0]["priority"]), (short(&queued[2]), &99.into()));
    // It remains selected.
    terminal.press("d");
    terminal.wait_for(&format!("drop {} (queued)?", short(&queued[2])));
    terminal.press("n");
    terminal.wait_for("cancelled");
    terminal.press("d y");
    terminal.wait_for("is dropped");
    assert_eq!(short(&queue(&place, "dropped")[0]), short(&queued[2]));
    terminal.press("s s");
    terminal.wait_for("2 dropped: 1");
    terminal.press("t y");
    terminal.wait_for("is queued again");
    assert_eq!((queue(&place, "queued").len(), queue(&place, "dropped").len()), (queued.len(), 0));
    terminal.press("s s");
    terminal.wait_for("2 queue:");

    terminal.press("/");
    terminal.write("gamma > 1000");
    terminal.press("Enter");
    terminal.wait_for(&format!("2 queue: 0 of {}  where gamma > 1000", queued.len()));
    terminal.press("Escape");
    terminal.wait_for(&format!("2 queue: {}", queued.len()));

    // The view shows the text of `calmwalk explain`.
    terminal.press("3 /");
    terminal.write("origin = biased and gamma > 0");
    terminal.press("Enter");
    terminal.wait_for("where (origin = 'biased') and (gamma > 0.0)");
    terminal.press("Enter");
    let screen = terminal.wait_for("trigger");
    let id = screen.lines().nth(1).unwrap().trim().to_owned();
    let details = succeed(place.path(), ["explain", place.argument(), &id]);
    // Skip lines that change with time, and lines that are cut.
    let lasts = |line: &&str| line.chars().count() <= 100 && !line.ends_with(" ago");
    let first: Vec<_> = details.lines().filter(lasts).take(20).collect();
    assert_eq!(first.len(), 20, "{details}");
    terminal.wait_for_all(&first.iter().map(|line| line.trim_end()).collect::<Vec<_>>());
    terminal.press("q C-c");
    terminal.is_restored("code 130");
}

#[test]
fn the_terminal_is_restored_however_watch_ends() {
    let place = waiting();
    let here = place.path();
    let watching = || processes_running(here, "watch");
    for (name, how) in [("terminated", "TERM"), ("interrupted", "INT")] {
        let terminal = Terminal::open(&place, name, (80, 24), "");
        terminal.wait_for("1 walks: 4");
        // Charts are coloured.
        terminal.wait_for_sequence("[38;5;6m");
        signal(watching()[0], how);
        terminal.is_restored("code 130");
    }
    let terminal = Terminal::open(&place, "closed", (80, 24), "");
    terminal.wait_for("1 walks: 4");
    drop(terminal);
    wait_until("watch has exited", || watching().is_empty());
}

#[test]
fn a_copy_that_is_missing_for_a_while_is_still_watched() {
    let place = waiting();
    let here = place.path();
    succeed(here, ["store", "backup", place.argument(), "copy"]);
    let terminal = Terminal::watch(here, "copy", "copy", (80, 24), "");
    terminal.wait_for("1 walks: 4");
    // `watch` continues while the campaign is temporarily missing.
    fs::rename(here.join("copy"), here.join("away")).unwrap();
    terminal.wait_for("outdated, cannot read the campaign:");
    fs::rename(here.join("away"), here.join("copy")).unwrap();
    wait_until("the copy is read again", || {
        !terminal.screen().contains("outdated, cannot read the campaign")
    });
    terminal.press("q");
    terminal.is_restored("code 0");
    // An error at startup is printed on the normal screen.
    fs::remove_dir_all(here.join("copy")).unwrap();
    let terminal = Terminal::watch(here, "copy", "nothing", (80, 24), "");
    terminal.wait_for("calmwalk: ");
    terminal.is_restored("code 2");
}
