//! Import of labelled structures.

use atoms::Structure;
use wire::ContentHash;

use super::labels::{add, check, finish_job};
use super::protocols;
use super::structures::structure_id;
use crate::Store;
use crate::checksum::IMPORT;
use crate::database::{Transaction, query};
use crate::encoding::{encode_vectors, integer};
use crate::error::Result;
use crate::jobs::{ImportCounts, LabelSource, LabelStatus};
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
            let sql = "INSERT INTO import (structure, file, frame, checksum) VALUES ($1, $2, $3, $4)
                       ON CONFLICT (structure) DO NOTHING";
            let row = vec![number.into(), file.into(), integer("frame", *frame)?.into()];
            query(sql).bind_all(IMPORT.with_checksum(row)).execute(&mut transaction).await?;
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
