//! Leader election: an advisory lock of the server, which belongs to a connection.
//!
//! A connection may break while its process lives, and another process may then take the lock. Each new holder
//! therefore increments the generation in the table `leader`, a fencing token under which it writes
//! ([`PostgresServer::begin_as_leader`]): holders of an earlier generation can no longer write. A process that loses the
//! connection takes the lock again if no other process had it meanwhile.

use std::time::{Duration, Instant};

use sqlx::postgres::{PgConnectOptions, PgConnection};
use sqlx::{ConnectOptions, Connection};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use super::open::make_tables;
use super::server::{PostgresServer, options};
use crate::error::{Result, StoreError};
use crate::location::ServerUrl;
use crate::process_start::process_start_time;
use crate::processes::this_host;

/// Time between two checks of the connection, and between two tries to take the lock again.
const POLL_INTERVAL: Duration = Duration::from_secs(1);
/// Longest time to wait for a reply.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);
/// How long a server may take to notice that the last holder has left.
const RELEASE_TIMEOUT: Duration = Duration::from_secs(1);
const RELEASE_POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Returns whether this connection now has the lock.
const TRY_LOCK: &str = "SELECT pg_try_advisory_lock(hashtextextended('calmwalk ' || $1, 0))";

/// The right to lead the campaign in one schema.
#[derive(Debug)]
pub struct Leadership {
    pub generation: i64,
    location: String,
    /// The new leader, if there is one.
    successor: watch::Receiver<Option<String>>,
    holder_task: JoinHandle<()>,
}

impl Leadership {
    pub async fn take(url: &ServerUrl, who: &str) -> Result<Self> {
        let server = PostgresServer::connect(url, true);
        make_tables(url, &server).await?;
        let (options, started) = (options(url), Instant::now());
        let mut connection = options.connect().await?;
        while !try_lock(&mut connection, &url.schema).await? {
            if started.elapsed() > RELEASE_TIMEOUT {
                let holder: String =
                    sqlx::query_scalar("SELECT holder FROM leader").fetch_one(&mut connection).await?;
                return Err(StoreError::Locked { location: url.to_string(), holder });
            }
            tokio::time::sleep(RELEASE_POLL_INTERVAL).await;
        }
        // No process of an earlier version leads the campaign now.
        server.migrate(url).await?;
        server.close().await;
        let pid = std::process::id();
        let sql = "UPDATE leader SET generation = generation + 1, holder = $1, start_time = $2 RETURNING generation";
        let query = sqlx::query_scalar(sql).bind(format!("process {pid} ({who}) on {}", this_host()));
        let query = query.bind(process_start_time(pid).unwrap_or_default());
        let generation = query.fetch_one(&mut connection).await?;
        let (announce, successor) = watch::channel(None);
        let holder = hold(connection, options, url.schema.clone(), generation, announce);
        Ok(Self { generation, location: url.to_string(), successor, holder_task: tokio::spawn(holder) })
    }

    /// Waits until another process leads the campaign.
    pub async fn lost(&self) -> StoreError {
        let mut successor = self.successor.clone();
        let holder = match successor.wait_for(Option::is_some).await {
            Ok(holder) => holder.clone().unwrap_or_default(),
            // The task ends with the lock or with the runtime.
            Err(_) => std::future::pending().await,
        };
        StoreError::LockLost { location: self.location.clone(), holder }
    }
}

impl Drop for Leadership {
    fn drop(&mut self) {
        self.holder_task.abort();
    }
}

async fn try_lock(connection: &mut PgConnection, schema: &str) -> Result<bool> {
    Ok(sqlx::query_scalar(TRY_LOCK).bind(schema).fetch_one(connection).await?)
}

/// Holds the lock until another process takes it.
async fn hold(
    mut connection: PgConnection,
    options: PgConnectOptions,
    schema: String,
    generation: i64,
    announce: watch::Sender<Option<String>>,
) {
    loop {
        while matches!(timeout(ANSWER_TIMEOUT, connection.ping()).await, Ok(Ok(()))) {
            tokio::time::sleep(POLL_INTERVAL).await;
        }
        connection = loop {
            match timeout(ANSWER_TIMEOUT, reacquire(&options, &schema, generation)).await {
                Ok(Ok(Reacquired::Held(connection))) => break connection,
                Ok(Ok(Reacquired::Lost(holder))) => {
                    // The receiver may be gone.
                    let _ = announce.send(Some(holder));
                    return;
                }
                // Not yet: the server cannot be reached, or has not noticed that the old connection broke.
                _ => tokio::time::sleep(POLL_INTERVAL).await,
            }
        };
    }
}

enum Reacquired {
    Held(PgConnection),
    NotYet,
    Lost(String),
}

async fn reacquire(options: &PgConnectOptions, schema: &str, generation: i64) -> Result<Reacquired> {
    let mut connection = options.connect().await?;
    let held = try_lock(&mut connection, schema).await?;
    let leader = sqlx::query_as("SELECT generation, holder FROM leader").fetch_one(&mut connection).await?;
    let (newest, holder): (i64, String) = leader;
    Ok(match (newest == generation, held) {
        (true, true) => Reacquired::Held(connection),
        (true, false) => Reacquired::NotYet,
        (false, _) => Reacquired::Lost(holder),
    })
}
