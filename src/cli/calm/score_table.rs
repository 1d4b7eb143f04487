//! The table of `calm score` with one row for each structure, which `calm filter` reads.

use std::io::Write;
use std::path::{Path, PathBuf};

use atoms::cell::{norm, sub};
use atoms::extxyz::{Frame, FrameLabels};

use super::score_calibration::COLUMN;
use super::scorer::Scorer;
use crate::atomic_file::{AtomicFile, cannot_write};
use crate::cli::CommandError;
use crate::csv::number;

const TITLES: &str = "line,atoms,gamma_max,gamma_nbr_max,energy_per_atom,label_energy_per_atom,force_error_mean,force_error_max";

/// A file of rows.
pub struct ScoreTable {
    path: PathBuf,
    file: AtomicFile,
    has_bounds: bool,
}

impl ScoreTable {
    /// Begins with the titles, and those of bounds of the force error if they are known.
    pub fn create(path: &Path, has_bounds: bool) -> Result<Self, CommandError> {
        let mut table = Self { path: path.to_owned(), file: AtomicFile::create(path)?, has_bounds };
        let bounds = if has_bounds { format!(",{COLUMN}") } else { String::new() };
        table.write(&format!("{TITLES}{bounds}"))?;
        Ok(table)
    }

    /// Adds a frame that was scored last. Numbers that follow from labels are empty without them.
    pub fn add(
        &mut self,
        frame: &Frame,
        scorer: &Scorer,
        labels: &FrameLabels,
        bound: Option<f64>,
    ) -> Result<(), CommandError> {
        let atoms = frame.structure.len() as f64;
        let largest = |values: &[f64]| values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let pairs = labels.forces.iter().flatten().zip(&scorer.evaluation.forces);
        let errors: Vec<_> = pairs.map(|(a, b)| norm(sub(*a, *b))).collect();
        let mean = (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / atoms);
        let mut row = vec![
            frame.line.to_string(),
            atoms.to_string(),
            number(largest(&scorer.grades.gamma)),
            number(largest(&scorer.gamma_nbr)),
            number(scorer.evaluation.energy() / atoms),
            number(labels.energy.map(|energy| energy / atoms)),
            number(mean),
            number(largest(&errors)),
        ];
        row.extend(self.has_bounds.then(|| number(bound)));
        self.write(&row.join(","))
    }

    pub fn finish(self) -> Result<(), CommandError> {
        self.file.finish()
    }

    fn write(&mut self, line: &str) -> Result<(), CommandError> {
        writeln!(self.file, "{line}").map_err(|error| cannot_write(&self.path, error))
    }
}
