//! Row checksums, by which every reader detects rows that differ from what was written.
//!
//! A checksum is a CRC-32 of a row's columns, each with type and length. It detects every single-bit flip and
//! misses other damage with probability 2⁻³². Disks and memory damage bytes by accident, so a cryptographic hash
//! would gain nothing and take several times as long.
//!
//! Columns that SQL changes in place (the status of a label, everything in the queue) have no checksum: `store
//! check` compares them with each other.

use crc32fast::Hasher;

use crate::database::row::{Index, SqlRow};
use crate::database::value::{ColumnType, SqlValue, replace_nul};
use crate::error::{Result, StoreError};

/// Stands for checksums of tables of an earlier version that are opened read-only, where they are missing or belong to
/// words of that version.
pub const UNKNOWN: i64 = -1;

/// A table with row checksums.
pub struct CheckedTable {
    /// Its name.
    pub name: &'static str,
    /// The column that names a row in messages.
    key: RowColumn,
    /// The columns covered by the checksum, in its order.
    columns: &'static [RowColumn],
    checksum: RowColumn,
}

/// A column, with its name in joins (`table__column`, see [`joined`]) and its type.
struct RowColumn {
    name: &'static str,
    joined: &'static str,
    kind: ColumnType,
}

/// The naming of the columns of a row.
#[derive(Clone, Copy)]
pub enum Names {
    /// The table's own names.
    Plain,
    /// `table__column`, one after the other as [`joined`] selects them.
    Joined,
}

macro_rules! checked {
    ($table:literal by $key:ident $key_kind:ident { $($column:ident: $kind:ident),* $(,)? }) => {
        CheckedTable {
            name: $table,
            key: checked!(@ $table, $key, $key_kind),
            columns: &[$(checked!(@ $table, $column, $kind)),*],
            checksum: checked!(@ $table, checksum, Integer),
        }
    };
    (@ $table:literal, $column:ident, $kind:ident) => {
        RowColumn {
            name: stringify!($column),
            joined: concat!($table, "__", stringify!($column)),
            kind: ColumnType::$kind,
        }
    };
}

/// The values of the selector.
pub static VALUE: CheckedTable = checked!("value" by name Text { name: Text, value: Text });

/// Values of the campaign. Those that SQL changes in place have no checksum.
pub static CAMPAIGN: CheckedTable = checked!("campaign" by key Text { key: Text, value: Text });

/// Structures.
pub static STRUCTURE: CheckedTable =
    checked!("structure" by number Integer { hash: Bytes, atoms: Integer, formula: Text, data: Bytes });

/// Seed structures.
pub static SEED_STRUCTURE: CheckedTable = checked!("seed_structure" by seed Integer {
    seed: Integer, name: Text, source: Text, structure: Integer,
});

/// Label protocols.
pub static PROTOCOL: CheckedTable =
    checked!("protocol" by name Text { hash: Bytes, name: Text, settings: Text });

/// Decisions.
pub static DECISION: CheckedTable = checked!("decision" by sequence Integer {
    sequence: Integer, round: Integer, kind: Text, walk: Integer, candidate: Text, mixture_version: Integer,
    detail: Text,
});

/// Candidates, without the number of their structure: the content hash identifies it.
pub static CANDIDATE: CheckedTable = checked!("candidate" by decision Integer {
    decision: Integer, id: Text, content: Bytes, walk: Integer, segment: Integer, step: Integer,
    seed_structure: Integer, origin: Text, fate: Text, reason: Text, mixture_version: Integer, atoms: Integer,
    formula: Text, temperature: Real, relative_volume: Real, energy: Real, walker_gamma: Real,
    walker_gamma_nbr: Real, walker_above: Integer, selector_gamma: Real, selector_gamma_nbr: Real,
    selector_above: Integer, original_gamma: Real, original_gamma_nbr: Real, original_above: Integer,
});

/// Components of the mixture.
pub static COMPONENT: CheckedTable =
    checked!("component" by element Integer { element: Integer, slot: Integer, bytes: Bytes });

/// Walks, without their checkpoints (see [`CHECKPOINT`]).
pub static WALK: CheckedTable = checked!("walk" by walk Integer {
    walk: Integer, origin: Text, partner: Integer, seed_structure: Integer, state: Text, reason: Text,
    assignments: Integer, accepted: Integer, step: Integer, segment: Integer, tau: Real, temperature: Real,
    relative_volume: Real, gamma_max: Real, rejected: Integer, rollbacks: Integer, selector_state: Text,
});

/// Conditions of walks, which have never been without checksums.
pub static WALK_CONDITIONS: CheckedTable =
    checked!("walk_conditions" by walk Integer { walk: Integer, conditions: Text });

/// Traces of walks.
pub static WALK_TRACE: CheckedTable =
    checked!("walk_trace" by walk Integer { walk: Integer, points: Integer, data: Bytes });

/// Assignments of walks. Its messages name the walk.
pub static ASSIGNMENT: CheckedTable = checked!("assignment" by walk Integer {
    walk: Integer, part: Integer, number: Integer, mixture_version: Integer, threshold_factor: Real, verdict: Text,
    start_segment: Integer, start_step: Integer, start_reference_step: Integer, segment: Integer, step: Integer,
    reference_step: Integer,
});

/// Trajectories of walks, in parts. Its messages name the walk.
pub static TRAJECTORY: CheckedTable = checked!("trajectory" by walk Integer {
    walk: Integer, part: Integer, frames: Integer, data: Bytes,
});

/// V₀ of walks at constant pressure.
pub static REFERENCE_VOLUME: CheckedTable =
    checked!("reference_volume" by walk Integer { walk: Integer, volume: Real });

/// Versions of the potential, which have never been without checksums. Their hashes cover their files.
pub static VERSION: CheckedTable = checked!("version" by number Integer {
    number: Integer, parent: Integer, state: Text, reason: Text, method: Text, structures: Integer,
    last_decision: Integer, labels: Integer, model_hash: Text, mixture_hash: Text, figures: Text, seconds: Real,
    core_hours: Real, time: Integer,
});

/// Labels, without their status and why it changed.
pub static LABEL: CheckedTable = checked!("label" by number Integer {
    structure: Integer, protocol: Integer, energy: Real, forces: Bytes, stress: Bytes, job: Integer,
    attempt: Integer, file: Text, frame: Integer, received: Integer, details: Text,
});

/// Imported structures.
pub static IMPORT: CheckedTable =
    checked!("import" by structure Integer { structure: Integer, file: Text, frame: Integer });

/// Packed work directories of calculations.
pub static ARCHIVE: CheckedTable =
    checked!("archive" by job Integer { job: Integer, attempt: Integer, bytes: Bytes, left_out: Text });

/// A long column with a checksum of its own, stored in another column. Under the row's checksum, every reader of
/// the short columns would have to read the long one as well.
pub struct CheckedColumn {
    /// Its name.
    name: &'static str,
    /// The column with the number of its row.
    key: &'static str,
    /// The column with its checksum.
    checksum: &'static str,
    what: &'static str,
}

/// Features of a candidate; their checksum is in the table `candidate`, like those of the grades.
pub static FEATURES: CheckedColumn = CheckedColumn {
    name: "features",
    key: "decision",
    checksum: "features_checksum",
    what: "the features of candidate",
};

/// Grades of the atoms of a candidate under the selector's mixture.
pub static SELECTOR_GRADES: CheckedColumn = CheckedColumn {
    name: "selector_grades",
    key: "decision",
    checksum: "selector_checksum",
    what: "the selector's grades of candidate",
};

/// The same under the original mixture.
pub static ORIGINAL_GRADES: CheckedColumn = CheckedColumn {
    name: "original_grades",
    key: "decision",
    checksum: "original_checksum",
    what: "the original grades of candidate",
};

/// The long columns of a candidate, in the order of its checksums.
pub static LONG_COLUMNS: [&CheckedColumn; 3] = [&FEATURES, &SELECTOR_GRADES, &ORIGINAL_GRADES];

/// The checkpoint of a walk.
pub static CHECKPOINT: CheckedColumn = CheckedColumn {
    name: "checkpoint",
    key: "walk",
    checksum: "checkpoint_checksum",
    what: "the checkpoint of walk",
};

/// The columns that a query with a join selects to verify a row of a table ([`Names::Joined`]).
macro_rules! joined {
    (candidate) => {
        "candidate.decision AS candidate__decision, candidate.id AS candidate__id, candidate.content AS candidate__content,
        candidate.walk AS candidate__walk, candidate.segment AS candidate__segment, candidate.step AS candidate__step,
        candidate.seed_structure AS candidate__seed_structure, candidate.origin AS candidate__origin,
        candidate.fate AS candidate__fate, candidate.reason AS candidate__reason,
        candidate.mixture_version AS candidate__mixture_version, candidate.atoms AS candidate__atoms,
        candidate.formula AS candidate__formula, candidate.temperature AS candidate__temperature,
        candidate.relative_volume AS candidate__relative_volume, candidate.energy AS candidate__energy,
        candidate.walker_gamma AS candidate__walker_gamma, candidate.walker_gamma_nbr AS candidate__walker_gamma_nbr,
        candidate.walker_above AS candidate__walker_above, candidate.selector_gamma AS candidate__selector_gamma,
        candidate.selector_gamma_nbr AS candidate__selector_gamma_nbr, candidate.selector_above AS candidate__selector_above,
        candidate.original_gamma AS candidate__original_gamma,
        candidate.original_gamma_nbr AS candidate__original_gamma_nbr, candidate.original_above AS candidate__original_above,
        candidate.checksum AS candidate__checksum"
    };
    (decision) => {
        "decision.sequence AS decision__sequence, decision.round AS decision__round, decision.kind AS decision__kind,
        decision.walk AS decision__walk, decision.candidate AS decision__candidate,
        decision.mixture_version AS decision__mixture_version, decision.detail AS decision__detail,
        decision.checksum AS decision__checksum"
    };
    (seed_structure) => {
        "seed_structure.seed AS seed_structure__seed, seed_structure.name AS seed_structure__name,
        seed_structure.source AS seed_structure__source, seed_structure.structure AS seed_structure__structure,
        seed_structure.checksum AS seed_structure__checksum"
    };
    (import) => {
        "import.structure AS import__structure, import.file AS import__file, import.frame AS import__frame,
        import.checksum AS import__checksum"
    };
    (walk) => {
        "walk.walk AS walk__walk, walk.origin AS walk__origin, walk.partner AS walk__partner,
        walk.seed_structure AS walk__seed_structure, walk.state AS walk__state, walk.reason AS walk__reason,
        walk.assignments AS walk__assignments, walk.accepted AS walk__accepted, walk.step AS walk__step,
        walk.segment AS walk__segment, walk.tau AS walk__tau, walk.temperature AS walk__temperature,
        walk.relative_volume AS walk__relative_volume, walk.gamma_max AS walk__gamma_max,
        walk.rejected AS walk__rejected, walk.rollbacks AS walk__rollbacks, walk.selector_state AS walk__selector_state,
        walk.checksum AS walk__checksum"
    };
    (structure) => {
        "structure.number AS structure__number, structure.hash AS structure__hash, structure.atoms AS structure__atoms,
        structure.formula AS structure__formula, structure.data AS structure__data,
        structure.checksum AS structure__checksum"
    };
}
pub(crate) use joined;

impl CheckedTable {
    /// The values of a row, followed by their checksum.
    pub fn with_checksum(&self, mut row: Vec<SqlValue>) -> Vec<SqlValue> {
        debug_assert_eq!(row.len(), self.columns.len(), "{}", self.name);
        row.push(checksum(&row).into());
        row
    }

    /// Computes the checksum of a row whose columns have these names.
    pub fn compute(&self, row: &SqlRow, names: Names) -> Result<i64> {
        let mut hasher = Hasher::new();
        match (names, self.columns.first()) {
            // Names are looked up once.
            (Names::Joined, Some(first)) => {
                let first = row.place(first.joined)?;
                let mut columns = self.columns.iter().zip(first..);
                columns.try_for_each(|(column, place)| add_column(&mut hasher, row, column.kind, place))?;
            }
            _ => {
                let mut columns = self.columns.iter();
                columns.try_for_each(|column| add_column(&mut hasher, row, column.kind, column.name))?;
            }
        }
        Ok(hasher.finalize().into())
    }

    /// The values that the checksum covers, in its order.
    pub fn values(&self, row: &SqlRow, names: Names) -> Result<Vec<SqlValue>> {
        self.columns.iter().map(|column| column.kind.read(row, column.called(names))).collect()
    }

    /// Names of the columns that the checksum covers, in its order.
    pub fn column_names(&self) -> impl Iterator<Item = &'static str> {
        self.columns.iter().map(|column| column.name)
    }

    /// The stored checksum of a row, or the computed one if it has none.
    pub fn stored_or_computed(&self, row: &SqlRow) -> Result<i64> {
        stored(row, self.checksum.name)?.map_or_else(|| self.compute(row, Names::Plain), Ok)
    }

    /// Whether a row has no checksum yet.
    pub fn lacks_checksum(&self, row: &SqlRow) -> Result<bool> {
        Ok(stored(row, self.checksum.name)?.is_none())
    }

    /// Verifies a row.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if the row differs from what was written.
    pub fn verify(&self, row: &SqlRow, names: Names) -> Result<()> {
        let found: Option<i64> = row.get(self.checksum.called(names))?;
        if found == Some(UNKNOWN) {
            return Ok(());
        }
        compare(found, self.compute(row, names)?, || {
            let key = self.key.kind.read(row, self.key.called(names));
            format!("{} {}", self.name.replace('_', " "), key.map_or_else(|_| "?".into(), |key| show(&key)))
        })
    }
}

impl RowColumn {
    fn called(&self, names: Names) -> &'static str {
        match names {
            Names::Plain => self.name,
            Names::Joined => self.joined,
        }
    }
}

impl CheckedColumn {
    /// Checksum of the column in the row with this number.
    pub fn checksum(number: i64, bytes: Option<&[u8]>) -> i64 {
        let mut hasher = Hasher::new();
        add(&mut hasher, &SqlValue::Integer(Some(number)));
        add_bytes(&mut hasher, bytes);
        hasher.finalize().into()
    }

    /// The stored checksum of the column in a row, or the computed one if there is none.
    pub fn stored_or_computed(&self, row: &SqlRow) -> Result<i64> {
        stored(row, self.checksum)?.map_or_else(|| self.compute(row), Ok)
    }

    /// Computes the checksum of the column in a row.
    pub fn compute(&self, row: &SqlRow) -> Result<i64> {
        Ok(Self::checksum(row.get(self.key)?, row.bytes(self.name)?))
    }

    /// Verifies the bytes of the column. The row must contain the number and the checksum.
    ///
    /// # Errors
    /// [`StoreError::Damaged`] if the bytes differ from what was written.
    pub fn verify(&self, row: &SqlRow) -> Result<()> {
        let found: Option<i64> = row.get(self.checksum)?;
        if found == Some(UNKNOWN) {
            return Ok(());
        }
        let number: i64 = row.get(self.key)?;
        compare(found, self.compute(row)?, || format!("{} {number}", self.what))
    }
}

/// A stored checksum, unless it is missing or marked as unknown.
fn stored(row: &SqlRow, name: &str) -> Result<Option<i64>> {
    Ok(row.get::<Option<i64>>(name)?.filter(|found| *found != UNKNOWN))
}

fn compare(found: Option<i64>, computed: i64, what: impl FnOnce() -> String) -> Result<()> {
    match found {
        Some(found) if found == computed => Ok(()),
        Some(found) => {
            let reason =
                format!("its content has the checksum {computed:08x}, and {found:08x} was stored with it");
            Err(StoreError::damaged(what(), reason))
        }
        None => Err(StoreError::damaged(what(), "its checksum is missing")),
    }
}

/// The checksum of values, in the form in which the store keeps it.
pub fn checksum(values: &[SqlValue]) -> i64 {
    let mut hasher = Hasher::new();
    values.iter().for_each(|value| add(&mut hasher, value));
    hasher.finalize().into()
}

fn add(hasher: &mut Hasher, value: &SqlValue) {
    match value {
        SqlValue::Integer(value) => add_integer(hasher, *value),
        SqlValue::Real(value) => add_real(hasher, *value),
        SqlValue::Text(text) => add_text(hasher, text.as_deref()),
        SqlValue::Bytes(bytes) => add_bytes(hasher, bytes.as_deref()),
    }
}

/// The same for the value of a column, in place.
fn add_column(hasher: &mut Hasher, row: &SqlRow, kind: ColumnType, index: impl Index) -> Result<()> {
    match kind {
        ColumnType::Integer => add_integer(hasher, row.get(index)?),
        ColumnType::Real => add_real(hasher, row.get(index)?),
        ColumnType::Text => add_text(hasher, row.text(index)?),
        ColumnType::Bytes => add_bytes(hasher, row.bytes(index)?),
    }
    Ok(())
}

fn add_integer(hasher: &mut Hasher, value: Option<i64>) {
    add_number(hasher, b'i', value.map(i64::to_le_bytes));
}

/// Databases drop the sign of zero.
fn add_real(hasher: &mut Hasher, value: Option<f64>) {
    let value = value.filter(|x| !x.is_nan()).map(|x| if x == 0.0 { 0.0 } else { x });
    add_number(hasher, b'r', value.map(f64::to_le_bytes));
}

fn add_number(hasher: &mut Hasher, kind: u8, bits: Option<[u8; 8]>) {
    let mut bytes = [0; 10];
    bytes[..2].copy_from_slice(&[kind, u8::from(bits.is_some())]);
    bytes[2..].copy_from_slice(&bits.unwrap_or_default());
    hasher.update(&bytes);
}

/// Databases drop NUL bytes in text.
fn add_text(hasher: &mut Hasher, text: Option<&str>) {
    match text {
        Some(text) if text.contains('\0') => {
            add_bytes(hasher, Some(replace_nul(text.to_owned()).as_bytes()));
        }
        text => add_bytes(hasher, text.map(str::as_bytes)),
    }
}

fn add_bytes(hasher: &mut Hasher, bytes: Option<&[u8]>) {
    hasher.update(&[b'b', u8::from(bytes.is_some())]);
    let bytes = bytes.unwrap_or_default();
    hasher.update(&(bytes.len() as u64).to_le_bytes());
    hasher.update(bytes);
}

fn show(value: &SqlValue) -> String {
    match value {
        SqlValue::Integer(value) => value.map_or_else(|| "?".into(), |value| value.to_string()),
        SqlValue::Text(value) => value.clone().unwrap_or_else(|| "?".into()),
        _ => "?".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What databases drop must not change the checksum; everything else must.
    #[test]
    fn values_that_read_back_equal_have_equal_checksums() {
        let of = |value: SqlValue| checksum(&[value]);
        assert_eq!(of(0.0.into()), of((-0.0).into()));
        assert_eq!(of(f64::NAN.into()), of(SqlValue::Real(None)));
        assert_eq!(of("a\0b".into()), of("a\u{fffd}b".into()));
        let values: [SqlValue; 10] = [
            0_i64.into(),
            1_i64.into(),
            0.0.into(),
            1.0.into(),
            "".into(),
            "a".into(),
            SqlValue::Integer(None),
            SqlValue::Real(None),
            SqlValue::Text(None),
            "ab".into(),
        ];
        for (k, value) in values.iter().enumerate() {
            assert!(values[..k].iter().all(|other| of(other.clone()) != of(value.clone())), "{value:?}");
        }
        assert_ne!(checksum(&["ab".into(), "c".into()]), checksum(&["a".into(), "bc".into()]));
    }

    #[test]
    fn joins_select_the_columns_of_the_table() {
        for (table, selected) in [
            (&CANDIDATE, joined!(candidate)),
            (&DECISION, joined!(decision)),
            (&IMPORT, joined!(import)),
            (&SEED_STRUCTURE, joined!(seed_structure)),
            (&STRUCTURE, joined!(structure)),
            (&WALK, joined!(walk)),
        ] {
            let words = |one: &str| one.split_whitespace().collect::<Vec<_>>().join(" ");
            let selected: Vec<_> = selected.split(',').map(words).collect();
            let wanted = |column: &RowColumn| format!("{}.{} AS {}", table.name, column.name, column.joined);
            assert!(selected.contains(&wanted(&table.key)), "{}", table.name);
            // In the order of the checksum, which follows.
            let columns: Vec<_> = table.columns.iter().chain([&table.checksum]).map(wanted).collect();
            assert!(selected.ends_with(&columns), "{columns:?}");
        }
    }
}
