//! Checks that an export relies on: no row is missing. The export itself would not notice.

use std::collections::{BTreeSet, HashSet};

use super::{Finding, own_check_of, rules};
use crate::Store;
use crate::database::{Transaction, query};
use crate::error::{Result, StoreError};
use crate::export::{ExportCursor, ExportFilter};
use crate::tables::protocols;

/// Rows read at a time.
const PAGE: u32 = 4096;

/// Every label of a protocol, in table order and without an index.
const LABELLED: &str = "SELECT number, structure FROM label NOT INDEXED
    WHERE number > $1 AND protocol = $2 AND status = 'label' ORDER BY number LIMIT $3";

const DROPPED: &str = "SELECT structure FROM job NOT INDEXED WHERE protocol = $1 AND state = 'dropped'";

/// Uses the index of structures, while an export uses the table.
pub(crate) const CANDIDATES: &str = "SELECT structure, decision, origin FROM candidate
    WHERE (structure, decision) > ($1, $2) AND structure IS NOT NULL ORDER BY structure, decision LIMIT $3";

const IMPORTS: &str = "SELECT number, structure FROM import ORDER BY structure";

impl Store {
    /// Checks that no row is missing in the tables that [`Self::labelled`] reads: in SQLite, that tables and
    /// indexes agree; in both databases, that rows agree with their counts and with each other.
    ///
    /// # Errors
    /// [`StoreError::Damaged`], which names the first finding.
    pub async fn check_for_export(&self) -> Result<()> {
        let mut transaction = self.database.begin_read().await?;
        let mut findings = own_check_of(&mut transaction, &TABLES).await?;
        if findings.is_empty() {
            findings = rules::losses(&mut transaction).await?;
        }
        transaction.commit().await?;
        let Some(Finding { what, .. }) = findings.first() else { return Ok(()) };
        let others = match findings.len() - 1 {
            0 => "structures or labels would be missing in an export".to_owned(),
            n => format!("structures or labels would be missing in an export (and {n} other findings)"),
        };
        Err(StoreError::damaged(what, others))
    }

    /// Positions of all rows that [`Self::labelled`] should find, determined in another way: labels and candidates
    /// are read separately and without the indexes that it uses.
    pub async fn labelled_cursors(&self, filter: &ExportFilter) -> Result<BTreeSet<ExportCursor>> {
        let mut transaction = self.database.begin_read().await?;
        let protocol = protocols::protocol_id(&mut transaction, filter.protocol).await?;
        let labelled = labelled(&mut transaction, protocol).await?;
        let dropped: Vec<i64> = query(DROPPED).bind(protocol).fetch_all(&mut transaction).await?;
        let dropped: HashSet<_> = dropped.into_iter().collect();
        let (mut places, mut of_candidates, mut after) = (BTreeSet::new(), HashSet::new(), (0, 0));
        loop {
            let page = query(CANDIDATES).bind(after.0).bind(after.1).bind(PAGE);
            let page: Vec<(i64, i64, String)> = page.fetch_all(&mut transaction).await?;
            let Some(last) = page.last() else { break };
            after = (last.0, last.1);
            for (structure, decision, origin) in page {
                of_candidates.insert(structure);
                let wanted = if origin == "biased" { filter.biased } else { filter.control };
                if wanted && labelled.contains(&structure) && !dropped.contains(&structure) {
                    places.insert(ExportCursor::Candidate(decision));
                }
            }
        }
        if filter.imported {
            let imports: Vec<(i64, i64)> = query(IMPORTS).fetch_all(&mut transaction).await?;
            let only = |structure: &i64| {
                labelled.contains(structure)
                    && !of_candidates.contains(structure)
                    && !dropped.contains(structure)
            };
            let imports = imports.into_iter().filter(|(_, structure)| only(structure));
            places.extend(imports.map(|(number, _)| ExportCursor::Import(number)));
        }
        transaction.commit().await?;
        Ok(places)
    }
}

/// The tables that an export reads, for SQLite's own check. Indexes of the many candidates that an export does not
/// use are left out: it reads the table, and rows that exist only in the index of structures are detected as
/// missing. Rows of `candidate_data` are long and have checksums: each is looked up, and detected if missing.
const TABLES: [&str; 9] = [
    "PRAGMA quick_check(candidate)",
    "PRAGMA integrity_check(candidate_count)",
    "PRAGMA integrity_check(decision)",
    "PRAGMA integrity_check(import)",
    "PRAGMA integrity_check(job)",
    "PRAGMA integrity_check(label)",
    "PRAGMA integrity_check(protocol)",
    "PRAGMA integrity_check(seed_structure)",
    "PRAGMA integrity_check(structure)",
];

/// Structures with a label under this protocol.
async fn labelled(transaction: &mut Transaction, protocol: i64) -> Result<HashSet<i64>> {
    let (mut labelled, mut after) = (HashSet::new(), 0);
    loop {
        let page = query(LABELLED).bind(after).bind(protocol).bind(PAGE);
        let page: Vec<(i64, i64)> = page.fetch_all(&mut *transaction).await?;
        let Some((last, _)) = page.last() else { return Ok(labelled) };
        after = *last;
        labelled.extend(page.into_iter().map(|(_, structure)| structure));
    }
}
