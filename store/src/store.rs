//! The store of a campaign, and how it is opened.

use std::time::Duration;

use crate::database::Database;
use crate::error::Result;
use crate::location::Location;
use crate::lock::CampaignLock;
use crate::postgres::server::{Clock, PostgresServer};
use crate::sqlite::file::DatabaseFile;

/// The database of one campaign. Clones share its connections.
#[derive(Clone, Debug)]
pub struct Store {
    pub(crate) database: Database,
}

impl Store {
    /// Opens a campaign and migrates its tables to the newest version.
    pub async fn open(location: impl Into<Location>) -> Result<Self> {
        let database = match location.into() {
            Location::Directory(directory) => Database::Sqlite(DatabaseFile::open(&directory).await?),
            Location::Server(url) => Database::Postgres(PostgresServer::open(&url, true).await?),
        };
        Ok(Self { database })
    }

    /// Opens a campaign for reading, also where nothing may be written. Tables of an earlier version are not
    /// migrated: reading functions fill in what they lack.
    pub async fn open_read_only(location: impl Into<Location>) -> Result<Self> {
        let database = match location.into() {
            Location::Directory(directory) => {
                Database::Sqlite(DatabaseFile::open_read_only(&directory).await?)
            }
            Location::Server(url) => Database::Postgres(PostgresServer::open(&url, false).await?),
        };
        Ok(Self { database })
    }

    /// Ties this store to `lock`. On a server, everything that leads the campaign ([`Self::commit`],
    /// [`Self::reclaim_leases`], changes to its configuration, protocols and seed structures) fails as soon as
    /// another process takes the lock. For a directory the operating system guarantees a single holder.
    pub fn fenced_by(mut self, lock: &CampaignLock) -> Self {
        if let Database::Postgres(server) = &mut self.database {
            server.generation = lock.generation();
        }
        self
    }

    /// Sets how long to wait for a server that cannot be reached before a call fails (default: some seconds). An
    /// operation interrupted inside a transaction fails at once in any case, except [`Self::commit`].
    pub fn with_reconnect_timeout(mut self, timeout: Duration) -> Self {
        if let Database::Postgres(server) = &mut self.database {
            server.reconnect_timeout = timeout;
        }
        self
    }

    /// Makes leases on a server use the times that callers pass, so that tests can set the clock.
    #[doc(hidden)]
    pub fn with_caller_clock(mut self) -> Self {
        if let Database::Postgres(server) = &mut self.database {
            server.clock = Clock::Caller;
        }
        self
    }

    /// Waits until there may be new label jobs, but no longer than `longest`. A server sends notifications, which
    /// may be lost: poll the queue afterwards in any case. SQLite sends none.
    pub async fn wait_for_jobs(&self, longest: Duration) {
        match &self.database {
            Database::Sqlite(_) => tokio::time::sleep(longest).await,
            Database::Postgres(server) => server.wait_for_jobs(longest).await,
        }
    }

    /// Whether the database notifies [`Self::wait_for_jobs`] of new jobs.
    pub fn has_job_notifications(&self) -> bool {
        matches!(self.database, Database::Postgres(_))
    }

    /// Closes every connection. Committed data is safe without this call.
    pub async fn close(&self) {
        self.database.close().await;
    }
}
