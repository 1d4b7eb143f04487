//! Creates and opens a database on a PostgreSQL server.

mod jobs;
pub mod leadership;

use std::fmt;
use std::io::{self, ErrorKind};
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

use sqlx::migrate::Migrator;
use sqlx::pool::PoolConnection;
use sqlx::postgres::{PgConnectOptions, PgConnection, PgPool, PgPoolOptions, Postgres};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, Executor};
use tokio::time::{sleep, timeout};
use wire::CampaignId;

use self::jobs::Jobs;
use crate::database::{Clock, Database, Transaction, query};
use crate::error::{Result, StoreError};
use crate::location::ServerUrl;
use crate::migrations::{Step, migrator};
use crate::tables::checksums;

/// The newest migration.
const SCHEMA: i64 = 13;
/// The first version whose rows have checksums.
const FIRST_WITH_CHECKSUMS: i64 = 9;
/// Maximum number of connections per process: one writer and some readers.
const MAX_CONNECTIONS: u32 = 5;
/// Idle connections are closed after this time: a server has few.
const IDLE_TIMEOUT: Duration = Duration::from_secs(60);
/// How long to wait for an unreachable server, and for a connection, before an operation fails.
const RECONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a run and every commit wait for a server that cannot be reached. A run has nothing else to do
/// meanwhile; a run that gives up continues later from the same state, but somebody has to start it.
pub const SERVER_RECONNECT_TIMEOUT: Duration = Duration::from_secs(3600);
/// How long to probe the server for the reason of a missing connection.
const PROBE_TIMEOUT: Duration = Duration::from_secs(3);
/// Time between two tries to reach the server.
pub const RETRY_INTERVAL: Duration = Duration::from_millis(100);

/// The migrations in order.
pub(crate) static STEPS: [Step; 12] = [
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
];

static MIGRATIONS: LazyLock<Migrator> = LazyLock::new(|| migrator(&STEPS));

/// A campaign on a server. Clones share its connections.
#[derive(Clone)]
pub struct Server {
    pool: PgPool,
    /// URL without password.
    shown: Arc<str>,
    writes: bool,
    pub clock: Clock,
    /// Fencing token of the lock that the user of this store holds, if any.
    pub generation: Option<i64>,
    /// How long to wait for an unreachable server.
    pub reconnect_timeout: Duration,
    jobs: Arc<Jobs>,
}

impl Server {
    /// Creates the tables, which must not hold a campaign yet.
    pub async fn create(url: &ServerUrl, campaign: CampaignId) -> Result<Self> {
        let server = Self::connect(url, true);
        make_tables(url, &server).await?;
        match server.campaign().await? {
            None => Ok(server),
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
        if found < FIRST_WITH_CHECKSUMS && !writes {
            let views = checksums::views(&url.schema).into();
            server.pool = pool(options(url), Some(views));
        }
        server.campaign().await?.ok_or_else(missing)?;
        Ok(server)
    }

    fn connect(url: &ServerUrl, writes: bool) -> Self {
        let options = options(url);
        let pool = pool(options.clone(), None);
        let jobs = Arc::new(Jobs::new(options, &url.schema));
        Self {
            pool,
            shown: url.as_str().into(),
            writes,
            clock: Clock::Server,
            generation: None,
            reconnect_timeout: RECONNECT_TIMEOUT,
            jobs,
        }
    }

    /// Migrates the tables to the newest version, checksums included, in one transaction. Only one process does so
    /// at a time.
    async fn migrate(&self, url: &ServerUrl) -> Result<()> {
        let mut transaction = self.begin().await?;
        let one = "SELECT 1::BIGINT FROM pg_advisory_xact_lock(hashtext($1))";
        let one = query(one).bind(format!("{}: new version", url.schema));
        one.rows(&mut transaction).await?;
        let Transaction::Postgres(connection, _) = &mut transaction else { return Ok(()) };
        let found = version(url, &mut *connection).await?;
        // The function that `run` calls. With a borrowed connection, `run` gives a future that is not `Send`.
        MIGRATIONS.run_direct(None, &mut **connection, false).await.map_err(schema_error)?;
        if found < Some(FIRST_WITH_CHECKSUMS) {
            checksums::fill(&mut transaction).await?;
        }
        transaction.commit().await
    }

    /// Id of the campaign, if there is one.
    async fn campaign(&self) -> Result<Option<String>> {
        let id = query("SELECT value FROM campaign WHERE key = 'id'");
        id.fetch_optional(&Database::Postgres(self.clone())).await
    }

    /// A connection for reading or for beginning a transaction.
    pub async fn connection(&self) -> Result<PoolConnection<Postgres>> {
        self.explain_timeout(self.pool.acquire().await).await
    }

    /// Replaces a timeout of the connection pool by its reason. The pool retries if a server refuses connections or
    /// has none left, and finally reports only the timeout; so this asks the server itself.
    async fn explain_timeout<T>(&self, waited: sqlx::Result<T>) -> Result<T> {
        let Err(sqlx::Error::PoolTimedOut) = waited else { return Ok(waited?) };
        let timed_out = |why: &str| sqlx::Error::Io(io::Error::new(ErrorKind::TimedOut, why));
        let connect = async { self.pool.connect_options().connect().await?.close().await };
        Err(match timeout(PROBE_TIMEOUT, connect).await {
            Ok(Ok(())) => StoreError::Unreachable(timed_out(
                "it accepts connections, but all connections of this process are waiting, for its disk or for locks",
            )),
            Ok(Err(error)) => error.into(),
            Err(_) => StoreError::Unreachable(timed_out("no answer")),
        })
    }

    pub async fn begin(&self) -> Result<Transaction> {
        if !self.writes {
            return Err(StoreError::ReadOnly);
        }
        self.begin_with("BEGIN ISOLATION LEVEL READ COMMITTED").await
    }

    pub async fn begin_read(&self) -> Result<Transaction> {
        self.begin_with("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY").await
    }

    /// Before a transaction begins nothing has happened, so a failed start can be retried.
    async fn begin_with(&self, statement: &'static str) -> Result<Transaction> {
        let started = Instant::now();
        loop {
            match self.explain_timeout(self.pool.begin_with(statement).await).await {
                Err(StoreError::Unreachable(_)) if started.elapsed() < self.reconnect_timeout => {
                    sleep(RETRY_INTERVAL).await
                }
                result => return Ok(Transaction::Postgres(result?, self.clock)),
            }
        }
    }

    /// Begins a transaction that locks the leader's row and checks the fencing token, if there is one.
    pub async fn begin_as_leader(&self) -> Result<Transaction> {
        let mut transaction = self.begin().await?;
        let leader = query("SELECT generation, holder FROM leader").locked();
        self.check_leader(leader.fetch_one(&mut transaction).await?)?;
        Ok(transaction)
    }

    /// See [`Database::begin_commit`]. The first statement locks the leader's row, so this waits for an earlier
    /// try that the server still executes.
    pub async fn begin_commit(&self, mark: i64, again: bool) -> Result<(Transaction, bool)> {
        let mut transaction = self.begin().await?;
        if again {
            let last: i64 = query("SELECT mark FROM leader").locked().fetch_one(&mut transaction).await?;
            if last == mark {
                return Ok((transaction, true));
            }
        }
        let leader = query("UPDATE leader SET mark = $1 RETURNING generation, holder").bind(mark);
        self.check_leader(leader.fetch_one(&mut transaction).await?)?;
        Ok((transaction, false))
    }

    fn check_leader(&self, (generation, holder): (i64, String)) -> Result<()> {
        match self.generation {
            Some(own) if own != generation => {
                Err(StoreError::LockLost { location: self.shown.to_string(), holder })
            }
            _ => Ok(()),
        }
    }

    /// Size of the tables in bytes, with their indexes and long columns.
    pub async fn size(&self) -> Result<u64> {
        let sql =
            "SELECT CAST(coalesce(sum(pg_total_relation_size(pg_class.oid)), 0) AS BIGINT) FROM pg_class
                   JOIN pg_namespace ON pg_namespace.oid = relnamespace
                   WHERE nspname = current_schema() AND relkind = 'r'";
        query(sql).fetch_one(&Database::Postgres(self.clone())).await
    }

    /// Rewrites every table of the campaign.
    pub async fn compact(&self) -> Result<()> {
        let mut connection = self.connection().await?;
        let sql = "SELECT tablename::TEXT FROM pg_tables WHERE schemaname = current_schema() ORDER BY 1";
        let tables: Vec<String> = sqlx::query_scalar(sql).fetch_all(&mut *connection).await?;
        for table in tables {
            let vacuum = AssertSqlSafe(format!("VACUUM (FULL, ANALYZE) \"{table}\""));
            connection.execute(vacuum).await?;
        }
        Ok(())
    }

    pub async fn wait_for_jobs(&self, longest: Duration) {
        self.jobs.wait(longest).await;
    }

    pub async fn close(&self) {
        self.jobs.close();
        self.pool.close().await;
    }
}

impl fmt::Debug for Server {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Server").field("url", &self.shown).field("generation", &self.generation).finish()
    }
}

/// A connection pool whose connections create these views first, if there are any.
fn pool(options: PgConnectOptions, views: Option<Arc<str>>) -> PgPool {
    let pool = PgPoolOptions::new()
        .max_connections(MAX_CONNECTIONS)
        .acquire_timeout(RECONNECT_TIMEOUT)
        .idle_timeout(IDLE_TIMEOUT);
    let pool = pool.after_connect(move |connection, _| {
        let views = views.clone();
        Box::pin(async move {
            match views {
                Some(views) => connection.execute(AssertSqlSafe(views.to_string())).await.map(drop),
                None => Ok(()),
            }
        })
    });
    pool.connect_lazy_with(options)
}

/// Connection options. Names without a schema refer to the campaign's schema.
fn options(url: &ServerUrl) -> PgConnectOptions {
    let name = url.options.get_application_name().unwrap_or("calmwalk").to_owned();
    PgConnectOptions::clone(&url.options)
        .application_name(&name)
        // If this host is lost, the server frees its locks within half a minute.
        .options([
            ("tcp_keepalives_idle", "10"),
            ("tcp_keepalives_interval", "5"),
            ("tcp_keepalives_count", "3"),
        ])
        .options([("search_path", url.schema.as_str()), ("synchronous_commit", "on")])
}

/// Creates the schema and its tables if they do not exist.
async fn make_tables(url: &ServerUrl, server: &Server) -> Result<()> {
    let mut connection = server.connection().await?;
    if version(url, &mut connection).await? == Some(SCHEMA) {
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
    MIGRATIONS.run(&server.pool).await.map_err(schema_error)
}

/// Version of the campaign's tables in the schema; `None` without tables.
async fn version(url: &ServerUrl, connection: &mut PgConnection) -> Result<Option<i64>> {
    let sql =
        "SELECT tablename::TEXT FROM pg_tables WHERE schemaname = $1 ORDER BY tablename = 'leader' DESC, 1";
    let tables: Vec<String> = sqlx::query_scalar(sql).bind(&url.schema).fetch_all(&mut *connection).await?;
    match tables.first() {
        None => return Ok(None),
        // This may be left by a process that was killed while it created the tables.
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

fn schema_error(error: sqlx::migrate::MigrateError) -> StoreError {
    match error {
        sqlx::migrate::MigrateError::Execute(error)
        | sqlx::migrate::MigrateError::ExecuteMigration(error, _) => error.into(),
        error => StoreError::Schema(error),
    }
}
