//! What `calm score` says of structures with labels.

use std::io::Write;
use std::path::Path;

use atoms::extxyz::{Frame, FrameLabels};
use figures::{to_png, to_svg};

use super::score_table::ScoreTable;
use super::scorer::Scorer;
use crate::atomic_file::{AtomicFile, cannot_create, cannot_write};
use crate::calm_validation::labelled::{
    self, BOOTSTRAP, LabelledErrors, LabelledReport, LabelledStructure, ScoreColumn, TrainingErrors,
};
use crate::cli::CommandError;
use crate::output::{count, log_and_warn, print};
use crate::page::{FigureContent, FigureEntry};

/// Resolution of images, dots per inch.
const RESOLUTION: f64 = 300.0;

/// Compares scores with the labels of one frame after another.
pub struct ScoreLabels {
    table: Option<ScoreTable>,
    errors: LabelledErrors,
    /// Number of frames whose labels cannot be read, and why the first cannot.
    unreadable: (u64, Option<String>),
}

impl ScoreLabels {
    /// With the columns of `others` beside γ and γ_nbr, and the file for one row of each structure, if it is wanted; with a column
    /// of bounds of the force error if they are known.
    pub fn new(
        others: Vec<ScoreColumn>,
        table: Option<&Path>,
        has_bounds: bool,
    ) -> Result<Self, CommandError> {
        let own = [ScoreColumn::grade("γ"), ScoreColumn::grade("γ_{nbr}")];
        let columns = own.into_iter().chain(others).collect();
        let table = table.map(|path| ScoreTable::create(path, has_bounds)).transpose()?;
        Ok(Self { table, errors: LabelledErrors::new(columns), unreadable: (0, None) })
    }

    /// Adds the frame that was scored last, with the values of the other columns and the bound of its worst atom. Its labels must not have been moved yet. Returns
    /// whether it has force labels.
    pub fn add(
        &mut self,
        frame: &Frame,
        scorer: &Scorer,
        others: &[(String, Vec<f64>)],
        bound: Option<f64>,
    ) -> Result<bool, CommandError> {
        let labels = frame.labels().unwrap_or_else(|error| {
            self.unreadable.0 += 1;
            self.unreadable.1.get_or_insert_with(|| error.to_string());
            FrameLabels::default()
        });
        let evaluation = &scorer.evaluation;
        let predicted = FrameLabels {
            energy: Some(evaluation.energy()),
            forces: Some(evaluation.forces.clone()),
            stress: evaluation.stress(&frame.structure),
        };
        let own = [scorer.grades.gamma.as_slice(), &scorer.gamma_nbr];
        let scores: Vec<_> =
            own.into_iter().chain(others.iter().map(|(_, values)| values.as_slice())).collect();
        self.errors.add(&LabelledStructure {
            species: &frame.structure.species,
            scores: &scores,
            predicted: &predicted,
            labels: &labels,
        });
        self.table.as_mut().map_or(Ok(()), |table| table.add(frame, scorer, &labels, bound))?;
        Ok(labels.forces.is_some())
    }

    /// Prints the tables, if any frame has labels, and writes the files.
    pub fn finish(
        mut self,
        json: Option<&Path>,
        figures: Option<&Path>,
        input: &Path,
    ) -> Result<(), CommandError> {
        self.table.take().map_or(Ok(()), ScoreTable::finish)?;
        self.warn(input);
        if self.errors.structures() == 0 && json.is_none() && figures.is_none() {
            return Ok(());
        }
        let report = self.errors.report(BOOTSTRAP);
        if let Some(path) = json {
            let text = serde_json::to_string_pretty(&report).map_err(CommandError::failed)?;
            write_file(path, (text + "\n").as_bytes())?;
        }
        figures.map_or(Ok(()), |directory| write_figures(directory, &report))?;
        if report.structures == 0 {
            return Ok(());
        }
        print(|out| {
            writeln!(out)?;
            labelled::write(&report, out)
        })
    }

    /// The mean errors alone; `None` without a label that the model predicts.
    pub fn training_errors(&self) -> Option<TrainingErrors> {
        self.errors.training_errors()
    }

    /// The statistics, which need a label.
    ///
    /// # Errors
    /// No label that the model predicts.
    pub fn report(mut self, input: &Path) -> Result<LabelledReport, CommandError> {
        self.warn(input);
        if self.errors.structures() == 0 {
            return Err(CommandError::Input(format!(
                "{}: no structure has a label; expected energy, forces or stress, or REF_energy and so on",
                input.display()
            )));
        }
        Ok(self.errors.report(BOOTSTRAP))
    }

    /// Warns of the labels of `input` that could not be read. Frames that are added from then on are those of another file.
    pub fn warn(&mut self, input: &Path) {
        if let (number, Some(first)) = std::mem::take(&mut self.unreadable) {
            let frames = count(number, "frame");
            let place = input.display();
            log_and_warn(format_args!("{place}: no statistics of the labels of {frames}: {first}"));
        }
    }
}

/// Each figure as SVG, PNG and the numbers as CSV, each table as CSV, and the captions.
fn write_figures(directory: &Path, report: &LabelledReport) -> Result<(), CommandError> {
    std::fs::create_dir_all(directory).map_err(|error| cannot_create(directory, error))?;
    let mut captions = String::new();
    for FigureEntry { name, title, drawn } in labelled::figures(report, None) {
        let Ok(FigureContent { figure, caption, numbers }) = drawn else { continue };
        captions += &format!("{name}\n{title}. {}\n\n", figures::plain(&caption));
        let path = |extension: &str| directory.join(format!("{name}.{extension}"));
        write_file(&path("svg"), to_svg(&figure).as_bytes())?;
        write_file(&path("png"), &to_png(&figure, RESOLUTION).map_err(CommandError::failed)?)?;
        write_file(&path("csv"), &numbers.into_bytes())?;
    }
    for table in labelled::tables(report) {
        write_file(&directory.join(format!("{}.csv", table.name)), &table.csv().into_bytes())?;
    }
    write_file(&directory.join("captions.txt"), captions.as_bytes())
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), CommandError> {
    let mut file = AtomicFile::create(path)?;
    file.write_all(bytes).map_err(|error| cannot_write(path, error))?;
    file.finish()
}
