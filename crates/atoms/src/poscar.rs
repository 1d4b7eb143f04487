//! Reads and writes VASP POSCAR files (version 5, with a line of element symbols).
//!
//! The existing crate `vasp-poscar` 0.3 depends on `failure`, which is unmaintained (RUSTSEC-2020-0036).

use std::fmt;
use std::io::{BufRead, ErrorKind, Write};

use crate::cell::{Cell, Vec3};
use crate::extxyz::{Column, ColumnData, Frame};
use crate::species::{Species, UnknownSpecies};
use crate::structure::{Structure, StructureError};

/// An error with its line.
#[derive(Debug, thiserror::Error)]
#[error("line {line}: {kind}")]
pub struct PoscarError {
    /// Line of the file, from 1.
    pub line: usize,
    /// What is wrong.
    #[source]
    pub kind: PoscarErrorKind,
}

/// What is wrong with a line.
#[derive(Debug, thiserror::Error)]
pub enum PoscarErrorKind {
    /// The stream cannot be read.
    #[error("cannot be read: {0}")]
    Io(std::io::Error),
    /// The stream ends too early.
    #[error("the file ends here, expected {0}")]
    End(PoscarSection),
    /// A line has the wrong format.
    #[error("found '{found}', expected {expected}")]
    Line {
        /// The line.
        found: String,
        /// The expected content.
        expected: PoscarSection,
    },
    /// A file of VASP 4, which does not name its elements.
    #[error(
        "found '{0}', expected element symbols: this is a file of VASP 4; insert a line such as 'Al Si' above it"
    )]
    NoSymbols(String),
    /// An unknown element symbol.
    #[error(transparent)]
    Species(#[from] UnknownSpecies),
    /// The structure is invalid.
    #[error(transparent)]
    Structure(#[from] StructureError),
}

/// A section of the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoscarSection {
    /// Line 1.
    Comment,
    /// Line 2.
    Scale,
    /// Lines 3 to 5.
    LatticeVector,
    /// Line 6.
    Symbols,
    /// Line 7.
    Counts,
    /// `Direct` or `Cartesian`.
    Mode,
    /// An atom line.
    Position,
    /// An atom line with selective dynamics.
    PositionAndFlags,
}

impl fmt::Display for PoscarSection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Comment => "a comment",
            Self::Scale => "a scale factor (three positive ones, or a negative one: the volume)",
            Self::LatticeVector => "a lattice vector of three finite numbers",
            Self::Symbols => "element symbols",
            Self::Counts => "a number of atoms for each element symbol",
            Self::Mode => "'Direct' or 'Cartesian'",
            Self::Position => "a position of three finite numbers",
            Self::PositionAndFlags => "a position of three finite numbers and three of T and F",
        })
    }
}

/// Reads one structure, periodic in all directions.
///
/// The comment becomes the text `comment` of `info`; the flags of selective dynamics become the array
/// `move_mask` `[n × 3]` (true: free to move), as in ASE. Data after the positions (velocities,
/// predictor–corrector data) are ignored.
pub fn read_poscar(input: impl BufRead) -> Result<Frame, PoscarError> {
    let mut lines = PoscarLines { input, number: 0, text: String::new() };
    let frame = frame(&mut lines);
    frame.map_err(|fault| PoscarError { line: lines.number, kind: fault })
}

fn frame(lines: &mut PoscarLines<impl BufRead>) -> Result<Frame, PoscarErrorKind> {
    let comment = lines.take(PoscarSection::Comment)?.to_owned();
    let factors = lines.parse(PoscarSection::Scale, factors)?;
    let mut lattice = [[0.0; 3]; 3];
    for vector in &mut lattice {
        *vector = lines.parse(PoscarSection::LatticeVector, vector3)?;
    }
    let factors = match factors {
        PoscarScale::Factors(factors) => factors,
        PoscarScale::Volume(volume) => [(volume / Cell(lattice).volume()).cbrt(); 3],
    };
    let stretch = |x: Vec3| -> Vec3 { std::array::from_fn(|k| x[k] * factors[k]) };
    let cell = Cell(lattice.map(stretch));
    let symbols = symbols(lines.take(PoscarSection::Symbols)?)?;
    let counts = lines.parse(PoscarSection::Counts, |text| counts(text, symbols.len()))?;
    let mut mode = lines.parse(PoscarSection::Mode, mode)?;
    let selective = mode == CoordinateMode::Selective;
    if selective {
        mode = lines.parse(PoscarSection::Mode, mode_of_positions)?;
    }
    let mut structure = Structure { species: vec![], positions: vec![], cell, periodic: [true; 3] };
    let mut flags = Vec::new();
    for (species, count) in symbols.into_iter().zip(counts) {
        for _ in 0..count {
            let position = if selective {
                let (position, free) = lines.parse(PoscarSection::PositionAndFlags, position_and_flags)?;
                flags.extend(free);
                position
            } else {
                lines.parse(PoscarSection::Position, vector3)?
            };
            structure.species.push(species);
            let cartesian = mode == CoordinateMode::Cartesian;
            structure.positions.push(if cartesian { stretch(position) } else { cell.cartesian(position) });
        }
    }
    structure.validate()?;
    let mut frame = Frame { line: 1, ..Frame::from(structure) };
    if !comment.is_empty() {
        frame.info.insert("comment".to_owned(), comment.into());
    }
    if selective {
        let entries = ColumnData::Bool(flags);
        frame.arrays.insert("move_mask".to_owned(), Column { width: 3, entries });
    }
    Ok(frame)
}

/// Why a structure cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum PoscarWriteError {
    /// The stream reports an error.
    #[error("cannot be written: {0}")]
    Io(#[from] std::io::Error),
    /// The structure is invalid or its cell has no volume.
    #[error(transparent)]
    Structure(#[from] StructureError),
}

/// Writes a structure in Cartesian coordinates. Returns the order of its atoms: position k of the file belongs
/// to atom `order[k]`.
///
/// Atoms are grouped by element, elements in the order of their first atom. The format cannot express
/// non-periodic directions, so the cell must span space in any case. Only the first line of `comment` is
/// written.
pub fn write_poscar(
    out: &mut impl Write,
    structure: &Structure,
    comment: &str,
) -> Result<Vec<usize>, PoscarWriteError> {
    Structure { periodic: [true; 3], ..structure.clone() }.validate()?;
    let mut elements: Vec<Species> = Vec::new();
    for species in &structure.species {
        if !elements.contains(species) {
            elements.push(*species);
        }
    }
    let atoms = |element: &Species| {
        let element = *element;
        structure
            .species
            .iter()
            .enumerate()
            .filter(move |(_, species)| **species == element)
            .map(|(atom, _)| atom)
    };
    writeln!(out, "{}\n1.0", comment.lines().next().unwrap_or("").trim())?;
    for [x, y, z] in structure.cell.0 {
        writeln!(out, "{x:?} {y:?} {z:?}")?;
    }
    writeln!(out, "{}", joined(elements.iter().map(|element| element.symbol().to_owned())))?;
    writeln!(
        out,
        "{}\nCartesian",
        joined(elements.iter().map(|element| atoms(element).count().to_string()))
    )?;
    let order: Vec<usize> = elements.iter().flat_map(atoms).collect();
    for [x, y, z] in order.iter().filter_map(|atom| structure.positions.get(*atom)) {
        writeln!(out, "{x:?} {y:?} {z:?}")?;
    }
    Ok(order)
}

fn joined(words: impl Iterator<Item = String>) -> String {
    words.collect::<Vec<_>>().join(" ")
}

struct PoscarLines<R> {
    input: R,
    /// Number of the line in `text`, from 1.
    number: usize,
    text: String,
}

impl<R: BufRead> PoscarLines<R> {
    fn take(&mut self, expected: PoscarSection) -> Result<&str, PoscarErrorKind> {
        self.text.clear();
        self.number += 1;
        match self.input.read_line(&mut self.text) {
            Ok(0) => Err(PoscarErrorKind::End(expected)),
            Ok(_) => Ok(self.text.trim()),
            Err(error) if error.kind() == ErrorKind::InvalidData => {
                Err(PoscarErrorKind::Line { found: "bytes that are not text".to_owned(), expected })
            }
            Err(error) => Err(PoscarErrorKind::Io(error)),
        }
    }

    fn parse<T>(
        &mut self,
        expected: PoscarSection,
        parse: impl Fn(&str) -> Option<T>,
    ) -> Result<T, PoscarErrorKind> {
        let text = self.take(expected)?;
        parse(text).ok_or_else(|| PoscarErrorKind::Line { found: text.chars().take(60).collect(), expected })
    }
}

enum PoscarScale {
    Factors(Vec3),
    /// Å³
    Volume(f64),
}

/// One factor or three; the rest of the line is a comment.
fn factors(text: &str) -> Option<PoscarScale> {
    let numbers: Vec<f64> = text.split_whitespace().map_while(|word| word.parse().ok()).take(3).collect();
    match *numbers {
        _ if !numbers.iter().all(|x| x.is_finite()) => None,
        [factor] if factor > 0.0 => Some(PoscarScale::Factors([factor; 3])),
        [volume] if volume < 0.0 => Some(PoscarScale::Volume(-volume)),
        [x, y, z] if x > 0.0 && y > 0.0 && z > 0.0 => Some(PoscarScale::Factors([x, y, z])),
        _ => None,
    }
}

/// Three numbers; the rest of the line is a comment.
fn vector3(text: &str) -> Option<Vec3> {
    let numbers =
        text.split_whitespace().take(3).map(|word| word.parse().ok().filter(|x: &f64| x.is_finite()));
    numbers.collect::<Option<Vec<f64>>>()?.try_into().ok()
}

fn position_and_flags(text: &str) -> Option<(Vec3, Vec<bool>)> {
    let flag = |word: &str| match word.trim_start_matches('.').chars().next() {
        Some('T' | 't') => Some(true),
        Some('F' | 'f') => Some(false),
        _ => None,
    };
    let flags: Vec<bool> = text.split_whitespace().skip(3).take(3).map(flag).collect::<Option<_>>()?;
    vector3(text).filter(|_| flags.len() == 3).map(|position| (position, flags))
}

/// Element symbols; VASP may add the potential's name and a hash: `Al_pv/6a2f54`.
fn symbols(text: &str) -> Result<Vec<Species>, PoscarErrorKind> {
    if text.is_empty() {
        return Err(PoscarErrorKind::Line { found: String::new(), expected: PoscarSection::Symbols });
    }
    if text.split_whitespace().all(|word| word.parse::<u64>().is_ok()) {
        return Err(PoscarErrorKind::NoSymbols(text.chars().take(60).collect()));
    }
    let species = |word: &str| word.split(['_', '/']).next().unwrap_or(word).parse::<Species>();
    Ok(text
        .split_whitespace()
        .take_while(|word| !word.starts_with('!'))
        .map(species)
        .collect::<Result<_, _>>()?)
}

fn counts(text: &str, symbols: usize) -> Option<Vec<u64>> {
    let words = text.split_whitespace().take_while(|word| !word.starts_with('!'));
    let counts: Option<Vec<u64>> = words.map(|word| word.parse().ok()).collect();
    counts.filter(|counts| counts.len() == symbols)
}

#[derive(Clone, Copy, PartialEq)]
enum CoordinateMode {
    Selective,
    Direct,
    Cartesian,
}

/// Only the first letter is significant.
fn mode(text: &str) -> Option<CoordinateMode> {
    match text.chars().next()? {
        'S' | 's' => Some(CoordinateMode::Selective),
        _ => mode_of_positions(text),
    }
}

fn mode_of_positions(text: &str) -> Option<CoordinateMode> {
    match text.chars().next()? {
        'D' | 'd' => Some(CoordinateMode::Direct),
        'C' | 'c' | 'K' | 'k' => Some(CoordinateMode::Cartesian),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
