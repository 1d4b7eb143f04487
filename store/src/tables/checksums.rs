//! Computes missing checksums, and verifies every row of tables that no other check reads.

use super::{assignments, trajectory};
use crate::checksum::{
    ARCHIVE, CAMPAIGN, CANDIDATE, CHECKPOINT, COMPONENT, CheckedColumn, CheckedTable, DECISION, IMPORT,
    LABEL, LONG_COLUMNS, Names, PROTOCOL, SEED_STRUCTURE, STRUCTURE, VALUE, WALK, WALK_CONDITIONS,
    WALK_TRACE,
};
use crate::database::{SqlRow, SqlValue, Transaction, execute_rows, query};
use crate::error::Result;

/// Rows read at a time: a row of a large structure has megabytes.
const PAGE: u32 = 64;

/// Keys of campaign values that change rarely and only through this program.
pub(crate) const CAMPAIGN_KEYS: [&str; 7] = [
    "id",
    "program_version",
    "mode",
    "configuration",
    "resolved_configuration",
    "configuration_in_force",
    "protocol",
];

const CAMPAIGN_VALUE: &str = "SELECT * FROM campaign WHERE key = $1";
const SET_CAMPAIGN: &str = "UPDATE campaign SET checksum = $1 WHERE key = $2";
const VALUES: &str = "SELECT * FROM value ORDER BY name";
const SET_VALUE: &str = "UPDATE value SET checksum = $1 WHERE name = $2";
/// These tables have a key of two numbers and are read one row at a time.
const NEXT_COMPONENT: &str =
    "SELECT * FROM component WHERE (element, slot) > ($1, $2) ORDER BY element, slot LIMIT 1";
const SET_COMPONENT: &str = "UPDATE component SET checksum = $1 WHERE element = $2 AND slot = $3";
pub(crate) const NEXT_ARCHIVE: &str =
    "SELECT * FROM archive WHERE (job, attempt) > ($1, $2) ORDER BY job, attempt LIMIT 1";
const SET_ARCHIVE: &str = "UPDATE archive SET checksum = $1 WHERE job = $2 AND attempt = $3";

/// A table with a key of one number: how to read its pages and set its checksums.
struct Paged {
    table: &'static CheckedTable,
    key: &'static str,
    columns: &'static [&'static str],
    page: &'static str,
    update: &'static str,
}

macro_rules! paged {
    ($table:ident, $name:literal, $key:literal) => {
        Paged {
            table: &$table,
            key: $key,
            columns: &[$key, "checksum"],
            page: concat!("SELECT * FROM ", $name, " WHERE ", $key, " > $1 ORDER BY ", $key, " LIMIT $2"),
            update: concat!(
                "UPDATE ",
                $name,
                " SET checksum = new.checksum FROM {rows} WHERE ",
                $name,
                ".",
                $key,
                " = new.",
                $key
            ),
        }
    };
}

static STRUCTURES: Paged = paged!(STRUCTURE, "structure", "number");
static SEED_STRUCTURES: Paged = paged!(SEED_STRUCTURE, "seed_structure", "seed");
static PROTOCOLS: Paged = paged!(PROTOCOL, "protocol", "number");
static DECISIONS: Paged = paged!(DECISION, "decision", "sequence");
static LABELS: Paged = paged!(LABEL, "label", "number");
static IMPORTS: Paged = paged!(IMPORT, "import", "number");
static WALKS: Paged = Paged {
    columns: &["walk", "checksum", "checkpoint_checksum"],
    update:
        "UPDATE walk SET checksum = new.checksum, checkpoint_checksum = new.checkpoint_checksum FROM {rows}
        WHERE walk.walk = new.walk",
    ..paged!(WALK, "walk", "walk")
};
static CONDITIONS: Paged = paged!(WALK_CONDITIONS, "walk_conditions", "walk");
static TRACES: Paged = paged!(WALK_TRACE, "walk_trace", "walk");
static CANDIDATES: Paged = Paged {
    columns: &["decision", "checksum", "features_checksum", "selector_checksum", "original_checksum"],
    page: "SELECT candidate.*, features, selector_grades, original_grades
        FROM candidate LEFT JOIN candidate_data ON candidate_data.decision = candidate.decision
        WHERE candidate.decision > $1 ORDER BY candidate.decision LIMIT $2",
    update: "UPDATE candidate SET checksum = new.checksum, features_checksum = new.features_checksum,
            selector_checksum = new.selector_checksum, original_checksum = new.original_checksum
        FROM {rows} WHERE candidate.decision = new.decision",
    ..paged!(CANDIDATE, "candidate", "decision")
};

impl Paged {
    async fn fill(&self, transaction: &mut Transaction, long: &[&CheckedColumn]) -> Result<()> {
        // Seed structures and walks are numbered from 0.
        let mut after = -1;
        loop {
            let page = query(self.page).bind(after).bind(PAGE).rows(&mut *transaction).await?;
            let Some(last) = page.last() else { return Ok(()) };
            after = last.get(self.key)?;
            let mut rows = Vec::new();
            for row in &page {
                if self.table.lacks_checksum(row)? {
                    rows.push(self.checksums(row, long)?);
                }
            }
            execute_rows(transaction, self.update, self.columns, rows).await?;
        }
    }

    /// Key of the row, and its checksums.
    fn checksums(&self, row: &SqlRow, long: &[&CheckedColumn]) -> Result<Vec<SqlValue>> {
        let mut values: Vec<SqlValue> =
            vec![row.get::<i64>(self.key)?.into(), self.table.stored_or_computed(row)?.into()];
        for column in long {
            values.push(column.stored_or_computed(row)?.into());
        }
        Ok(values)
    }

    async fn verify(
        &self,
        transaction: &mut Transaction,
        long: &[&CheckedColumn],
        faults: &mut Vec<String>,
    ) -> Result<()> {
        let mut after = -1;
        loop {
            let page = query(self.page).bind(after).bind(PAGE).rows(&mut *transaction).await?;
            let Some(last) = page.last() else { return Ok(()) };
            after = last.get(self.key)?;
            for row in &page {
                collect_fault(self.table.verify(row, Names::Plain), faults);
                long.iter().for_each(|column| collect_fault(column.verify(row), faults));
            }
        }
    }
}

fn collect_fault(verified: Result<()>, faults: &mut Vec<String>) {
    faults.extend(verified.err().map(|error| error.to_string()));
}

/// Computes the missing checksums from what is stored.
pub(crate) async fn fill(transaction: &mut Transaction) -> Result<()> {
    for paged in [&STRUCTURES, &SEED_STRUCTURES, &PROTOCOLS, &DECISIONS, &LABELS, &IMPORTS] {
        paged.fill(transaction, &[]).await?;
    }
    WALKS.fill(transaction, &[&CHECKPOINT]).await?;
    CANDIDATES.fill(transaction, &LONG_COLUMNS).await?;
    for key in CAMPAIGN_KEYS {
        for row in query(CAMPAIGN_VALUE).bind(key).rows(&mut *transaction).await? {
            let checksum = CAMPAIGN.stored_or_computed(&row)?;
            query(SET_CAMPAIGN).bind(checksum).bind(key).execute(&mut *transaction).await?;
        }
    }
    for row in query(VALUES).rows(&mut *transaction).await? {
        let (checksum, name) = (VALUE.stored_or_computed(&row)?, row.get::<String>("name")?);
        query(SET_VALUE).bind(checksum).bind(name).execute(&mut *transaction).await?;
    }
    let mut last = (-1, -1);
    while let Some((row, key)) = next(transaction, NEXT_COMPONENT, ["element", "slot"], last).await? {
        let set = query(SET_COMPONENT).bind(COMPONENT.stored_or_computed(&row)?);
        set.bind(key.0).bind(key.1).execute(&mut *transaction).await?;
        last = key;
    }
    let mut last = (-1, -1);
    while let Some((row, key)) = next(transaction, NEXT_ARCHIVE, ["job", "attempt"], last).await? {
        let set = query(SET_ARCHIVE).bind(ARCHIVE.stored_or_computed(&row)?);
        set.bind(key.0).bind(key.1).execute(&mut *transaction).await?;
        last = key;
    }
    Ok(())
}

/// The next row of a table with a key of two numbers, and its key.
async fn next(
    transaction: &mut Transaction,
    sql: &'static str,
    [first, second]: [&str; 2],
    after: (i64, i64),
) -> Result<Option<(SqlRow, (i64, i64))>> {
    let found = query(sql).bind(after.0).bind(after.1).rows(transaction).await?;
    let Some(row) = found.into_iter().next() else { return Ok(None) };
    let key = (row.get(first)?, row.get(second)?);
    Ok(Some((row, key)))
}

/// Verifies rows that no other check reads: campaign values, seed structures, walks and their
/// traces, assignments and trajectories, imports, the selector's values
/// and the mixture. Returns the faults.
pub(crate) async fn verify_others(transaction: &mut Transaction) -> Result<Vec<String>> {
    let mut faults = Vec::new();
    for paged in [&CONDITIONS, &TRACES] {
        if transaction.has_table(paged.table.name).await? {
            paged.verify(transaction, &[], &mut faults).await?;
        }
    }
    for paged in [&SEED_STRUCTURES, &IMPORTS] {
        paged.verify(transaction, &[], &mut faults).await?;
    }
    WALKS.verify(transaction, &[&CHECKPOINT], &mut faults).await?;
    for key in CAMPAIGN_KEYS {
        for row in query(CAMPAIGN_VALUE).bind(key).rows(&mut *transaction).await? {
            collect_fault(CAMPAIGN.verify(&row, Names::Plain), &mut faults);
        }
    }
    for row in query(VALUES).rows(&mut *transaction).await? {
        collect_fault(VALUE.verify(&row, Names::Plain), &mut faults);
    }
    let mut last = (-1, -1);
    while let Some((row, key)) = next(transaction, NEXT_COMPONENT, ["element", "slot"], last).await? {
        collect_fault(COMPONENT.verify(&row, Names::Plain), &mut faults);
        last = key;
    }
    faults.extend(assignments::verify(transaction).await?);
    faults.extend(trajectory::verify(transaction).await?);
    Ok(faults)
}
