//! Creates a campaign.

use super::logs::insert_operation;
use super::protocols::{insert_seed_structure, set_campaign_value};
use crate::Store;
use crate::database::Database;
use crate::error::Result;
use crate::location::Location;
use crate::postgres::server::PostgresServer;
use crate::records::{CampaignRecord, SeedStructure};
use crate::sqlite::file::DatabaseFile;

impl Store {
    /// Creates a campaign on a server or in an existing directory. The caller holds its [`crate::CampaignLock`].
    /// The campaign is created as a whole or not at all.
    pub async fn create(
        location: impl Into<Location>,
        campaign: &CampaignRecord,
        seed_structures: &[SeedStructure],
        now: i64,
    ) -> Result<Self> {
        let fill = async |database: &Database| write_campaign(database, campaign, seed_structures, now).await;
        let database = match location.into() {
            Location::Directory(directory) => Database::Sqlite(DatabaseFile::create(&directory, fill).await?),
            Location::Server(url) => {
                let database = Database::Postgres(PostgresServer::create(&url, campaign.id).await?);
                fill(&database).await?;
                database
            }
        };
        Ok(Self { database })
    }
}

/// Writes the initial rows of a database.
async fn write_campaign(
    database: &Database,
    campaign: &CampaignRecord,
    seed_structures: &[SeedStructure],
    now: i64,
) -> Result<()> {
    let mut transaction = database.begin_as_leader().await?;
    for (key, value) in [
        ("id", campaign.id.to_string().as_str()),
        ("program_version", &campaign.program_version),
        ("mode", &campaign.mode),
        ("configuration", &campaign.configuration),
        ("resolved_configuration", &campaign.resolved_configuration),
        ("configuration_in_force", &campaign.configuration_in_force),
    ] {
        set_campaign_value(&mut transaction, key, value).await?;
    }
    for seed_structure in seed_structures {
        insert_seed_structure(&mut transaction, seed_structure).await?;
    }
    let detail = serde_json::json!({ "program_version": campaign.program_version });
    insert_operation(&mut transaction, now, "created", &detail).await?;
    transaction.commit().await
}
