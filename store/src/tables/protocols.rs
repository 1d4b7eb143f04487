//! The campaign's properties, seed structures and label protocols.

use wire::ContentHash;

use super::checksums::CAMPAIGN_KEYS;
use super::logs::insert_operation;
use super::new_jobs::enqueue;
use super::structures::structure_id;
use crate::Store;
use crate::checksum::{CAMPAIGN, Names, PROTOCOL, SEED_STRUCTURE, joined};
use crate::database::{FromRow, SqlRow, SqlValue, Transaction, query};
use crate::encoding::{decode_hash, read_structure};
use crate::error::{Result, StoreError};
use crate::records::{CampaignRecord, Protocol, SeedStructure};

/// Priority of jobs added later than their candidate.
const LATE_PRIORITY: i32 = 0;

macro_rules! seed_structures {
    ($rest:literal) => {
        concat!(
            "SELECT ",
            joined!(seed_structure),
            ", ",
            joined!(structure),
            " FROM seed_structure JOIN structure ON structure.number = seed_structure.structure ",
            $rest
        )
    };
}

impl FromRow for SeedStructure {
    fn from_row(row: &SqlRow) -> Result<Self> {
        SEED_STRUCTURE.verify(row, Names::Joined)?;
        Ok(Self {
            index: row.get("seed_structure__seed")?,
            name: row.get("seed_structure__name")?,
            source: row.get("seed_structure__source")?,
            structure: read_structure(row)?,
        })
    }
}

impl Store {
    /// The properties of the campaign.
    pub async fn campaign(&self) -> Result<CampaignRecord> {
        let id = self.campaign_value("id").await?;
        Ok(CampaignRecord {
            id: id.parse().map_err(|error| StoreError::damaged("the campaign's id", error))?,
            program_version: self.campaign_value("program_version").await?,
            mode: self.campaign_value("mode").await?,
            configuration: self.campaign_value("configuration").await?,
            resolved_configuration: self.campaign_value("resolved_configuration").await?,
            configuration_in_force: self.campaign_value("configuration_in_force").await?,
        })
    }

    pub(super) async fn campaign_value(&self, key: &str) -> Result<String> {
        let found = query("SELECT * FROM campaign WHERE key = $1").bind(key).rows(&self.database).await?;
        let missing = || StoreError::damaged("the campaign", format!("it has no {key}"));
        let row = found.first().ok_or_else(missing)?;
        if CAMPAIGN_KEYS.contains(&key) {
            CAMPAIGN.verify(row, Names::Plain)?;
        }
        row.get("value")
    }

    /// Changes the configuration in force (JSON). Adds a line `configuration` to the operations log for each of the
    /// changes (JSON objects).
    pub async fn set_configuration_in_force(
        &self,
        configuration: &str,
        changes: &[serde_json::Value],
        now: i64,
    ) -> Result<()> {
        let mut transaction = self.database.begin_as_leader().await?;
        set_campaign_value(&mut transaction, "configuration_in_force", configuration).await?;
        for change in changes {
            insert_operation(&mut transaction, now, "configuration", change).await?;
        }
        transaction.commit().await
    }

    /// Metadata that the leader of the campaign stored under that name.
    pub async fn metadata(&self, name: &str) -> Result<Option<String>> {
        let note = query("SELECT value FROM campaign WHERE key = $1").bind(format!("note/{name}"));
        note.fetch_optional(&self.database).await
    }

    /// Metadata whose names begin with `prefix`: names and values.
    pub async fn metadata_below(&self, prefix: &str) -> Result<Vec<(String, String)>> {
        let sql =
            "SELECT substr(key, 6), value FROM campaign WHERE substr(key, 1, length($1)) = $1 ORDER BY key";
        query(sql).bind(format!("note/{prefix}")).fetch_all(&self.database).await
    }

    /// Stores metadata for other processes.
    pub async fn set_metadata(&self, name: &str, note: &str) -> Result<()> {
        if self.metadata(name).await?.as_deref() == Some(note) {
            return Ok(());
        }
        let mut transaction = self.database.begin_as_leader().await?;
        set_campaign_value(&mut transaction, &format!("note/{name}"), note).await?;
        transaction.commit().await
    }

    /// The protocol of new label jobs, if there is one.
    pub async fn protocol_in_force(&self) -> Result<Option<Protocol>> {
        let mut transaction = self.database.begin_read().await?;
        let Some(number) = in_force(&mut transaction).await? else { return Ok(None) };
        let row = query("SELECT * FROM protocol WHERE number = $1").bind(number);
        row.fetch_one(&mut transaction).await.map(Some)
    }

    /// Stores where the leader has the files that grades depend on: a JSON object of paths.
    pub async fn set_grade_files(&self, files: &serde_json::Value) -> Result<()> {
        let mut transaction = self.database.begin_as_leader().await?;
        set_campaign_value(&mut transaction, "grade_files", &files.to_string()).await?;
        transaction.commit().await
    }

    /// See [`Self::set_grade_files`]; null in campaigns of earlier versions.
    pub async fn grade_files(&self) -> Result<serde_json::Value> {
        let files = query("SELECT value FROM campaign WHERE key = 'grade_files'");
        let files: Option<String> = files.fetch_optional(&self.database).await?;
        let files = files.map(|files| serde_json::from_str(&files)).transpose();
        Ok(files.map_err(|error| StoreError::damaged("the campaign's files", error))?.unwrap_or_default())
    }

    /// Adds seed structures, or replaces those with the same index.
    pub async fn add_seed_structures(&self, seed_structures: &[SeedStructure]) -> Result<()> {
        let mut transaction = self.database.begin_as_leader().await?;
        for seed_structure in seed_structures {
            insert_seed_structure(&mut transaction, seed_structure).await?;
        }
        transaction.commit().await
    }

    /// Every seed structure, by index.
    pub async fn seed_structures(&self) -> Result<Vec<SeedStructure>> {
        query(seed_structures!("ORDER BY seed")).fetch_all(&self.database).await
    }

    /// The seed structure with that index.
    pub async fn seed_structure(&self, index: u32) -> Result<Option<SeedStructure>> {
        query(seed_structures!("WHERE seed = $1")).bind(index).fetch_optional(&self.database).await
    }

    /// Makes `protocol` the protocol of new label jobs. Accepted candidates without any job (found before there was
    /// a protocol) get one; existing jobs keep their protocol.
    pub async fn add_protocol(&self, protocol: &Protocol, now: i64) -> Result<()> {
        let mut transaction = self.database.begin_as_leader().await?;
        insert_protocol(&mut transaction, protocol, now).await?;
        set_campaign_value(&mut transaction, "protocol", &protocol.hash.to_string()).await?;
        let number = protocol_id(&mut transaction, protocol.hash).await?;
        let sql = "SELECT content, min(decision) FROM candidate WHERE structure IS NOT NULL
                   AND NOT EXISTS (SELECT 1 FROM job WHERE job.structure = candidate.structure)
                   GROUP BY content ORDER BY min(decision)";
        let late: Vec<(Vec<u8>, i64)> = query(sql).fetch_all(&mut transaction).await?;
        enqueue(&mut transaction, &late, number, LATE_PRIORITY).await?;
        transaction.commit().await
    }

    /// Adds a protocol that is not used for new labels.
    pub async fn register_protocol(&self, protocol: &Protocol, now: i64) -> Result<()> {
        let mut transaction = self.database.begin_as_leader().await?;
        insert_protocol(&mut transaction, protocol, now).await?;
        transaction.commit().await
    }

    /// Whether this is the protocol of new label jobs.
    pub async fn is_in_force(&self, protocol: ContentHash) -> Result<bool> {
        let hash = query("SELECT value FROM campaign WHERE key = 'protocol'");
        let hash: Option<String> = hash.fetch_optional(&self.database).await?;
        Ok(hash.is_some_and(|hash| hash == protocol.to_string()))
    }

    /// Every protocol, in the order in which they were added.
    pub async fn protocols(&self) -> Result<Vec<Protocol>> {
        query("SELECT * FROM protocol ORDER BY number").fetch_all(&self.database).await
    }
}

impl FromRow for Protocol {
    fn from_row(row: &SqlRow) -> Result<Self> {
        PROTOCOL.verify(row, Names::Plain)?;
        let (hash, settings): (Vec<u8>, String) = (row.get("hash")?, row.get("settings")?);
        let settings = serde_json::from_str(&settings);
        let settings = settings.map_err(|error| StoreError::damaged("a protocol", error))?;
        Ok(Self { hash: decode_hash(&hash)?, name: row.get("name")?, settings })
    }
}

/// Adds a protocol if it does not exist.
pub(super) async fn insert_protocol(
    transaction: &mut Transaction,
    protocol: &Protocol,
    now: i64,
) -> Result<()> {
    let sql = "INSERT INTO protocol (hash, name, settings, checksum) VALUES ($1, $2, $3, $4)
               ON CONFLICT (hash) DO NOTHING";
    let row = vec![protocol.hash.0[..].into(), (&protocol.name).into(), protocol.settings.to_string().into()];
    let insert = query(sql).bind_all(PROTOCOL.with_checksum(row));
    let added = insert.execute(&mut *transaction).await.map_err(|error| match error {
        StoreError::Database(sqlx::Error::Database(error)) if error.is_unique_violation() => {
            StoreError::ProtocolName(protocol.name.clone())
        }
        _ => error,
    })?;
    if added > 0 {
        let detail = serde_json::json!({ "name": protocol.name, "hash": protocol.hash.to_string() });
        insert_operation(transaction, now, "protocol", &detail).await?;
    }
    Ok(())
}

pub(super) async fn set_campaign_value(transaction: &mut Transaction, key: &str, value: &str) -> Result<()> {
    let sql = "INSERT INTO campaign (key, value, checksum) VALUES ($1, $2, $3)
               ON CONFLICT (key) DO UPDATE SET value = excluded.value, checksum = excluded.checksum";
    let mut row = vec![key.into(), value.into()];
    match CAMPAIGN_KEYS.contains(&key) {
        true => row = CAMPAIGN.with_checksum(row),
        false => row.push(SqlValue::Integer(None)),
    }
    query(sql).bind_all(row).execute(&mut *transaction).await?;
    Ok(())
}

pub(super) async fn insert_seed_structure(
    transaction: &mut Transaction,
    seed_structure: &SeedStructure,
) -> Result<()> {
    let structure = structure_id(
        transaction,
        &seed_structure.structure,
        ContentHash::from_structure(&seed_structure.structure),
    )
    .await?;
    let sql =
        "INSERT INTO seed_structure (seed, name, source, structure, checksum) VALUES ($1, $2, $3, $4, $5)
               ON CONFLICT (seed) DO UPDATE SET name = $2, source = $3, structure = $4, checksum = $5";
    let row = vec![
        seed_structure.index.into(),
        (&seed_structure.name).into(),
        (&seed_structure.source).into(),
        structure.into(),
    ];
    query(sql).bind_all(SEED_STRUCTURE.with_checksum(row)).execute(&mut *transaction).await?;
    Ok(())
}

/// Row number of the protocol of new jobs.
pub(super) async fn in_force(transaction: &mut Transaction) -> Result<Option<i64>> {
    let hash = query("SELECT value FROM campaign WHERE key = 'protocol'");
    let hash: Option<String> = hash.fetch_optional(&mut *transaction).await?;
    let Some(hash) = hash else { return Ok(None) };
    let hash = hash.parse().map_err(|error| StoreError::damaged("the protocol in force", error))?;
    protocol_id(transaction, hash).await.map(Some)
}

/// Row number of the protocol.
pub(crate) async fn protocol_id(transaction: &mut Transaction, hash: ContentHash) -> Result<i64> {
    let number = query("SELECT number FROM protocol WHERE hash = $1").bind(hash.0.to_vec());
    let number: Option<i64> = number.fetch_optional(&mut *transaction).await?;
    number.ok_or_else(|| StoreError::UnknownProtocol(hash.to_string()))
}
