//! What `calm score` prints of each structure.

use std::io::{self, Write};

use atoms::extxyz::Frame;

use super::scorer::Scorer;
use crate::output::{TextTable, count};

/// Structures that are printed unless all are.
const SHOWN: usize = 20;

/// The structures with the largest γ_max, or all.
pub struct ScoreList {
    all: bool,
    /// Number of structures so far.
    number: usize,
    structures: Vec<ScoredStructure>,
}

struct ScoredStructure {
    number: usize,
    line: usize,
    formula: String,
    atoms: usize,
    gamma_max: f64,
    above: usize,
    /// The atom with the largest γ, from 0, and its element.
    worst: (usize, &'static str),
}

impl ScoreList {
    /// Keeps all structures, or [`SHOWN`].
    pub fn new(all: bool) -> Self {
        Self { all, number: 0, structures: Vec::new() }
    }

    /// Adds the frame that was scored last.
    pub fn add(&mut self, frame: &Frame, scorer: &Scorer) {
        let gamma = &scorer.grades.gamma;
        let Some(worst) = (0..gamma.len()).max_by(|a, b| gamma[*a].total_cmp(&gamma[*b])) else { return };
        self.structures.push(ScoredStructure {
            number: self.number,
            line: frame.line,
            formula: frame.structure.formula(),
            atoms: gamma.len(),
            gamma_max: gamma[worst],
            above: gamma.iter().filter(|gamma| **gamma > 1.0).count(),
            worst: (worst, frame.structure.species[worst].symbol()),
        });
        self.number += 1;
        if !self.all && self.structures.len() >= 10 * SHOWN {
            self.keep_worst();
        }
    }

    fn keep_worst(&mut self) {
        self.structures.sort_by(|a, b| b.gamma_max.total_cmp(&a.gamma_max).then(a.number.cmp(&b.number)));
        self.structures.truncate(SHOWN);
    }

    /// Writes a table in the order of the input, or with the largest γ_max first if some are left out.
    pub fn write(mut self, out: &mut dyn Write) -> io::Result<()> {
        if self.structures.is_empty() {
            return Ok(());
        }
        if !self.all && self.number > SHOWN {
            self.keep_worst();
        }
        let mut table = TextTable::new(&[
            ">line",
            "formula",
            ">atoms",
            ">γ_max",
            ">atoms γ > 1",
            ">worst atom",
            "element",
        ]);
        for found in &self.structures {
            table.push(vec![
                found.line.to_string(),
                found.formula.clone(),
                found.atoms.to_string(),
                format!("{:.2}", found.gamma_max),
                found.above.to_string(),
                found.worst.0.to_string(),
                found.worst.1.to_owned(),
            ]);
        }
        table.write(out)?;
        match self.number - self.structures.len() {
            0 => Ok(()),
            more => writeln!(out, "… and {} with smaller γ_max (use --all)", count(more as u64, "structure")),
        }
    }
}
