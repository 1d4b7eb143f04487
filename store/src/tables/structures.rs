//! Rows of structures.

use atoms::Structure;
use wire::ContentHash;

use crate::checksum;
use crate::database::{Transaction, query};
use crate::encoding::{encode_structure, integer};
use crate::error::Result;

/// Whether there is a label, excluded or not.
pub(crate) const CURRENT: &str = "SELECT EXISTS (SELECT 1 FROM label WHERE structure = $1 AND protocol = $2
    AND standing IN ('label', 'excluded'))";

/// Row number of the structure, which is inserted if it does not exist. Until the end of the transaction, no other
/// label or job is added for it.
pub(super) async fn structure_id(
    transaction: &mut Transaction,
    structure: &Structure,
    hash: ContentHash,
) -> Result<i64> {
    let sql = "INSERT INTO structure (hash, atoms, formula, data, checksum) VALUES ($1, $2, $3, $4, $5)
               ON CONFLICT (hash) DO UPDATE SET atoms = excluded.atoms RETURNING number";
    let row = vec![
        hash.0[..].into(),
        integer("count", structure.len() as u64)?.into(),
        structure.formula().into(),
        encode_structure(structure).into(),
    ];
    let insert = query(sql).bind_all(checksum::STRUCTURE.with_checksum(row));
    insert.fetch_one(&mut *transaction).await
}

/// Whether the structure has a label under the protocol, excluded or not.
pub(super) async fn has_label(transaction: &mut Transaction, structure: i64, protocol: i64) -> Result<bool> {
    query(CURRENT).bind(structure).bind(protocol).fetch_one(&mut *transaction).await
}
