//! Rows of structures.

use atoms::Structure;
use wire::ContentHash;

use crate::checksum;
use crate::database::{Transaction, query};
use crate::encoding::{encode_structure, integer};
use crate::error::Result;

/// Whether there is a label, excluded or not.
pub(crate) const CURRENT: &str = "SELECT EXISTS (SELECT 1 FROM label WHERE structure = $1 AND protocol = $2
    AND status IN ('label', 'excluded'))";

/// Name of the first candidate with a structure, or `import-N`.
const NAME: &str =
    "SELECT coalesce((SELECT id FROM candidate WHERE candidate.structure = $1 ORDER BY decision LIMIT 1),
    (SELECT 'import-' || CAST(import.number AS TEXT) FROM import WHERE import.structure = $1), '')";

/// The name of a structure for the user: its first candidate, or `import-N`.
pub(super) async fn name(transaction: &mut Transaction, structure: i64) -> Result<String> {
    query(NAME).bind(structure).fetch_one(&mut *transaction).await
}

/// Locks structures in a fixed order, so that two transactions do not deadlock: until the end of this one, no other label or
/// job is added for them.
pub(super) async fn lock(transaction: &mut Transaction, structures: impl Iterator<Item = i64>) -> Result<()> {
    let mut structures: Vec<_> = structures.collect();
    structures.sort_unstable();
    for structure in structures {
        let sql = "SELECT atoms FROM structure WHERE number = $1";
        let _: Option<i64> = query(sql).bind(structure).locked().fetch_optional(&mut *transaction).await?;
    }
    Ok(())
}

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
