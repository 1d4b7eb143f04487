//! Import of structures, with labels or for labelling.

use std::collections::BTreeMap;

use atoms::Structure;
use serde_json::json;
use wire::ContentHash;

use super::labels::{add, check, finish_job};
use super::logs::insert_operation;
use super::new_jobs::insert_jobs;
use super::protocols;
use super::structures::{has_label, structure_id};
use crate::Store;
use crate::checksum::IMPORT;
use crate::database::{Transaction, query};
use crate::encoding::{encode_vectors, integer};
use crate::error::{Result, StoreError};
use crate::jobs::{ImportCounts, LabelSource, LabelStatus, QueuedImports};
use crate::records::Label;

impl Store {
    /// Imports frames of `file` labelled under `protocol` (see [`Store::add_protocol`]), each with its index in the
    /// file. An import can be repeated: identical results stay as they are. Different results for a structure with
    /// a label become checks. Jobs that wait for one of the labels are done. All frames are imported, or none.
    pub async fn import(
        &self,
        protocol: ContentHash,
        file: &str,
        frames: &[(u64, Structure, Label)],
        now: i64,
    ) -> Result<ImportCounts> {
        let mut transaction = self.database.begin().await?;
        let protocol = protocols::protocol_id(&mut transaction, protocol).await?;
        let mut imported = ImportCounts::default();
        for (frame, structure, label) in frames {
            let number =
                structure_id(&mut transaction, structure, ContentHash::from_structure(structure)).await?;
            check(&mut transaction, number, label).await?;
            import_number(&mut transaction, number, file, *frame).await?;
            if is_known(&mut transaction, number, protocol, label).await? {
                imported.known += 1;
                continue;
            }
            let source = LabelSource::Import { file: file.to_owned(), frame: *frame };
            match add(&mut transaction, number, protocol, label, &source, now).await? {
                LabelStatus::Label => imported.labels += 1,
                _ => imported.checks += 1,
            }
            finish_job(&mut transaction, number, protocol, now).await?;
        }
        transaction.commit().await?;
        Ok(imported)
    }
}

/// The number in the queue of an imported structure is this plus the import's number: behind all decisions.
pub(crate) const FIRST_IMPORT: i64 = 1 << 40;

impl Store {
    /// Queues structures for labelling under the protocol in force, each with its file and its index there. Structures that have a
    /// label under it or a label job stay as they are, so a repeated call changes nothing. All of them are queued, or none. Adds a
    /// line `import` to the operations log.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] in a campaign without a protocol.
    pub async fn queue_imports(
        &self,
        structures: &[(String, u64, Structure)],
        priority: i32,
        now: i64,
    ) -> Result<QueuedImports> {
        let mut transaction = self.database.begin().await?;
        let none = || StoreError::damaged("the campaign", "it has no label protocol");
        let protocol = protocols::in_force(&mut transaction).await?.ok_or_else(none)?;
        let mut queued = QueuedImports::default();
        let mut files: BTreeMap<&str, u64> = BTreeMap::new();
        for (file, frame, structure) in structures {
            let hash = ContentHash::from_structure(structure);
            let number = structure_id(&mut transaction, structure, hash).await?;
            let sql = "SELECT EXISTS (SELECT 1 FROM job WHERE structure = $1)";
            let has_job: bool = query(sql).bind(number).fetch_one(&mut transaction).await?;
            if has_job || has_label(&mut transaction, number, protocol).await? {
                queued.known += 1;
                continue;
            }
            let import = import_number(&mut transaction, number, file, *frame).await?;
            let decision = FIRST_IMPORT + import;
            let job = vec![hash.0[..].into(), protocol.into(), decision.into(), priority.into()];
            insert_jobs(&mut transaction, vec![job]).await?;
            *files.entry(file.as_str()).or_default() += 1;
            queued.queued += 1;
        }
        if queued.queued > 0 {
            let detail = json!({ "queued": queued.queued, "known": queued.known, "priority": priority, "files": files });
            insert_operation(&mut transaction, now, "import", &detail).await?;
        }
        transaction.commit().await?;
        Ok(queued)
    }
}

/// Number of the import of a structure, which is added if it does not exist.
async fn import_number(transaction: &mut Transaction, structure: i64, file: &str, frame: u64) -> Result<i64> {
    let sql = "INSERT INTO import (structure, file, frame, checksum) VALUES ($1, $2, $3, $4)
               ON CONFLICT (structure) DO NOTHING";
    let row = vec![structure.into(), file.into(), integer("frame", frame)?.into()];
    query(sql).bind_all(IMPORT.with_checksum(row)).execute(&mut *transaction).await?;
    query("SELECT number FROM import WHERE structure = $1").bind(structure).fetch_one(&mut *transaction).await
}

/// Whether identical results are stored already, as label, check or superseded label.
async fn is_known(
    transaction: &mut Transaction,
    structure: i64,
    protocol: i64,
    label: &Label,
) -> Result<bool> {
    let sql = "SELECT EXISTS (SELECT 1 FROM label WHERE structure = $1 AND protocol = $2 AND energy = $3
                              AND forces = $4 AND stress IS NOT DISTINCT FROM $5)";
    let query = query(sql)
        .bind(structure)
        .bind(protocol)
        .bind(label.energy)
        .bind(encode_vectors(&label.forces))
        .bind(label.stress.map(|stress| encode_vectors(&stress)));
    query.fetch_one(&mut *transaction).await
}
