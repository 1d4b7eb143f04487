//! Beginning a campaign, and opening one.

use std::time::Duration;

use crate::database::{Clock, Database};
use crate::error::Result;
use crate::location::Location;
use crate::lock::CampaignLock;
use crate::postgres::Server;
use crate::records::{Campaign, SeedStructure};
use crate::sqlite::DatabaseFile;
use crate::tables::protocols;

/// How long a server that is away is waited for by those who run a campaign, and by every commit. Whoever waits has nothing
/// else to do; a campaign that failed goes on from here just as well, but somebody has to start it.
pub const SERVER_RECONNECT_TIMEOUT: Duration = Duration::from_secs(3600);

/// The database of one campaign. Clones share its connections.
#[derive(Clone, Debug)]
pub struct Store {
    pub(crate) database: Database,
}

impl Store {
    /// Begins a campaign in a directory, which must exist, or on a server. The caller holds its
    /// [`crate::CampaignLock`]. Either the whole campaign is there afterwards, or none.
    pub async fn create(
        location: impl Into<Location>,
        campaign: &Campaign,
        seeds: &[SeedStructure],
        now: i64,
    ) -> Result<Self> {
        let fill =
            async |database: &Database| protocols::write_campaign(database, campaign, seeds, now).await;
        let database = match location.into() {
            Location::Directory(directory) => Database::Sqlite(DatabaseFile::create(&directory, fill).await?),
            Location::Server(url) => {
                let database = Database::Postgres(Server::create(&url, campaign.id).await?);
                fill(&database).await?;
                database
            }
        };
        Ok(Self { database })
    }

    /// Opens a campaign, and brings its tables up to date.
    pub async fn open(location: impl Into<Location>) -> Result<Self> {
        let database = match location.into() {
            Location::Directory(directory) => Database::Sqlite(DatabaseFile::open(&directory).await?),
            Location::Server(url) => Database::Postgres(Server::open(&url, true).await?),
        };
        Ok(Self { database })
    }

    /// Opens a campaign to look at it, also where nothing may be written. Tables of an earlier version stay as they
    /// are: what they lack is filled in where they are read.
    pub async fn open_read_only(location: impl Into<Location>) -> Result<Self> {
        let database = match location.into() {
            Location::Directory(directory) => {
                Database::Sqlite(DatabaseFile::open_read_only(&directory).await?)
            }
            Location::Server(url) => Database::Postgres(Server::open(&url, false).await?),
        };
        Ok(Self { database })
    }

    /// The same store for whoever holds `lock`: on a server, what leads the campaign ([`Self::commit`],
    /// [`Self::reclaim_leases`], its configuration, protocols and seed structures) fails from the moment on at which another
    /// process has the lock. On this host the system sees to it that there is no other.
    pub fn fenced_by(mut self, lock: &CampaignLock) -> Self {
        if let Database::Postgres(server) = &mut self.database {
            server.generation = lock.generation();
        }
        self
    }

    /// The same store, which waits for a server that is away for so long, and not some seconds, before it says so. What
    /// breaks in the middle of a transaction fails at once in any case, but for [`Self::commit`].
    pub fn with_reconnect_timeout(mut self, timeout: Duration) -> Self {
        if let Database::Postgres(server) = &mut self.database {
            server.reconnect_timeout = timeout;
        }
        self
    }

    /// The same store, whose leases go by the times that callers give also on a server: to tell it what time it is.
    #[doc(hidden)]
    pub fn with_caller_clock(mut self) -> Self {
        if let Database::Postgres(server) = &mut self.database {
            server.clock = Clock::Caller;
        }
        self
    }

    /// Waits until there may be new label jobs, or for `longest`. A server tells when there are; that may be lost like
    /// any message, so the queue is to be looked at in any case. In a file nobody tells.
    pub async fn wait_for_jobs(&self, longest: Duration) {
        match &self.database {
            Database::Sqlite(_) => tokio::time::sleep(longest).await,
            Database::Postgres(server) => server.wait_for_jobs(longest).await,
        }
    }

    /// Whether [`Self::wait_for_jobs`] is told of jobs.
    pub fn has_job_notifications(&self) -> bool {
        matches!(self.database, Database::Postgres(_))
    }

    /// Closes every connection. What was committed is safe without it.
    pub async fn close(&self) {
        self.database.close().await;
    }
}
