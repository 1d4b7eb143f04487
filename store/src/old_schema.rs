//! Read-only access to tables of an earlier version: temporary views replace them, which have the columns of the
//! newest version.

use std::collections::BTreeMap;

use crate::checksum::UNKNOWN;

/// The first version whose rows have checksums.
pub const FIRST_WITH_CHECKSUMS: i64 = 9;
/// Renamed columns: the first version with the new name, the table, and the names before and now.
const RENAMED: [(i64, &str, &str, &str); 4] = [
    (15, "walk", "turn", "assignments"),
    (16, "walk", "refused", "rejected"),
    (16, "walk", "returns", "rollbacks"),
    (16, "label", "standing", "status"),
];

/// Tables without checksums before [`FIRST_WITH_CHECKSUMS`], with their checksum columns.
const CHECKSUMS: [(&str, &[&str]); 12] = [
    ("campaign", &["checksum"]),
    ("value", &["checksum"]),
    ("structure", &["checksum"]),
    ("seed_structure", &["checksum"]),
    ("protocol", &["checksum"]),
    ("decision", &["checksum"]),
    ("candidate", &["checksum", "features_checksum", "selector_checksum", "original_checksum"]),
    ("component", &["checksum"]),
    ("walk", &["checksum", "checkpoint_checksum"]),
    ("label", &["checksum"]),
    ("import", &["checksum"]),
    ("archive", &["checksum"]),
];

/// SQL that creates the views for tables of this version in `schema`, under the names of the tables; `None` if the
/// tables have all columns. Checksums that they lack are marked as unknown.
pub fn views(schema: &str, version: i64) -> Option<String> {
    let mut added = BTreeMap::<&str, Vec<String>>::new();
    if version < FIRST_WITH_CHECKSUMS {
        for (table, columns) in CHECKSUMS {
            let unknown = columns.iter().map(|name| format!("CAST({UNKNOWN} AS BIGINT) AS {name}"));
            added.entry(table).or_default().extend(unknown);
        }
    }
    for (_, table, before, now) in RENAMED.into_iter().filter(|(first, ..)| version < *first) {
        added.entry(table).or_default().push(format!("{before} AS {now}"));
    }
    let view = |(table, columns): (&&str, &Vec<String>)| {
        let columns = columns.join(", ");
        format!("CREATE TEMP VIEW \"{table}\" AS SELECT *, {columns} FROM \"{schema}\".\"{table}\"; ")
    };
    (!added.is_empty()).then(|| added.iter().map(view).collect())
}
