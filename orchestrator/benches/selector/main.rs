//! Throughput of recorded candidates through reactor, selector and database, and the time of each stage.
//!
//! `cargo bench -p orchestrator --bench selector`. Also uses the PostgreSQL server at the URL in `CALMWALK_POSTGRES` if
//! set, see `.ci/postgres`. Results are in `docs/benchmarks.md`.

mod campaign;
mod commits;
mod database;
mod random;
mod recording;
mod stages;

use std::time::Duration;

use commits::Commits;
use database::Database;
use orchestrator::selector::SelectorSettings;
use recording::{Model, Plan};
use stages::{Stages, plain_inserts};
use wire::CandidateBlock;

/// Number of walks and of concurrent walkers: at least as many as needed to find this many candidates.
const WALKS: usize = 64;
/// A walker's threshold for γ_max (paper).
const THRESHOLD: f64 = 1.5;
/// A threshold so low that every candidate is accepted.
const ALL: f64 = 0.1;

fn main() {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    let model = Model::load();
    let plan = Plan {
        walks: WALKS,
        kinds: 200,
        of_kind: 12,
        collection: campaign::settings(THRESHOLD).collection,
        min_distance: 2.15,
    };
    let recording = model.record(plan);
    println!("mostly covered");
    runtime.block_on(measure(&model, &recording, campaign::settings(THRESHOLD)));
    println!("\nmostly covered, features of declined candidates no longer kept");
    let settings = SelectorSettings { declined_feature_bytes: 0, ..campaign::settings(THRESHOLD) };
    runtime.block_on(measure(&model, &recording, settings));
    println!("\nall accepted");
    let plan = Plan { kinds: 320, of_kind: 1, ..plan };
    runtime.block_on(measure(&model, &model.record(plan), campaign::settings(ALL)));
}

/// Measures one setting with every database.
async fn measure(model: &Model, recording: &[Vec<CandidateBlock>], settings: SelectorSettings) {
    for database in Database::all() {
        measure_with(database, model, recording, &settings).await;
    }
}

/// Measures the whole path, then each stage alone.
async fn measure_with(
    database: Database,
    model: &Model,
    recording: &[Vec<CandidateBlock>],
    settings: &SelectorSettings,
) {
    let room = database.room().await;
    let run = campaign::run(model, settings, recording, room.location).await;
    let n = run.candidates;
    let group = n.div_ceil(run.commits.max(1));
    let apart = database.room().await;
    let stages = Stages::measure(model, settings, recording, group, apart.location).await;

    let rate = |count: usize, time: Duration| count as f64 / time.as_secs_f64();
    let (dimension, share) = (model.original.dimension(), 100.0 * run.accepted as f64 / n as f64);
    println!(
        "  {}: {n} candidates, 108 atoms, {dimension} features; {} accepted ({share:.1} %), {} covered",
        database.name(),
        run.accepted,
        run.covered
    );
    println!(
        "  {:.0} candidates/s, {:.0} durable accepts/s",
        rate(n, run.wall),
        rate(run.accepted, run.wall)
    );
    println!(
        "  {:.2} s, {:.2} processors busy, {:.2} ms of them a candidate; {} commits, {group} candidates each",
        run.wall.as_secs_f64(),
        run.processor.as_secs_f64() / run.wall.as_secs_f64(),
        1e3 * run.processor.as_secs_f64() / n as f64,
        run.commits
    );
    if database == Database::Sqlite {
        let stored = std::fs::metadata(room.directory.path().join(store::DATABASE)).unwrap().len() as usize;
        let bytes = stored / n + campaign::CHECKPOINT;
        let plain = plain_inserts(n, bytes, group, apart.directory.path()).await;
        println!("  {:.0}/s plain inserts of {bytes} bytes in the same groups", rate(n, plain));
    }
    println!("  {:<32} {:>13} {:>10}", "alone, on one thread", "µs/candidate", "of the sum");
    let sum = stages.check + stages.decide + stages.commit;
    let parts = stages.bonds + stages.grades + stages.search + stages.watch;
    for (name, time) in [
        ("check of the block", stages.check),
        ("decide", stages.decide),
        ("  bonds", stages.bonds),
        ("  grades (live and original)", stages.grades),
        ("  search for α, inverses", stages.search),
        ("  watch over training frames", stages.watch),
        ("  rest", stages.decide.saturating_sub(parts)),
        ("commit: copies, database, flush", stages.commit),
    ] {
        let (each, of_sum) =
            (1e6 * time.as_secs_f64() / n as f64, 100.0 * time.as_secs_f64() / sum.as_secs_f64());
        println!("  {name:<32} {each:>13.0} {of_sum:>9.0} %");
    }
    if database == Database::Sqlite {
        for size in [1, 2, group] {
            measure_commits(model, recording, settings, size).await;
        }
    }
}

/// Measures single commits of groups of this size.
async fn measure_commits(
    model: &Model,
    recording: &[Vec<CandidateBlock>],
    settings: &SelectorSettings,
    size: usize,
) {
    let room = Database::Sqlite.room().await;
    let commits = Stages::default().decide(model, settings, recording);
    let log = room.directory.path().join(format!("{}-wal", store::DATABASE));
    let mut measured = Commits::measure(commits, recording.len(), size, room.location, &log).await;
    let times = [0.5, 0.9, 0.99, 1.0].map(|share| format!("{:.1}", measured.quantile(share)));
    println!(
        "  {} commits of {size}: median, 90 %, 99 % and longest {} ms; {:.1} pages of the log each",
        measured.times.len(),
        times.join(", "),
        measured.pages()
    );
}
