//! Creates, opens and migrates the tables of a campaign on a PostgreSQL server.

use std::sync::LazyLock;

use sqlx::migrate::Migrator;
use sqlx::postgres::PgConnection;
use sqlx::{AssertSqlSafe, Executor};
use wire::CampaignId;

use super::server::PostgresServer;
use crate::database::{Database, Transaction, query};
use crate::error::{Result, StoreError};
use crate::location::ServerUrl;
use crate::migrations::{MigrationSource, migrator, schema_error};
use crate::old_schema::{self, FIRST_WITH_CHECKSUMS, FIRST_WITH_PRESENT_WORDS};
use crate::tables::{checksums, renamed_words};

/// The newest migration.
const SCHEMA: i64 = 22;

/// The migrations in order.
pub(crate) static STEPS: [MigrationSource; 21] = [
    (1, "campaign", include_str!("../../migrations/postgres/0001_campaign.sql")),
    (2, "calculations", include_str!("../../migrations/postgres/0002_calculations.sql")),
    (4, "counts", include_str!("../../migrations/postgres/0004_counts.sql")),
    (5, "jobs", include_str!("../../migrations/postgres/0005_jobs.sql")),
    (6, "relabel", include_str!("../../migrations/postgres/0006_relabel.sql")),
    (7, "listing", include_str!("../../migrations/postgres/0007_listing.sql")),
    (8, "brought", include_str!("../../migrations/postgres/0008_brought.sql")),
    (9, "checksums", include_str!("../../migrations/postgres/0009_checksums.sql")),
    (10, "exclude", include_str!("../../migrations/postgres/0010_exclude.sql")),
    (11, "walk conditions", include_str!("../../migrations/postgres/0011_walk_conditions.sql")),
    (12, "lower states", include_str!("../../migrations/postgres/0012_lower_states.sql")),
    (13, "queued imports", include_str!("../../migrations/postgres/0013_queued_imports.sql")),
    (14, "start time", include_str!("../../migrations/postgres/0014_start_time.sql")),
    (15, "assignments", include_str!("../../migrations/postgres/0015_assignments.sql")),
    (16, "words", include_str!("../../migrations/postgres/0016_words.sql")),
    (17, "versions", include_str!("../../migrations/postgres/0017_versions.sql")),
    (18, "label values", include_str!("../../migrations/postgres/0018_label_values.sql")),
    (19, "walk traces", include_str!("../../migrations/postgres/0019_walk_traces.sql")),
    (20, "assignments", include_str!("../../migrations/postgres/0020_assignments.sql")),
    (21, "trajectories", include_str!("../../migrations/postgres/0021_trajectories.sql")),
    (22, "samples", include_str!("../../migrations/postgres/0022_samples.sql")),
];

static MIGRATIONS: LazyLock<Migrator> = LazyLock::new(|| migrator(&STEPS));

impl PostgresServer {
    /// Creates the tables, which must not hold a campaign yet.
    pub async fn create(url: &ServerUrl, campaign: CampaignId) -> Result<Self> {
        let server = Self::connect(url, true);
        make_tables(url, &server).await?;
        match server.campaign().await? {
            None => {
                server.migrate(url).await?;
                Ok(server)
            }
            Some(found) => {
                Err(StoreError::Occupied { location: url.to_string(), found, wanted: campaign.to_string() })
            }
        }
    }

    /// Opens the campaign, and migrates its tables if it is opened for writing.
    pub async fn open(url: &ServerUrl, writes: bool) -> Result<Self> {
        let mut server = Self::connect(url, writes);
        let missing = || StoreError::Missing {
            location: url.to_string(),
            lacks: "tables of a campaign in that schema",
        };
        let found = version(url, &mut *server.connection().await?).await?.ok_or_else(missing)?;
        if found < SCHEMA && writes {
            server.migrate(url).await?;
        }
        if found < SCHEMA && !writes {
            let columns = columns(url, &mut *server.connection().await?).await?;
            if let Some(views) = old_schema::views(&url.schema, found, &columns) {
                server = server.with_views(url, views.into());
            }
        }
        server.campaign().await?.ok_or_else(missing)?;
        Ok(server)
    }

    /// Migrates the tables to the newest version, checksums and words included, in one transaction. Only one process
    /// does so at a time. Creates the tables if the schema has none.
    pub(super) async fn migrate(&self, url: &ServerUrl) -> Result<()> {
        let mut transaction = Transaction::Postgres(self.begin().await?, self.clock);
        let one = "SELECT 1::BIGINT FROM pg_advisory_xact_lock(hashtext($1))";
        let one = query(one).bind(format!("{}: new version", url.schema));
        one.rows(&mut transaction).await?;
        let Transaction::Postgres(connection, _) = &mut transaction else { return Ok(()) };
        let found = version(url, &mut *connection).await?;
        if found == Some(SCHEMA) {
            return Ok(());
        }
        // The function that `run` calls. With a borrowed connection, `run` gives a future that is not `Send`.
        MIGRATIONS.run_direct(None, &mut **connection, false).await.map_err(schema_error)?;
        if found < Some(FIRST_WITH_CHECKSUMS) {
            checksums::fill(&mut transaction).await?;
        }
        if found < Some(FIRST_WITH_PRESENT_WORDS) {
            renamed_words::rename(&mut transaction).await?;
        }
        transaction.commit().await
    }

    /// Id of the campaign, if there is one.
    async fn campaign(&self) -> Result<Option<String>> {
        let id = query("SELECT value FROM campaign WHERE key = 'id'");
        id.fetch_optional(&Database::Postgres(self.clone())).await
    }
}

/// Creates the schema and its tables if there are none. Others see no tables or all of them. Tables of an earlier version stay
/// as they are: a process of that version may lead the campaign.
pub(super) async fn make_tables(url: &ServerUrl, server: &PostgresServer) -> Result<()> {
    let mut connection = server.connection().await?;
    if version(url, &mut connection).await?.is_some() {
        return Ok(());
    }
    // The name consists of letters, digits and underscores.
    let create = AssertSqlSafe(format!("CREATE SCHEMA IF NOT EXISTS \"{}\"", url.schema));
    let sql = "SELECT EXISTS (SELECT 1 FROM pg_namespace WHERE nspname = $1)";
    let exists: bool = sqlx::query_scalar(sql).bind(&url.schema).fetch_one(&mut *connection).await?;
    if !exists {
        match connection.execute(create).await {
            Ok(_) => {}
            // Another process created it first.
            Err(sqlx::Error::Database(error)) if error.is_unique_violation() => {}
            Err(error) => return Err(error.into()),
        }
    }
    drop(connection);
    server.migrate(url).await
}

/// The name of each table in the schema with each of its columns.
async fn columns(url: &ServerUrl, connection: &mut PgConnection) -> Result<Vec<(String, String)>> {
    let sql = "SELECT table_name::TEXT, column_name::TEXT FROM information_schema.columns
        WHERE table_schema = $1 ORDER BY table_name, ordinal_position";
    Ok(sqlx::query_as(sql).bind(&url.schema).fetch_all(connection).await?)
}

/// Version of the campaign's tables in the schema; `None` without tables.
async fn version(url: &ServerUrl, connection: &mut PgConnection) -> Result<Option<i64>> {
    let sql =
        "SELECT tablename::TEXT FROM pg_tables WHERE schemaname = $1 ORDER BY tablename = 'leader' DESC, 1";
    let tables: Vec<String> = sqlx::query_scalar(sql).bind(&url.schema).fetch_all(&mut *connection).await?;
    match tables.first() {
        None => return Ok(None),
        // Earlier versions of the program left this when they were killed while they created the tables.
        Some(first) if first == "_sqlx_migrations" && tables.len() == 1 => return Ok(None),
        Some(first) if first != "leader" => {
            return Err(StoreError::ForeignSchema { location: url.to_string(), found: first.clone() });
        }
        _ => {}
    }
    let found: Option<i64> =
        sqlx::query_scalar("SELECT max(version) FROM _sqlx_migrations").fetch_one(connection).await?;
    match found {
        Some(found) if found > SCHEMA => {
            Err(StoreError::Version { path: url.as_str().into(), found, reads: SCHEMA })
        }
        found => Ok(found),
    }
}
