//! The columns of the atom lines, as `Properties` describes them.

use std::collections::{BTreeMap, BTreeSet};

use super::error::{ExtxyzErrorKind, excerpt};
use super::value::logical;
use super::{Column, ColumnData};
use crate::cell::Vec3;
use crate::species::{Species, UnknownSpecies};

/// The atoms of a frame while it is read.
pub(super) struct AtomTable {
    columns: Vec<TableColumn>,
    /// Fields per line.
    width: usize,
    /// Whether more fields are an error.
    exact: bool,
    species: Vec<Species>,
    positions: Vec<Vec3>,
}

struct TableColumn {
    name: String,
    width: usize,
    content: ColumnContent,
}

enum ColumnContent {
    Symbol,
    AtomicNumber,
    Position,
    Array(Column),
    /// Symbols beside atomic numbers: ASE uses the numbers.
    Ignored,
}

impl AtomTable {
    /// Columns as `Properties` describes them: `name:type:columns` triples.
    pub(super) fn new(properties: &str, exact: bool) -> Result<Self, ExtxyzErrorKind> {
        let fault = |expected| ExtxyzErrorKind::key("Properties", properties, expected);
        let fields: Vec<&str> = properties.split(':').collect();
        let (triples, rest) = fields.as_chunks::<3>();
        if !rest.is_empty() {
            return Err(fault("name:type:columns triples"));
        }
        let numbered = triples.iter().any(|[name, ..]| matches!(*name, "Z" | "numbers"));
        let mut names = BTreeSet::new();
        let mut table = Self { columns: vec![], width: 0, exact, species: vec![], positions: vec![] };
        for [name, kind, width] in triples {
            let count = width.parse().ok().filter(|width| *width > 0);
            let columns = count.and_then(|width| table.width.checked_add(width)).zip(count);
            let (total, width) = columns.ok_or_else(|| fault("a positive number of columns"))?;
            let content = content(name, kind, width, numbered).map_err(fault)?;
            if !names.insert(*name) {
                return Err(ExtxyzErrorKind::Repeated { key: format!("column {}", excerpt(name)) });
            }
            table.width = total;
            table.columns.push(TableColumn { name: (*name).to_owned(), width, content });
        }
        let positions =
            table.columns.iter().filter(|column| matches!(column.content, ColumnContent::Position)).count();
        let elements = |column: &&TableColumn| {
            matches!(column.content, ColumnContent::Symbol | ColumnContent::AtomicNumber)
        };
        if positions != 1 || table.columns.iter().filter(elements).count() != 1 {
            return Err(fault("one column pos:R:3 and one of species:S:1 and Z:I:1"));
        }
        Ok(table)
    }

    /// Reads one atom line.
    pub(super) fn push(&mut self, line: &str) -> Result<(), ExtxyzErrorKind> {
        let fields: Vec<&str> = line.split_whitespace().collect();
        if fields.len() < self.width || (self.exact && fields.len() > self.width) {
            return Err(ExtxyzErrorKind::Fields { found: fields.len(), expected: self.width });
        }
        let mut fields = fields.into_iter().enumerate();
        for column in &mut self.columns {
            let name = &column.name;
            let mut take = fields.by_ref().take(column.width);
            match &mut column.content {
                ColumnContent::Ignored => take.for_each(drop),
                ColumnContent::Symbol => {
                    self.species.extend(take.map(symbol).collect::<Result<Vec<_>, _>>()?)
                }
                ColumnContent::AtomicNumber => {
                    self.species.extend(take.map(atomic_number).collect::<Result<Vec<_>, _>>()?);
                }
                ColumnContent::Position => {
                    let mut position = [0.0; 3];
                    for (x, (index, field)) in position.iter_mut().zip(take) {
                        let finite = field.parse().ok().filter(|x: &f64| x.is_finite());
                        *x = finite.ok_or_else(|| field_fault(index, name, field, "a finite number"))?;
                    }
                    self.positions.push(position);
                }
                ColumnContent::Array(array) => take.try_for_each(|(index, field)| {
                    array.entries.push(field).map_err(|expected| field_fault(index, name, field, expected))
                })?,
            }
        }
        Ok(())
    }

    /// Species, positions, and the other columns by name.
    pub(super) fn finish(self) -> (Vec<Species>, Vec<Vec3>, BTreeMap<String, Column>) {
        let arrays = self.columns.into_iter().filter_map(|column| match column.content {
            ColumnContent::Array(array) => Some((column.name, array)),
            _ => None,
        });
        (self.species, self.positions, arrays.collect())
    }
}

/// The use of a column; on failure, what was expected.
fn content(name: &str, kind: &str, width: usize, numbered: bool) -> Result<ColumnContent, &'static str> {
    match (name, kind, width) {
        ("species" | "symbols", "S", 1) if numbered => Ok(ColumnContent::Ignored),
        ("species" | "symbols", "S", 1) => Ok(ColumnContent::Symbol),
        ("species" | "symbols", ..) => Err("species:S:1"),
        ("Z" | "numbers", "I", 1) => Ok(ColumnContent::AtomicNumber),
        ("Z" | "numbers", ..) => Err("Z:I:1"),
        ("pos" | "positions", "R", 3) => Ok(ColumnContent::Position),
        ("pos" | "positions", ..) => Err("pos:R:3"),
        ("", ..) => Err("a name for each column"),
        (_, "R", _) => Ok(ColumnContent::Array(Column { width, entries: ColumnData::Real(vec![]) })),
        (_, "I", _) => Ok(ColumnContent::Array(Column { width, entries: ColumnData::Int(vec![]) })),
        (_, "L", _) => Ok(ColumnContent::Array(Column { width, entries: ColumnData::Bool(vec![]) })),
        (_, "S", _) => Ok(ColumnContent::Array(Column { width, entries: ColumnData::Text(vec![]) })),
        _ => Err("one of the types R, I, S and L"),
    }
}

fn field_fault(index: usize, name: &str, found: &str, expected: &'static str) -> ExtxyzErrorKind {
    ExtxyzErrorKind::Field { field: index + 1, name: excerpt(name), found: excerpt(found), expected }
}

/// A symbol in any letter case: `AL` is aluminium.
fn symbol((index, field): (usize, &str)) -> Result<Species, ExtxyzErrorKind> {
    let (first, rest) = field.split_at_checked(1).unwrap_or((field, ""));
    let capitalised = first.to_ascii_uppercase() + &rest.to_ascii_lowercase();
    capitalised
        .parse()
        .map_err(|_| ExtxyzErrorKind::Species { field: index + 1, source: UnknownSpecies(excerpt(field)) })
}

fn atomic_number((index, field): (usize, &str)) -> Result<Species, ExtxyzErrorKind> {
    let species = field.parse().ok().and_then(|number| Species::from_atomic_number(number).ok());
    species
        .ok_or_else(|| ExtxyzErrorKind::Species { field: index + 1, source: UnknownSpecies(excerpt(field)) })
}

impl ColumnData {
    /// Adds a field; on failure, returns what was expected.
    fn push(&mut self, field: &str) -> Result<(), &'static str> {
        match self {
            Self::Real(values) => values.push(field.parse().map_err(|_| "a number")?),
            Self::Int(values) => values.push(field.parse().map_err(|_| "an integer")?),
            Self::Bool(values) => values.push(logical(field).ok_or("T or F")?),
            Self::Text(values) => values.push(field.to_owned()),
        }
        Ok(())
    }
}
