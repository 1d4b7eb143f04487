//! The cost of monitoring a large campaign: `status` and the dashboard's pages with a million candidates, and
//! twenty browsers that listen to its events.
//!
//! `cargo bench --bench monitoring`; a number after `--` sets the number of candidates.

#[path = "../../tests/common/mod.rs"]
mod common;
mod copies;

use std::fs;
use std::process::Stdio;
use std::thread;
use std::time::{Duration, Instant};

use common::campaign::Small;
use common::http::{get, get_computed, listen, said};
use common::{Running, program, succeed};

/// Default number of candidates.
const CANDIDATES: u64 = 1_000_000;
const TRIES: usize = 11;
/// Number of listeners and duration of the measurement.
const LISTENERS: usize = 20;
const LISTENING: Duration = Duration::from_secs(60);

/// Columns without an index: numbers of the candidate, of its label, and errors against the label.
const COLUMNS: [&str; 4] = ["walk", "seed_structure", "energy", "force_mae"];
/// Selects fewer structures than a file may have; all accepted candidates are searched for them.
const SELECTION: &str = "/api/candidates.extxyz?fate=accepted&where=gamma+%3E+2.93";
/// Tries of what takes long.
const FEW_TRIES: usize = 3;

const PAGES: [&str; 9] = [
    "/",
    "/api/candidates?limit=50",
    "/api/candidates?limit=50&order=gamma",
    "/api/candidates?limit=50&order=relative_volume&ascending=true",
    "/api/candidates?limit=50&fate=too_close",
    "/api/candidates?limit=50&order=queue&state=queued",
    "/api/candidates?limit=50&state=failed",
    "/api/candidates?limit=50&where=gamma+%3E+2.9",
    "/api/mixture",
];

fn main() {
    let candidates = std::env::args().skip(1).find_map(|text| text.parse().ok()).unwrap_or(CANDIDATES);
    let directory = tempfile::tempdir().expect("a directory for temporary files");
    let here = directory.path();
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml", "--in-process"]);
    let begun = Instant::now();
    copies::make(here, candidates);
    let bytes = fs::metadata(here.join("campaign/campaign.sqlite")).expect("the database").len();
    let made = begun.elapsed().as_secs_f64();
    println!(
        "{candidates} candidates of {} walks made in {made:.0} s, {} MB\n",
        copies::WALKS,
        bytes / 1_000_000
    );

    println!("| | median | worst of {TRIES} |\n| --- | --- | --- |");
    row("`status`", || drop(succeed(here, ["status", "campaign"])));
    row("`status --json`", || drop(succeed(here, ["status", "campaign", "--json"])));
    let mut command = program(here);
    command.args(["dashboard", "campaign", "--address", "127.0.0.1:0"]).stderr(Stdio::piped());
    let mut server = Running(command.spawn().expect("the program starts"));
    let [address] = said(&mut server.0, ["dashboard at http://"]);
    let address = address.trim_end_matches('/');
    let fetch = |page: &str| {
        let answer = get(address, page);
        assert!(answer.status < 300, "{page}: {answer:?}");
    };
    for page in PAGES {
        row(&format!("`{page}`"), || fetch(page));
    }
    let page = get(address, "/api/candidates?limit=1&fate=accepted").json();
    let newest = page.pointer("/candidates/0/id").and_then(serde_json::Value::as_str).expect("a candidate");
    let details = format!("/api/candidates/{newest}");
    row("one candidate", || fetch(&details));
    row("a walk's candidates", || fetch("/api/walks/17/candidates"));
    println!("\nmemory of the server: {}", memory(server.0.id()));
    for column in COLUMNS {
        few(&format!("the table by `{column}`"), || {
            fetch(&format!("/api/candidates?limit=50&order={column}"))
        });
    }
    few("`where=walk = 17`", || fetch("/api/candidates?limit=50&where=walk+%3D+17"));
    few("a file of a selection", || fetch(SELECTION));
    println!("\nmemory of the server: {}", memory(server.0.id()));
    let begun = Instant::now();
    let map = get_computed(address, "/api/map");
    println!(
        "map of {} and {} after {:.1} s",
        map["accepted"],
        map["control"],
        begun.elapsed().as_secs_f64()
    );
    println!("\nmemory of the server: {}", memory(server.0.id()));
    let begun = Instant::now();
    row("force errors, before they are there", || fetch("/api/errors"));
    row("the table meanwhile", || fetch(PAGES[2]));
    let errors = get_computed(address, "/api/errors");
    println!(
        "force errors of {} labels after {:.1} s",
        errors["all"]["structures"],
        begun.elapsed().as_secs_f64()
    );
    row("force errors", || fetch("/api/errors"));
    println!("\nmemory of the server: {}", memory(server.0.id()));
    let listeners: Vec<_> = (0..LISTENERS).map(|_| listen(address, "/api/events")).collect();
    // Skip the initial messages, which differ from the periodic ones.
    thread::sleep(Duration::from_secs(5));
    let (before, begun) = (processor_seconds(server.0.id()), Instant::now());
    thread::sleep(LISTENING);
    let used = processor_seconds(server.0.id()) - before;
    let share = 100.0 * used / begun.elapsed().as_secs_f64();
    println!("\n{LISTENERS} listeners: {used:.2} s of a core in {} s, {share:.2} %", LISTENING.as_secs());
    println!("memory of the server: {}", memory(server.0.id()));
    drop(listeners);
}

fn row(name: &str, act: impl FnMut()) {
    times(name, TRIES, act);
}

fn few(name: &str, act: impl FnMut()) {
    times(name, FEW_TRIES, act);
}

fn times(name: &str, tries: usize, mut act: impl FnMut()) {
    let time = |_| {
        let begun = Instant::now();
        act();
        begun.elapsed().as_secs_f64() * 1000.0
    };
    let mut times: Vec<f64> = (0..tries).map(time).collect();
    times.sort_by(f64::total_cmp);
    println!("| {name} | {:.0} ms | {:.0} ms |", times[tries / 2], times[tries - 1]);
}

/// Processor time of a process and its threads so far.
fn processor_seconds(pid: u32) -> f64 {
    let text = fs::read_to_string(format!("/proc/{pid}/stat")).expect("the process lives");
    let (_, rest) = text.rsplit_once(')').expect("a name in brackets");
    let ticks: u64 =
        rest.split_whitespace().skip(11).take(2).map(|n| n.parse::<u64>().expect("a number")).sum();
    // Linux reports hundredths of a second to user space.
    ticks as f64 / 100.0
}

/// Current and peak memory of a process.
fn memory(pid: u32) -> String {
    let text = fs::read_to_string(format!("/proc/{pid}/status")).expect("the process lives");
    let megabytes = |name: &str| -> u64 {
        let line = text.lines().find_map(|line| line.strip_prefix(name)).expect("a line of it");
        line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number") * 1024 / 1_000_000
    };
    format!("{} MB, {} MB at most", megabytes("VmRSS:"), megabytes("VmHWM:"))
}
