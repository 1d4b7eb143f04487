//! Reading frames from a stream.

use std::collections::BTreeMap;
use std::io::{BufRead, ErrorKind};

use super::error::{ExtxyzError, ExtxyzErrorKind, excerpt};
use super::table::AtomTable;
use super::{ExtxyzValue, Frame, comment};
use crate::cell::{Cell, Matrix3};
use crate::structure::Structure;

/// Iterates over the frames of a stream. Ends after the first error.
pub struct ExtxyzReader<R> {
    input: R,
    /// Number of the line in `text`, from 1.
    line: usize,
    text: String,
    ended: bool,
}

impl<R: BufRead> ExtxyzReader<R> {
    /// Reads from `input` as the iterator advances.
    pub fn new(input: R) -> Self {
        Self { input, line: 0, text: String::new(), ended: false }
    }

    /// Reads the next line into `text`; false at the end of the stream.
    fn advance(&mut self) -> Result<bool, ExtxyzError> {
        self.text.clear();
        self.line += 1;
        match self.input.read_line(&mut self.text) {
            Ok(bytes) => Ok(bytes > 0),
            Err(error) if error.kind() == ErrorKind::InvalidData => {
                Err(ExtxyzErrorKind::Encoding.at(self.line))
            }
            Err(error) => Err(ExtxyzErrorKind::Io(error).at(self.line)),
        }
    }

    fn frame(&mut self) -> Result<Option<Frame>, ExtxyzError> {
        while self.advance()? {
            if self.text.trim().is_empty() {
                continue;
            }
            let Ok(count) = self.text.trim().parse() else {
                return Err(ExtxyzErrorKind::Count { found: excerpt(&self.text) }.at(self.line));
            };
            return self.body(count, self.line).map(Some);
        }
        Ok(None)
    }

    /// Reads the atoms of a frame with `count` atoms whose first line, `start`, has been read.
    fn body(&mut self, count: u64, start: usize) -> Result<Frame, ExtxyzError> {
        if !self.advance()? {
            return Err(ExtxyzErrorKind::Truncated { found: 0, expected: count, start }.at(self.line));
        }
        let ExtxyzHeader { info, cell, periodic, mut table } =
            ExtxyzHeader::new(&self.text).map_err(|fault| fault.at(self.line))?;
        for atom in 0..count {
            if !self.advance()? {
                return Err(ExtxyzErrorKind::Truncated { found: atom, expected: count, start }.at(self.line));
            }
            table.push(&self.text).map_err(|fault| fault.at(self.line))?;
        }
        let (species, positions, arrays) = table.finish();
        let structure = Structure { species, positions, cell, periodic };
        structure.validate().map_err(|fault| ExtxyzErrorKind::from(fault).at(start))?;
        Ok(Frame { structure, info, arrays, line: start })
    }
}

impl<R: BufRead> Iterator for ExtxyzReader<R> {
    type Item = Result<Frame, ExtxyzError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let frame = self.frame().transpose();
        self.ended = !matches!(frame, Some(Ok(_)));
        frame
    }
}

/// The parsed comment line.
struct ExtxyzHeader {
    info: BTreeMap<String, ExtxyzValue>,
    cell: Cell,
    periodic: [bool; 3],
    table: AtomTable,
}

impl ExtxyzHeader {
    fn new(line: &str) -> Result<Self, ExtxyzErrorKind> {
        let mut info = BTreeMap::new();
        for (key, mut value) in comment::parse(line)? {
            if key == "stress" || key == "virial" {
                value = matrix(&value).ok_or_else(|| fault(&key, &value, "9 numbers (or 6)"))?.into();
            }
            if info.get(&key).is_some_and(|other| *other != value) {
                return Err(ExtxyzErrorKind::Repeated { key: excerpt(&key) });
            }
            info.insert(key, value);
        }
        let lattice = info.remove("Lattice").map(|value| lattice(&value)).transpose()?;
        let periodic = info.remove("pbc").map(|value| periodic(&value)).transpose()?;
        let table = match info.remove("Properties") {
            Some(ExtxyzValue::Text(properties)) => AtomTable::new(&properties, true)?,
            Some(other) => return Err(fault("Properties", &other, "name:type:columns triples")),
            None => AtomTable::new("species:S:1:pos:R:3", false)?,
        };
        Ok(Self {
            info,
            cell: lattice.unwrap_or(Cell([[0.0; 3]; 3])),
            periodic: periodic.unwrap_or([lattice.is_some(); 3]),
            table,
        })
    }
}

fn fault(key: &str, value: &ExtxyzValue, expected: &'static str) -> ExtxyzErrorKind {
    ExtxyzErrorKind::key(key, &value.to_string(), expected)
}

fn lattice(value: &ExtxyzValue) -> Result<Cell, ExtxyzErrorKind> {
    match value.numbers().as_deref() {
        Some(&[a, b, c, d, e, f, g, h, i]) => Ok(Cell([[a, b, c], [d, e, f], [g, h, i]])),
        _ => Err(fault("Lattice", value, "9 numbers")),
    }
}

/// A 3×3 matrix from its 9 components in Fortran order, or from 6 in Voigt order.
fn matrix(value: &ExtxyzValue) -> Option<Matrix3> {
    match *value.numbers()? {
        [xx, yx, zx, xy, yy, zy, xz, yz, zz] => Some([[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]]),
        [xx, yy, zz, yz, xz, xy] => Some([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
        _ => None,
    }
}

fn periodic(value: &ExtxyzValue) -> Result<[bool; 3], ExtxyzErrorKind> {
    let flag = |value: &ExtxyzValue| match value {
        ExtxyzValue::Bool(flag) => Some(*flag),
        ExtxyzValue::Int(0) => Some(false),
        ExtxyzValue::Int(1) => Some(true),
        _ => None,
    };
    let flags: Option<Vec<bool>> = match value {
        ExtxyzValue::List(values) => values.iter().map(flag).collect(),
        _ => flag(value).map(|flag| vec![flag; 3]),
    };
    flags.and_then(|flags| flags.try_into().ok()).ok_or_else(|| fault("pbc", value, "three of T and F"))
}
