//! Gives rows with checksums the present words, when a database of an earlier version is migrated. The migration itself
//! does so for rows without checksums.

use crate::checksum::{CANDIDATE, CheckedTable, DECISION, Names, WALK, checksum};
use crate::database::{SqlRow, SqlValue, Transaction, execute_rows, query};
use crate::error::Result;
use crate::old_schema::renamed_words;

/// Rows read at a time: the checkpoint of a large structure has megabytes.
const PAGE: u32 = 64;

/// A table with words that changed: how to read the rows that may have some, by pages, and how to write the changed
/// columns.
struct RenamedTable {
    table: &'static CheckedTable,
    key: &'static str,
    page: &'static str,
    /// The key, the columns with words in the order of the table, and the checksum.
    columns: &'static [&'static str],
    update: &'static str,
}

static TABLES: [RenamedTable; 3] = [
    RenamedTable {
        table: &DECISION,
        key: "sequence",
        page: "SELECT * FROM decision WHERE sequence > $1 AND kind IN ('declined', 'ended', 'segment')
            ORDER BY sequence LIMIT $2",
        columns: &["sequence", "detail", "checksum"],
        update: "UPDATE decision SET detail = new.detail, checksum = new.checksum FROM {rows}
            WHERE decision.sequence = new.sequence",
    },
    RenamedTable {
        table: &CANDIDATE,
        key: "decision",
        page: "SELECT * FROM candidate WHERE decision > $1 AND reason = 'guard' ORDER BY decision LIMIT $2",
        columns: &["decision", "reason", "checksum"],
        update: "UPDATE candidate SET reason = new.reason, checksum = new.checksum FROM {rows}
            WHERE candidate.decision = new.decision",
    },
    RenamedTable {
        table: &WALK,
        key: "walk",
        page: "SELECT * FROM walk WHERE walk > $1 ORDER BY walk LIMIT $2",
        columns: &["walk", "state", "selector_state", "checksum"],
        update:
            "UPDATE walk SET state = new.state, selector_state = new.selector_state, checksum = new.checksum
            FROM {rows} WHERE walk.walk = new.walk",
    },
];

/// Renames the words of every row with a checksum, and computes the new checksum. A damaged row stays as it is, so that
/// its readers still detect the damage.
pub(crate) async fn rename(transaction: &mut Transaction) -> Result<()> {
    for table in &TABLES {
        table.rename(transaction).await?;
    }
    Ok(())
}

impl RenamedTable {
    async fn rename(&self, transaction: &mut Transaction) -> Result<()> {
        // Walks are numbered from 0.
        let mut after = -1;
        loop {
            let page = query(self.page).bind(after).bind(PAGE).rows(&mut *transaction).await?;
            let Some(last) = page.last() else { return Ok(()) };
            after = last.get(self.key)?;
            let mut rows = Vec::new();
            for row in &page {
                rows.extend(self.renamed(row)?);
            }
            execute_rows(transaction, self.update, self.columns, rows).await?;
        }
    }

    /// The values of `columns` with the present words. `None` if the row has these words already, or is damaged.
    fn renamed(&self, row: &SqlRow) -> Result<Option<Vec<SqlValue>>> {
        if self.table.verify(row, Names::Plain).is_err() {
            return Ok(None);
        }
        let mut values = self.table.values(row, Names::Plain)?;
        let before = values.clone();
        let mut written = vec![row.get::<i64>(self.key)?.into()];
        for (name, value) in self.table.column_names().zip(&mut values) {
            let (Some(words), SqlValue::Text(Some(text))) =
                (renamed_words(self.table.name, name), &mut *value)
            else {
                continue;
            };
            *text = words.iter().fold(std::mem::take(text), |text, (before, now)| text.replace(before, now));
            written.push(value.clone());
        }
        written.push(checksum(&values).into());
        Ok((values != before).then_some(written))
    }
}
