//! What it costs to watch a large campaign: `status` and the pages of the dashboard with a million candidates, and twenty browsers that
//! listen to its news.
//!
//! `cargo bench --bench watching`; a number behind `--` is how many candidates there are. Most of its time goes into making them: they
//! are copies of one, which differ in their names, grades and volumes; only accepted ones have their structures.

#[path = "../tests/common/mod.rs"]
mod common;

use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::thread;
use std::time::{Duration, Instant};

use common::campaign::Small;
use common::http::{get, listen, said};
use common::{Running, program, succeed};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection};

/// Candidates, if not given.
const CANDIDATES: u64 = 1_000_000;
/// Walks; one candidate in twenty is accepted.
const WALKS: u64 = 1000;
const TRIES: usize = 11;
/// So many listen for so long.
const LISTENERS: usize = 20;
const LISTENING: Duration = Duration::from_secs(60);

const PAGES: [&str; 8] = [
    "/",
    "/api/candidates?limit=50",
    "/api/candidates?limit=50&order=gamma",
    "/api/candidates?limit=50&order=volume&ascending=true",
    "/api/candidates?limit=50&fate=guard",
    "/api/candidates?limit=50&order=queue&state=queued",
    "/api/candidates?limit=50&where=gamma+%3E+2.9",
    "/api/mixture",
];

/// `$1` is how many candidates there are to be more; each statement is one of SQLite's.
const MORE: [&str; 12] = [
    "CREATE TEMP TABLE new (decision INTEGER PRIMARY KEY, i INTEGER, is_accepted INTEGER, reason TEXT, structure INTEGER, hash BLOB,
        id TEXT, x REAL)",
    "INSERT INTO new WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < $1)
        SELECT i + (SELECT max(sequence) FROM decision), i, i % 20 = 0,
            CASE WHEN i % 20 = 0 THEN NULL WHEN i % 7 = 0 THEN 'guard' WHEN i % 3 = 0 THEN 'duplicate' ELSE 'covered' END,
            (SELECT max(number) FROM structure) + i / 20, randomblob(32),
            (SELECT substr(value, 1, 8) FROM campaign WHERE key = 'id') || '-' || (i % 1000) || '.0.' || i || '-'
                || lower(hex(randomblob(8))),
            (abs(random()) % 1000000) / 1e6 FROM n",
    "INSERT INTO decision SELECT new.decision, 0, CASE WHEN is_accepted THEN 'accepted' ELSE 'declined' END, i % 1000, new.id,
        mixture_version, detail
        FROM new CROSS JOIN (SELECT * FROM decision WHERE kind = 'accepted' ORDER BY sequence DESC LIMIT 1)",
    "INSERT INTO structure SELECT new.structure, new.hash, atoms, formula, data FROM new CROSS JOIN
        (SELECT * FROM structure ORDER BY number DESC LIMIT 1) WHERE is_accepted",
    "INSERT INTO candidate SELECT new.decision, new.id, new.hash, CASE WHEN is_accepted THEN new.structure END, i % 1000, 0, i,
        seed_structure, 'biased', CASE WHEN is_accepted THEN 'accepted' ELSE 'declined' END, new.reason, mixture_version, atoms,
        formula, temperature, 1 + 0.4 * x, energy, walker_gamma, walker_gamma_nbr, walker_above, selector_gamma,
        selector_gamma_nbr, selector_above, 1 + 2 * x, original_gamma_nbr, original_above
        FROM new CROSS JOIN (SELECT * FROM candidate WHERE fate = 'accepted' AND origin = 'biased' ORDER BY decision DESC LIMIT 1) AS one",
    "INSERT INTO candidate_data SELECT new.decision, block, features, selector_grades, original_grades
        FROM new CROSS JOIN (SELECT * FROM candidate_data WHERE decision = (SELECT max(decision) FROM candidate
            WHERE fate = 'accepted' AND origin = 'biased' AND decision < (SELECT min(decision) FROM new))) WHERE is_accepted",
    "INSERT INTO candidate_count SELECT 'biased', coalesce(reason, 'accepted'), count(*) FROM new GROUP BY 2
        ON CONFLICT (origin, fate) DO UPDATE SET number = number + excluded.number",
    "INSERT INTO job (structure, protocol, decision, state, priority, attempts)
        SELECT structure, (SELECT number FROM protocol), decision, CASE WHEN i % 200 = 0 THEN 'queued' WHEN i % 1000 = 20 THEN 'failed'
            ELSE 'labelled' END, 0, i % 200 <> 0 FROM new WHERE is_accepted",
    "INSERT INTO attempt (job, attempt, holder, started, ended, outcome, class, cores, core_seconds)
        SELECT number, 1, 'x', time - 1000 - number % 100, time, job.state, CASE job.state WHEN 'failed' THEN 'crashed' END, 1,
            1 + 0.001 * (number % 100)
        FROM (SELECT *, 1000 * (unixepoch() - 12 * ((SELECT max(number) FROM job) - number)) AS time FROM job) AS job
        CROSS JOIN new ON new.decision = job.decision WHERE job.state IN ('labelled', 'failed')",
    "INSERT INTO label (structure, protocol, standing, energy, forces, job, attempt, received)
        SELECT job.structure, job.protocol, 'label', energy, forces, job.number, 1, ended
        FROM job CROSS JOIN new ON new.decision = job.decision CROSS JOIN attempt ON attempt.job = job.number
        CROSS JOIN (SELECT energy, forces FROM label WHERE structure = (SELECT structure FROM candidate
            WHERE fate = 'accepted' AND origin = 'biased' AND decision < (SELECT min(decision) FROM new) ORDER BY decision DESC LIMIT 1)
            LIMIT 1) WHERE job.state = 'labelled'",
    "UPDATE campaign SET value = CASE key WHEN 'labels_made' THEN (SELECT count(*) FROM attempt WHERE outcome = 'labelled') ELSE
        (SELECT CAST(sum(round(1000 * core_seconds)) AS INTEGER) FROM attempt
            WHERE outcome = 'labelled' OR (key = 'core_milliseconds' AND outcome IS NOT NULL)) END
        WHERE key IN ('labels_made', 'core_milliseconds', 'label_core_milliseconds')",
    "WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 999)
        INSERT OR IGNORE INTO walk SELECT i, origin, partner, seed_structure, CASE WHEN i % 10 = 0 THEN 'running' ELSE state END, reason,
            turn, accepted, step, segment, tau, temperature, relative_volume, gamma_max, refused, returns, selector_state, checkpoint
        FROM n CROSS JOIN (SELECT * FROM walk LIMIT 1)",
];

fn main() {
    let candidates = std::env::args().skip(1).find_map(|text| text.parse().ok()).unwrap_or(CANDIDATES);
    let directory = tempfile::tempdir().expect("a directory for temporary files");
    let here = directory.path();
    Small::default().write(here);
    succeed(here, ["run", "campaign.toml", "--in-process"]);
    let begun = Instant::now();
    make(here, candidates);
    let bytes = fs::metadata(here.join("campaign/campaign.sqlite")).expect("the database").len();
    let made = begun.elapsed().as_secs_f64();
    println!("{candidates} candidates of {WALKS} walks made in {made:.0} s, {} MB\n", bytes / 1_000_000);

    println!("| | median | worst of {TRIES} |\n| --- | --- | --- |");
    row("`status`", || drop(succeed(here, ["status", "campaign"])));
    row("`status --json`", || drop(succeed(here, ["status", "campaign", "--json"])));
    let mut command = program(here);
    command.args(["dashboard", "campaign", "--at", "127.0.0.1:0"]).stderr(Stdio::piped());
    let mut server = Running(command.spawn().expect("the program starts"));
    let [address] = said(&mut server.0, ["dashboard at http://"]);
    let address = address.trim_end_matches('/');
    for page in PAGES {
        row(&format!("`{page}`"), || {
            let answer = get(address, page);
            assert!(answer.status < 300, "{page}: {answer:?}");
        });
    }
    let page = get(address, "/api/candidates?limit=1&fate=accepted").json();
    let newest = page.pointer("/candidates/0/id").and_then(serde_json::Value::as_str).expect("a candidate");
    let story = format!("/api/candidates/{newest}");
    row("one candidate", || assert_eq!(get(address, &story).status, 200));
    let listeners: Vec<_> = (0..LISTENERS).map(|_| listen(address, "/api/events")).collect();
    // What they are told first is not what they are told again and again.
    thread::sleep(Duration::from_secs(5));
    let (before, begun) = (processor_seconds(server.0.id()), Instant::now());
    thread::sleep(LISTENING);
    let used = processor_seconds(server.0.id()) - before;
    let share = 100.0 * used / begun.elapsed().as_secs_f64();
    println!("\n{LISTENERS} listeners: {used:.2} s of a core in {} s, {share:.2} %", LISTENING.as_secs());
    println!("most memory of the server: {} MB", most_memory(server.0.id()) / 1000);
    drop(listeners);
}

/// Adds candidates to a campaign that has ended, as fast as SQLite can: what is lost with the machine is made again.
fn make(here: &Path, candidates: u64) {
    let file = here.join("campaign/campaign.sqlite");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(async {
        let options =
            SqliteConnectOptions::new().filename(file).foreign_keys(false).pragma("temp_store", "memory");
        // Rows come in any order of the indexes: all of these fit.
        let options = options.journal_mode(SqliteJournalMode::Off).pragma("cache_size", "-1000000");
        let mut connection =
            options.synchronous(SqliteSynchronous::Off).connect().await.expect("the database");
        for statement in MORE {
            let mut query = sqlx::query(sqlx::AssertSqlSafe(statement.to_owned()));
            if statement.contains("$1") {
                query = query.bind(candidates.cast_signed());
            }
            query.execute(&mut connection).await.unwrap_or_else(|error| panic!("{statement}: {error}"));
        }
        sqlx::query("PRAGMA journal_mode = WAL")
            .execute(&mut connection)
            .await
            .expect("as the program has it");
        connection.close().await.expect("the database is closed");
    });
}

fn row(name: &str, mut act: impl FnMut()) {
    let time = |_| {
        let begun = Instant::now();
        act();
        begun.elapsed().as_secs_f64() * 1000.0
    };
    let mut times: Vec<f64> = (0..TRIES).map(time).collect();
    times.sort_by(f64::total_cmp);
    println!("| {name} | {:.0} ms | {:.0} ms |", times[TRIES / 2], times[TRIES - 1]);
}

/// What a process and its threads have used so far.
fn processor_seconds(pid: u32) -> f64 {
    let text = fs::read_to_string(format!("/proc/{pid}/stat")).expect("the process lives");
    let (_, rest) = text.rsplit_once(')').expect("a name in brackets");
    let ticks: u64 =
        rest.split_whitespace().skip(11).take(2).map(|n| n.parse::<u64>().expect("a number")).sum();
    // Linux shows hundredths of a second to everybody.
    ticks as f64 / 100.0
}

/// Memory that a process has had at most, kB.
fn most_memory(pid: u32) -> u64 {
    let text = fs::read_to_string(format!("/proc/{pid}/status")).expect("the process lives");
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:")).expect("its peak");
    line.trim().trim_end_matches(" kB").parse().expect("a number")
}
