//! Writing frames.

use std::io::Write;

use super::comment::{is_verbatim, quote};
use super::{Column, ColumnData, ExtxyzValue, Frame};
use crate::structure::StructureError;

/// Why a frame cannot be written so that this reader and ASE read it back.
#[derive(Debug, thiserror::Error)]
pub enum ExtxyzWriteError {
    /// The stream reports an error.
    #[error("cannot be written: {0}")]
    Io(#[from] std::io::Error),
    /// The structure is invalid.
    #[error(transparent)]
    Structure(#[from] StructureError),
    /// A key or its value cannot be written.
    #[error("the info key '{key}' {fault}")]
    Key {
        /// The key.
        key: String,
        /// What is wrong.
        fault: &'static str,
    },
    /// A column cannot be written.
    #[error("the column '{name}' {fault}")]
    Column {
        /// Its name.
        name: String,
        /// What is wrong.
        fault: &'static str,
    },
}

/// Writes one frame, or nothing if it cannot be written.
///
/// Keys and columns are in alphabetical order, so equal frames give equal bytes.
pub fn write_frame(out: &mut impl Write, frame: &Frame) -> Result<(), ExtxyzWriteError> {
    frame.structure.validate()?;
    let mut text = Vec::new();
    writeln!(text, "{}", frame.structure.len())?;
    writeln!(text, "{}", comment(frame)?)?;
    for (atom, (species, position)) in
        frame.structure.species.iter().zip(&frame.structure.positions).enumerate()
    {
        let [x, y, z] = position;
        write!(text, "{species:<2} {x:?} {y:?} {z:?}")?;
        for column in frame.arrays.values() {
            write_entries(&mut text, column, atom)?;
        }
        writeln!(text)?;
    }
    Ok(out.write_all(&text)?)
}

fn comment(frame: &Frame) -> Result<String, ExtxyzWriteError> {
    let mut words = Vec::new();
    let lattice = frame.structure.cell.0.concat();
    if lattice.iter().any(|x| *x != 0.0) {
        words.push(format!("Lattice=\"{}\"", reals(&lattice)));
    }
    let mut properties = "species:S:1:pos:R:3".to_owned();
    for (name, column) in &frame.arrays {
        let kind = kind(name, column, frame.structure.len())
            .map_err(|fault| ExtxyzWriteError::Column { name: name.clone(), fault })?;
        properties.push_str(&format!(":{name}:{kind}:{}", column.width));
    }
    words.push(format!("Properties={}", quote(&properties)));
    for (key, value) in &frame.info {
        let value = info(key, value).map_err(|fault| ExtxyzWriteError::Key { key: key.clone(), fault })?;
        words.push(format!("{}={}", quote(key), quote(&value)));
    }
    let [a, b, c] = frame.structure.periodic.map(flag);
    words.push(format!("pbc=\"{a} {b} {c}\""));
    Ok(words.join(" "))
}

/// The value as text; on failure, what is wrong.
fn info(key: &str, value: &ExtxyzValue) -> Result<String, &'static str> {
    match key {
        "Lattice" | "Properties" | "pbc" => return Err("belongs to the structure"),
        "stress" | "virial" => return matrix(value).ok_or("needs a 3 × 3 matrix or 6 components"),
        _ => {}
    }
    if key.is_empty() || key.contains(char::is_control) {
        return Err("is empty or has control characters");
    }
    if is_verbatim(key) {
        let plain = |text: &&str| !text.is_empty() && !text.contains(char::is_control);
        return value.text().filter(plain).map(str::to_owned).ok_or("must be a single line of text");
    }
    value.to_text().ok_or("has nested lists of different lengths or with numbers that are not finite")
}

/// Nine components in Fortran order.
fn matrix(value: &ExtxyzValue) -> Option<String> {
    match *value.numbers()? {
        [xx, xy, xz, yx, yy, yz, zx, zy, zz] => Some(reals(&[xx, yx, zx, xy, yy, zy, xz, yz, zz])),
        [xx, yy, zz, yz, xz, xy] => Some(reals(&[xx, xy, xz, xy, yy, yz, xz, yz, zz])),
        _ => None,
    }
}

/// The type letter of a column; on failure, what is wrong.
fn kind(name: &str, column: &Column, atoms: usize) -> Result<char, &'static str> {
    if matches!(name, "species" | "symbols" | "Z" | "numbers" | "pos" | "positions") {
        return Err("belongs to the structure");
    }
    if name.is_empty() || name.contains(|c: char| c == ':' || c.is_control()) {
        return Err("needs a name without colons and control characters");
    }
    if column.width == 0 || column.width.checked_mul(atoms) != Some(column.entries.len()) {
        return Err("does not have one row of the same width for each atom");
    }
    match &column.entries {
        ColumnData::Real(_) => Ok('R'),
        ColumnData::Bool(_) => Ok('L'),
        ColumnData::Int(values) if values.iter().all(|value| i32::try_from(*value).is_ok()) => Ok('I'),
        ColumnData::Int(_) => Err("has integers of more than 32 bits, which ASE cannot read"),
        ColumnData::Text(words) if words.iter().all(|word| is_word(word)) => Ok('S'),
        ColumnData::Text(_) => Err("has text that is empty or contains white space"),
    }
}

fn is_word(text: &str) -> bool {
    !text.is_empty() && !text.contains(|c: char| c.is_whitespace() || c.is_control())
}

fn write_entries(text: &mut Vec<u8>, column: &Column, atom: usize) -> std::io::Result<()> {
    let row = atom * column.width..(atom + 1) * column.width;
    match &column.entries {
        ColumnData::Real(values) => {
            values.get(row).into_iter().flatten().try_for_each(|x| write!(text, " {x:?}"))
        }
        ColumnData::Int(values) => {
            values.get(row).into_iter().flatten().try_for_each(|i| write!(text, " {i}"))
        }
        ColumnData::Bool(values) => {
            values.get(row).into_iter().flatten().try_for_each(|b| write!(text, " {}", flag(*b)))
        }
        ColumnData::Text(words) => {
            words.get(row).into_iter().flatten().try_for_each(|s| write!(text, " {s}"))
        }
    }
}

fn reals(values: &[f64]) -> String {
    values.iter().map(|value| format!("{value:?}")).collect::<Vec<_>>().join(" ")
}

fn flag(value: bool) -> char {
    if value { 'T' } else { 'F' }
}
