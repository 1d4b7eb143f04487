//! Read-only access to tables of an earlier version: temporary views replace them, which have the columns and words of
//! the newest version.

use std::collections::BTreeMap;

use crate::checksum::UNKNOWN;

/// The first version whose rows have checksums.
pub const FIRST_WITH_CHECKSUMS: i64 = 9;
/// The first version with the present words ([`WORDS`]).
pub const FIRST_WITH_PRESENT_WORDS: i64 = 16;

/// Tables without checksums before [`FIRST_WITH_CHECKSUMS`], with their checksum columns.
static CHECKSUMS: [(&str, &[&str]); 12] = [
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

/// Renamed columns: the first version with the new name, the table, and the names before and now.
static RENAMED: [(i64, &str, &str, &str); 4] = [
    (15, "walk", "turn", "assignments"),
    (16, "walk", "refused", "rejected"),
    (16, "walk", "returns", "rollbacks"),
    (16, "label", "standing", "status"),
];

/// Columns that later versions add and that queries name: the first version with the column, its table, and what stands for it
/// before.
static ADDED: [(i64, &str, &str); 2] = [
    (18, "job", "CAST(NULL AS DOUBLE PRECISION) AS value"),
    (18, "job", "CAST(NULL AS TEXT) AS value_factors"),
];

/// Parts of texts before and now.
type Replacements = &'static [(&'static str, &'static str)];

/// Words that [`FIRST_WITH_PRESENT_WORDS`] renames: table, column, and the parts of its texts. The columns hold words of a
/// fixed list, or JSON, in whose strings every quote has a backslash, so the parts occur nowhere else.
static WORDS: [(&str, &str, Replacements); 6] = [
    (
        "decision",
        "detail",
        &[
            (r#""reason":"guard""#, r#""reason":"too_close""#),
            (r#""end":"steps""#, r#""end":"completed""#),
            (r#""end":"collected""#, r#""end":"quota_reached""#),
            (r#""end":"blew_up""#, r#""end":"diverged""#),
            (r#""end":"bad_start""#, r#""end":"invalid_start""#),
            (r#""returns":"#, r#""rollbacks":"#),
        ],
    ),
    ("candidate", "reason", &[("guard", "too_close")]),
    ("candidate_count", "fate", &[("guard", "too_close")]),
    (
        "walk",
        "state",
        &[
            ("steps", "completed"),
            ("collected", "quota_reached"),
            ("blew_up", "diverged"),
            ("bad_start", "invalid_start"),
        ],
    ),
    ("walk", "selector_state", &[(r#""declined":"guard""#, r#""declined":"too_close""#)]),
    ("attempt", "class", &[("lost_node", "node_failure"), ("refused", "rejected_by_label_guard")]),
];

/// The words of a column that changed, if there are any.
pub fn renamed_words(table: &str, column: &str) -> Option<Replacements> {
    WORDS.iter().find(|(t, c, _)| (*t, *c) == (table, column)).map(|(.., words)| *words)
}

/// SQL that creates the views for tables of this version in `schema`, under the names of the tables; `None` if the
/// tables are those of the newest version. `columns` has the name of each table with each of its columns. Missing
/// checksums, and those of rows whose words changed, are marked as unknown.
pub fn views(schema: &str, version: i64, columns: &[(String, String)]) -> Option<String> {
    let mut tables = BTreeMap::<&str, Vec<&str>>::new();
    for (table, column) in columns {
        tables.entry(table).or_default().push(column);
    }
    let views = tables.iter().filter_map(|(table, columns)| view(schema, version, table, columns));
    Some(views.collect::<String>()).filter(|views| !views.is_empty())
}

/// The view that replaces a table; `None` if the table has not changed since.
fn view(schema: &str, version: i64, table: &str, columns: &[&str]) -> Option<String> {
    let mut changes = false;
    let mut shown: Vec<_> = columns
        .iter()
        .map(|column| {
            let present = present_column(version, table, column);
            changes |= present.is_some();
            present.unwrap_or_else(|| format!("\"{column}\""))
        })
        .collect();
    if version < FIRST_WITH_CHECKSUMS {
        let missing = CHECKSUMS.iter().filter(|(name, _)| *name == table).flat_map(|(_, names)| *names);
        shown.extend(missing.map(|name| format!("CAST({UNKNOWN} AS BIGINT) AS {name}")));
    }
    let added = ADDED.iter().filter(|(first, name, _)| version < *first && *name == table);
    shown.extend(added.map(|(.., before)| (*before).to_owned()));
    let columns_now = shown.join(", ");
    (changes || shown.len() > columns.len()).then(|| {
        format!("CREATE TEMP VIEW \"{table}\" AS SELECT {columns_now} FROM \"{schema}\".\"{table}\"; ")
    })
}

/// What stands in place of a column of that version; `None` for the column itself.
fn present_column(version: i64, table: &str, column: &str) -> Option<String> {
    let renamed =
        RENAMED.iter().find(|(first, t, before, _)| version < *first && (*t, *before) == (table, column));
    if let Some((.., now)) = renamed {
        return Some(format!("{column} AS {now}"));
    }
    if version >= FIRST_WITH_PRESENT_WORDS {
        return None;
    }
    if let Some(words) = renamed_words(table, column) {
        return Some(format!("{} AS {column}", replaced(column, words)));
    }
    let words = WORDS.iter().filter(|(name, ..)| *name == table && column == "checksum");
    let changed: Vec<_> =
        words.map(|&(_, name, words)| format!("{} <> {name}", replaced(name, words))).collect();
    let changed = Some(changed.join(" OR ")).filter(|changed| !changed.is_empty())?;
    Some(format!("CASE WHEN {changed} THEN CAST({UNKNOWN} AS BIGINT) ELSE checksum END AS checksum"))
}

/// The text of a column with the present words, in SQL.
fn replaced(column: &str, words: Replacements) -> String {
    words
        .iter()
        .fold(column.to_owned(), |text, (before, now)| format!("replace({text}, '{before}', '{now}')"))
}
