//! The connections to a campaign on a PostgreSQL server, and how its transactions begin.

use std::fmt;
use std::io::{self, ErrorKind};
use std::sync::Arc;
use std::time::{Duration, Instant};

use sqlx::pool::PoolConnection;
use sqlx::postgres::{PgConnectOptions, PgPool, PgPoolOptions, Postgres};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, Executor, Transaction};
use tokio::time::{sleep, timeout};

use super::jobs::Jobs;
use crate::error::{Result, StoreError};
use crate::location::ServerUrl;

/// Maximum number of connections per process: one writer and some readers.
const MAX_CONNECTIONS: u32 = 5;
/// Idle connections are closed after this time: a server has few.
const IDLE_TIMEOUT: Duration = Duration::from_secs(60);
/// How long to wait for an unreachable server, and for a connection, before an operation fails.
const RECONNECT_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a run and every commit wait for a server that cannot be reached. A run has nothing else to do
/// meanwhile; a run that gives up continues later from the same state, but the user has to start it.
pub const SERVER_RECONNECT_TIMEOUT: Duration = Duration::from_secs(3600);
/// How long to probe the server for the reason of a missing connection.
const PROBE_TIMEOUT: Duration = Duration::from_secs(3);
/// Time between two tries to reach the server.
pub const RETRY_INTERVAL: Duration = Duration::from_millis(100);

/// The clock that leases use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// The server's clock: hosts need not agree on the time.
    Server,
    /// The caller's clock, as in SQLite, which serves one host.
    Caller,
}

/// A campaign on a server. Clones share its connections.
#[derive(Clone)]
pub struct PostgresServer {
    pub(super) pool: PgPool,
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

impl PostgresServer {
    /// Connects when a connection is needed first.
    pub(super) fn connect(url: &ServerUrl, writes: bool) -> Self {
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

    /// The same server over connections that create these views first.
    pub(super) fn with_views(self, url: &ServerUrl, views: Arc<str>) -> Self {
        Self { pool: pool(options(url), Some(views)), ..self }
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

    /// Begins a transaction that may write.
    pub async fn begin(&self) -> Result<Transaction<'static, Postgres>> {
        if !self.writes {
            return Err(StoreError::ReadOnly);
        }
        self.begin_with("BEGIN ISOLATION LEVEL READ COMMITTED").await
    }

    /// Begins a transaction that reads a snapshot.
    pub async fn begin_read(&self) -> Result<Transaction<'static, Postgres>> {
        self.begin_with("BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY").await
    }

    /// Before a transaction begins nothing has happened, so a failed start can be retried.
    async fn begin_with(&self, statement: &'static str) -> Result<Transaction<'static, Postgres>> {
        let started = Instant::now();
        loop {
            match self.explain_timeout(begin_uncancelled(self.pool.clone(), statement).await).await {
                Err(StoreError::Unreachable(_)) if started.elapsed() < self.reconnect_timeout => {
                    sleep(RETRY_INTERVAL).await
                }
                result => return result,
            }
        }
    }

    /// Begins a transaction that locks the leader's row and checks the fencing token, if there is one.
    pub async fn begin_as_leader(&self) -> Result<Transaction<'static, Postgres>> {
        let mut transaction = self.begin().await?;
        let leader = sqlx::query_as("SELECT generation, holder FROM leader FOR NO KEY UPDATE");
        self.check_leader(leader.fetch_one(&mut *transaction).await?)?;
        Ok(transaction)
    }

    /// See `Database::begin_commit`. The first statement locks the leader's row, so this waits for an earlier
    /// try that the server still executes.
    pub async fn begin_commit(
        &self,
        mark: i64,
        again: bool,
    ) -> Result<(Transaction<'static, Postgres>, bool)> {
        let mut transaction = self.begin().await?;
        if again {
            let last = sqlx::query_scalar("SELECT mark FROM leader FOR NO KEY UPDATE");
            let last: i64 = last.fetch_one(&mut *transaction).await?;
            if last == mark {
                return Ok((transaction, true));
            }
        }
        let leader = sqlx::query_as("UPDATE leader SET mark = $1 RETURNING generation, holder").bind(mark);
        self.check_leader(leader.fetch_one(&mut *transaction).await?)?;
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

impl fmt::Debug for PostgresServer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PostgresServer")
            .field("url", &self.shown)
            .field("generation", &self.generation)
            .finish()
    }
}

/// A connection pool whose connections create these views first, if there are any.
/// Begins a transaction in a task of its own. sqlx 0.9 does not roll back a transaction whose `BEGIN` was sent and whose caller was then
/// cancelled: the connection would return to the pool inside it, and writes there would fail, or reads see an old snapshot.
async fn begin_uncancelled(
    pool: PgPool,
    statement: &'static str,
) -> sqlx::Result<Transaction<'static, Postgres>> {
    let begun = tokio::spawn(async move { pool.begin_with(statement).await }).await;
    // The runtime cancels the task when it shuts down.
    begun.unwrap_or_else(|error| Err(sqlx::Error::Io(io::Error::other(error))))
}

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
pub(super) fn options(url: &ServerUrl) -> PgConnectOptions {
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
