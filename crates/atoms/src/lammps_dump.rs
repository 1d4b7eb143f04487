//! Reads and writes text dumps of LAMMPS (`dump atom` and `dump custom`), snapshot by snapshot.
//!
//! The format: docs.lammps.org/dump.html. Orthogonal, triclinic and general triclinic boxes; coordinates `x`, `xu`, `xs` and
//! `xsu`. Atoms are in the order of their `id`, since LAMMPS writes them in any order. Binary and other dump styles are not read.
//!
//! No maintained crate reads it.

mod error;
mod sections;
mod write;

use std::io::{BufRead, ErrorKind};

use crate::cell::Vec3;
use crate::extxyz::{Column, ColumnData, Frame};
use crate::species::Species;
use crate::structure::Structure;

pub use error::{DumpError, DumpErrorKind};
use sections::{DumpAtom, DumpColumns, SimulationBox};
pub use write::{DumpMotion, DumpSnapshot, write_snapshot};

/// Iterates over the snapshots of a stream. Ends after the first error.
///
/// A frame has `timestep` in its `info`, and the array `id` if the dump has it. Its line is that of the first `ITEM:`.
pub struct LammpsDumpReader<R> {
    lines: DumpLines<R>,
    /// Elements of atom types 1, 2, ….
    types: Vec<Species>,
    ended: bool,
}

/// The lines of a stream.
struct DumpLines<R> {
    input: R,
    /// Number of the line in `text`, from 1.
    number: usize,
    text: String,
}

/// What precedes the atoms of a snapshot.
#[derive(Default)]
struct SnapshotHeader {
    /// Line of the first item.
    line: usize,
    timestep: Option<i64>,
    atoms: Option<usize>,
    bounds: Option<SimulationBox>,
}

impl<R: BufRead> LammpsDumpReader<R> {
    /// Reads from `input` as the iterator advances. `types` are the elements of the atom types, from type 1, for dumps without the
    /// column `element`.
    pub fn new(input: R, types: Vec<Species>) -> Self {
        Self { lines: DumpLines { input, number: 0, text: String::new() }, types, ended: false }
    }

    fn frame(&mut self) -> Result<Option<Frame>, DumpErrorKind> {
        let mut header = SnapshotHeader::default();
        while self.lines.advance()? {
            if self.lines.text.trim().is_empty() {
                continue;
            }
            let item = self.lines.text.trim_end().strip_prefix("ITEM: ").map(str::to_owned);
            let Some(item) = item else {
                return Err(DumpErrorKind::line(&self.lines.text, "'ITEM: ' and the name of a section"));
            };
            if header.line == 0 {
                header.line = self.lines.number;
            }
            if let Some(columns) = item.strip_prefix("ATOMS") {
                return self.body(columns, header).map(Some);
            }
            self.section(&item, &mut header)?;
        }
        if header.line == 0 { Ok(None) } else { Err(DumpErrorKind::End("the section ATOMS")) }
    }

    /// A section before the atoms.
    fn section(&mut self, item: &str, header: &mut SnapshotHeader) -> Result<(), DumpErrorKind> {
        if let Some(words) = item.strip_prefix("BOX BOUNDS") {
            let mut rows = [const { Vec::new() }; 3];
            for row in &mut rows {
                *row = self
                    .lines
                    .take("the bounds of the box")?
                    .to_owned()
                    .split_whitespace()
                    .map(str::to_owned)
                    .collect();
            }
            header.bounds = Some(SimulationBox::parse(words, &rows)?);
            return Ok(());
        }
        match item {
            "TIMESTEP" => header.timestep = Some(self.lines.parse("a time step")?),
            "NUMBER OF ATOMS" => header.atoms = Some(self.lines.parse("a number of atoms")?),
            "UNITS" => {
                let units = self.lines.take("the name of the units")?;
                if !["metal", "real"].contains(&units) {
                    return Err(DumpErrorKind::line(units, "units 'metal' or 'real', with lengths in Å"));
                }
            }
            // Such as TIME.
            _ => {
                self.lines.take("the content of a section")?;
            }
        }
        Ok(())
    }

    fn body(&mut self, columns: &str, header: SnapshotHeader) -> Result<Frame, DumpErrorKind> {
        let columns = DumpColumns::parse(columns, &self.types)?;
        let count = header.atoms.ok_or(DumpErrorKind::NoSection("NUMBER OF ATOMS"))?;
        let bounds = header.bounds.as_ref().ok_or(DumpErrorKind::NoSection("BOX BOUNDS"))?;
        let mut atoms = Vec::new();
        for _ in 0..count {
            let text = self.lines.take("an atom")?;
            atoms.push(columns.atom(text, &self.types)?);
        }
        frame(atoms, &columns, bounds, &header).map_err(|fault| fault.of_snapshot(header.line))
    }
}

fn frame(
    mut atoms: Vec<DumpAtom>,
    columns: &DumpColumns,
    bounds: &SimulationBox,
    header: &SnapshotHeader,
) -> Result<Frame, DumpErrorKind> {
    let ids = columns.has_id();
    if ids {
        atoms.sort_by_key(|atom| atom.id);
        if let Some(twice) = atoms.windows(2).find(|pair| pair[0].id == pair[1].id) {
            return Err(DumpErrorKind::RepeatedId(twice[0].id));
        }
    }
    let position = |atom: &DumpAtom| -> Vec3 { bounds.position(atom.position, columns.scaled()) };
    let structure = Structure {
        species: atoms.iter().map(|atom| atom.species).collect(),
        positions: atoms.iter().map(position).collect(),
        cell: bounds.cell,
        periodic: bounds.periodic,
    };
    structure.validate()?;
    let mut frame = Frame { line: header.line, ..Frame::from(structure) };
    if let Some(step) = header.timestep {
        frame.info.insert("timestep".to_owned(), step.into());
    }
    if ids {
        let entries = ColumnData::Int(atoms.iter().map(|atom| atom.id).collect());
        frame.arrays.insert("id".to_owned(), Column { width: 1, entries });
    }
    Ok(frame)
}

impl<R: BufRead> Iterator for LammpsDumpReader<R> {
    type Item = Result<Frame, DumpError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let frame = self.frame().map_err(|fault| fault.at(self.lines.number)).transpose();
        self.ended = !matches!(frame, Some(Ok(_)));
        frame
    }
}

impl<R: BufRead> DumpLines<R> {
    /// Reads the next line into `text`; false at the end of the stream.
    fn advance(&mut self) -> Result<bool, DumpErrorKind> {
        self.text.clear();
        self.number += 1;
        match self.input.read_line(&mut self.text) {
            Ok(bytes) => Ok(bytes > 0),
            Err(error) if error.kind() == ErrorKind::InvalidData => Err(DumpErrorKind::Encoding),
            Err(error) => Err(DumpErrorKind::Io(error)),
        }
    }

    fn take(&mut self, expected: &'static str) -> Result<&str, DumpErrorKind> {
        if self.advance()? { Ok(self.text.trim()) } else { Err(DumpErrorKind::End(expected)) }
    }

    fn parse<T: std::str::FromStr>(&mut self, expected: &'static str) -> Result<T, DumpErrorKind> {
        let text = self.take(expected)?;
        text.parse().map_err(|_| DumpErrorKind::line(text, expected))
    }
}

#[cfg(test)]
mod tests;
