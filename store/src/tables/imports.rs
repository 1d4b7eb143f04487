//! Labelled structures that exist already.

use atoms::Structure;
use wire::ContentHash;

use super::commit::structure_number;
use super::labels::{add, check, finish_job};
use super::protocols;
use crate::Store;
use crate::checksum::IMPORT;
use crate::database::{Transaction, query};
use crate::encoding::{encode_vectors, integer};
use crate::error::Result;
use crate::jobs::{Imported, LabelSource, Standing};
use crate::records::Label;

impl Store {
    /// Takes in frames of `file` that are labelled by `protocol` (see [`Store::add_protocol`]), each with its number
    /// in the file. Numbers that are there already are left as they are, so an import can be repeated; other numbers
    /// for a structure that has a label become checks. A job that waits for one of the labels is done. All frames or none.
    pub async fn import(
        &self,
        protocol: ContentHash,
        file: &str,
        frames: &[(u64, Structure, Label)],
        now: i64,
    ) -> Result<Imported> {
        let mut transaction = self.database.begin().await?;
        let protocol = protocols::number(&mut transaction, protocol).await?;
        let mut imported = Imported::default();
        for (frame, structure, label) in frames {
            let number =
                structure_number(&mut transaction, structure, ContentHash::from_structure(structure)).await?;
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
                Standing::Label => imported.labels += 1,
                _ => imported.checks += 1,
            }
            finish_job(&mut transaction, number, protocol, now).await?;
        }
        transaction.commit().await?;
        Ok(imported)
    }
}

/// Whether the very same numbers are there, as label, check or superseded.
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
