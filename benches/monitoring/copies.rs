//! A campaign with many candidates: copies of one with different names, grades and volumes. Accepted candidates
//! have distinct structures with distinct grades and force errors.

use std::path::Path;

use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqliteSynchronous};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection};
use store::{ExportFilter, ExportRow, ExportSource, Store};
use wire::{Candidate, CandidateBlock, CandidateId, ContentHash, WalkId};

use crate::common::random;

/// Number of walks.
pub const WALKS: u64 = 1000;
/// One in this many candidates is accepted.
const ACCEPTED: u64 = 20;
/// Bytes of a stored structure before its species (one byte each) and positions (`store/src/encoding.rs`).
const BEFORE_SPECIES: usize = 75;
/// Flag in the count before uncompressed numbers (`store/src/numbers.rs`).
const PLAIN: u64 = 1 << 63;

/// `pool`: features of several candidates. `copy`: the columns that differ between accepted candidates.
const ONE: [&str; 3] = [
    "CREATE TEMP TABLE one AS SELECT * FROM candidate WHERE fate = 'accepted' AND origin = 'biased' ORDER BY decision DESC LIMIT 1",
    "CREATE TEMP TABLE pool AS SELECT row_number() OVER (ORDER BY decision) - 1 AS place, features
        FROM candidate JOIN candidate_data USING (decision) WHERE features IS NOT NULL AND atoms = (SELECT atoms FROM one)",
    "CREATE TEMP TABLE copy (i INTEGER PRIMARY KEY, hash BLOB, data BLOB, forces BLOB, grades BLOB, id TEXT, block BLOB)",
];

/// `$1` is the number of candidates to add; each string is one statement of SQLite.
const MORE: [&str; 12] = [
    "CREATE TEMP TABLE new (decision INTEGER PRIMARY KEY, i INTEGER, is_accepted INTEGER, reason TEXT, structure INTEGER, hash BLOB,
        id TEXT, x REAL)",
    "INSERT INTO new WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < $1)
        SELECT i + (SELECT max(sequence) FROM decision), i, hash IS NOT NULL,
            CASE WHEN hash IS NOT NULL THEN NULL WHEN i % 7 = 0 THEN 'too_close' WHEN i % 3 = 0 THEN 'duplicate' ELSE 'covered' END,
            (SELECT max(number) FROM structure) + i / 20, coalesce(hash, randomblob(32)),
            coalesce(copy.id, (SELECT substr(value, 1, 8) FROM campaign WHERE key = 'id') || '-' || (i % 1000) || '.0.' || i || '-'
                || lower(hex(randomblob(8)))),
            (abs(random()) % 1000000) / 1e6 FROM n LEFT JOIN copy USING (i)",
    "INSERT INTO decision SELECT new.decision, 0, CASE WHEN is_accepted THEN 'accepted' ELSE 'declined' END, i % 1000, new.id,
        mixture_version, detail, NULL
        FROM new CROSS JOIN (SELECT * FROM decision WHERE sequence = (SELECT decision FROM one))",
    "INSERT INTO structure SELECT new.structure, new.hash, atoms, formula, copy.data, NULL FROM new JOIN copy USING (i) CROSS JOIN one",
    "INSERT INTO candidate SELECT new.decision, new.id, new.hash, CASE WHEN is_accepted THEN new.structure END, i % 1000, 0, i,
        seed_structure, 'biased', CASE WHEN is_accepted THEN 'accepted' ELSE 'declined' END, new.reason, mixture_version, atoms,
        formula, temperature, 1 + 0.4 * x, energy, walker_gamma, walker_gamma_nbr, walker_above, selector_gamma,
        selector_gamma_nbr, selector_above, 1 + 2 * x, original_gamma_nbr, original_above, NULL, NULL, NULL, NULL FROM new CROSS JOIN one",
    "INSERT INTO candidate_data SELECT new.decision, copy.block, pool.features, selector_grades, grades FROM new JOIN copy USING (i)
        JOIN pool ON place = i / 20 % (SELECT count(*) FROM pool)
        CROSS JOIN (SELECT selector_grades FROM candidate_data WHERE decision = (SELECT decision FROM one))",
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
    "INSERT INTO label (structure, protocol, status, energy, forces, job, attempt, received, checksum)
        SELECT job.structure, job.protocol, 'label', energy, copy.forces, job.number, 1, ended, -1
        FROM job CROSS JOIN new ON new.decision = job.decision CROSS JOIN copy ON copy.i = new.i
        CROSS JOIN attempt ON attempt.job = job.number
        CROSS JOIN (SELECT energy FROM label WHERE structure = (SELECT structure FROM one) LIMIT 1) WHERE job.state = 'labelled'",
    "UPDATE campaign SET value = CASE key WHEN 'labels_made' THEN (SELECT count(*) FROM attempt WHERE outcome = 'labelled') ELSE
        (SELECT CAST(sum(round(1000 * core_seconds)) AS INTEGER) FROM attempt
            WHERE outcome = 'labelled' OR (key = 'core_milliseconds' AND outcome IS NOT NULL)) END
        WHERE key IN ('labels_made', 'core_milliseconds', 'label_core_milliseconds')",
    "WITH RECURSIVE n(i) AS (SELECT 0 UNION ALL SELECT i + 1 FROM n WHERE i < 999)
        INSERT OR IGNORE INTO walk SELECT i, origin, partner, seed_structure, CASE WHEN i % 10 = 0 THEN 'running' ELSE state END, reason,
            assignments, accepted, step, segment, tau, temperature, relative_volume, gamma_max, rejected, rollbacks, selector_state, checkpoint,
            NULL, NULL
        FROM n CROSS JOIN (SELECT * FROM walk LIMIT 1)",
];

/// Adds candidates to a finished campaign without durability, because a lost database can be generated again.
pub fn make(here: &Path, candidates: u64) {
    let file = here.join("campaign/campaign.sqlite");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(async {
        let labelled = newest(&here.join("campaign")).await;
        let options =
            SqliteConnectOptions::new().filename(file).foreign_keys(false).pragma("temp_store", "memory");
        // Rows arrive in any order of the indexes; the cache holds all pages.
        let options = options.journal_mode(SqliteJournalMode::Off).pragma("cache_size", "-1000000");
        let mut connection =
            options.synchronous(SqliteSynchronous::Off).connect().await.expect("the database");
        for statement in ONE {
            execute(&mut connection, statement, candidates).await;
        }
        copy(&mut connection, labelled, candidates).await;
        for statement in MORE {
            execute(&mut connection, statement, candidates).await;
        }
        execute(&mut connection, "PRAGMA journal_mode = WAL", candidates).await;
        connection.close().await.expect("the database is closed");
        let store = Store::open(here.join("campaign").as_path()).await.expect("the campaign's database");
        store.write_checksums().await.expect("checksums");
        store.close().await;
    });
}

async fn execute(connection: &mut SqliteConnection, statement: &str, candidates: u64) {
    let mut query = sqlx::query(AssertSqlSafe(statement.to_owned()));
    if statement.contains("$1") {
        query = query.bind(candidates.cast_signed());
    }
    query.execute(connection).await.unwrap_or_else(|error| panic!("{statement}: {error}"));
}

/// The newest accepted candidate of a biased walk, with its label.
async fn newest(campaign: &Path) -> ExportRow {
    let store = Store::open_read_only(campaign).await.expect("the campaign's database");
    let protocol = store.protocols().await.expect("protocols")[0].hash;
    let filter = ExportFilter { protocol, biased: true, control: false, imported: false };
    let mut rows = store.labelled(&filter, None, u32::MAX).await.expect("labels");
    store.close().await;
    rows.pop().expect("a labelled candidate")
}

/// Fills `copy`. No two structures may share their content, so one atom of each moves by at most 10⁻⁴ Å.
async fn copy(connection: &mut SqliteConnection, one: ExportRow, candidates: u64) {
    let ExportRow { source: ExportSource::Candidate { original, block, .. }, mut structure, label, .. } = one
    else {
        panic!("a candidate");
    };
    let view = block.view();
    let mut data: Vec<u8> =
        sqlx::query_scalar("SELECT data FROM structure WHERE number = (SELECT structure FROM one)")
            .fetch_one(&mut *connection)
            .await
            .expect("its structure");
    let place = BEFORE_SPECIES + structure.len();
    let x = structure.positions[0][0];
    for i in (ACCEPTED..=candidates).step_by(ACCEPTED as usize) {
        structure.positions[0][0] = x + 1e-4 * i as f64 / candidates as f64;
        data[place..place + 8].copy_from_slice(&structure.positions[0][0].to_le_bytes());
        let mut numbers = (0..).map(|k| random((i << 16) + k) as f64 / u64::MAX as f64);
        let forces = label.forces.as_flattened().iter().zip(&mut numbers).map(|(f, u)| f + u - 0.5);
        let forces: Vec<u8> = forces.flat_map(f64::to_le_bytes).collect();
        let grades = original.gamma.iter().chain(&original.gamma_nbr);
        let count = PLAIN | grades.clone().count() as u64;
        let grades = grades.zip(&mut numbers).flat_map(|(grade, u)| (2.0 * u * grade).to_le_bytes());
        let grades: Vec<u8> = count.to_le_bytes().into_iter().chain(grades).collect();
        let content = ContentHash::from_structure(&structure);
        let walk = WalkId(u32::try_from(i % WALKS).expect("a walk"));
        let id = CandidateId { walk, segment: 0, step: i, content, ..view.id() };
        let candidate = Candidate { id, structure: structure.clone(), ..view.to_candidate() };
        sqlx::query("INSERT INTO copy VALUES ($1, $2, $3, $4, $5, $6, $7)")
            .bind(i.cast_signed())
            .bind(content.0.to_vec())
            .bind(data.clone())
            .bind(forces)
            .bind(grades)
            .bind(id.to_string())
            .bind(CandidateBlock::encode(&candidate).as_bytes().to_vec())
            .execute(&mut *connection)
            .await
            .expect("a row more");
    }
}
