//! What labelled structures say, for `calmwalk calm validate --labelled`: the same as `calm score` says of them.

use std::path::Path;

use atoms::FileError;
use tokio_util::sync::CancellationToken;

use super::other_scores::OtherScores;
use super::score_labels::ScoreLabels;
use super::scorer::Scorer;
use crate::calm_validation::FeaturePlanes;
use crate::calm_validation::labelled::LabelledReport;
use crate::cli::CommandError;
use crate::output::{self, Bar};
use crate::xyz_reader::XyzReader;

const BAR: &str = "{bar:32} {percent} %  {eta} left  {msg}";

/// Grades the structures of a file and compares the scores with their labels. Also adds the atoms of those with force labels to `planes`, if
/// they are given. `None` if it was stopped.
///
/// # Errors
/// A structure that cannot be read or graded, with its line; a file without labels.
pub fn report(
    input: &Path,
    scorer: &mut Scorer,
    others: &mut OtherScores,
    mut planes: Option<&mut FeaturePlanes>,
    stop: &CancellationToken,
) -> Result<Option<LabelledReport>, CommandError> {
    let mut frames = XyzReader::open(input).map_err(CommandError::input)?;
    let bar = Bar::new(frames.length, BAR);
    let mut labels = ScoreLabels::new(others.score_columns(), None, false)?;
    let mut count = 0_u64;
    while let Some(frame) = frames.next() {
        if stop.is_cancelled() {
            return Ok(None);
        }
        let frame = frame.map_err(CommandError::input)?;
        let at = |error: &dyn std::fmt::Display| {
            CommandError::Input(format!("{}:{}: {error}", input.display(), frame.line))
        };
        scorer.score(&frame.structure, false).map_err(|error| at(&error))?;
        let columns = others.columns(&frame.structure, scorer).map_err(|error| at(&error))?;
        let has_forces = labels.add(&frame, scorer, &columns, None)?;
        if let Some(planes) = planes.as_deref_mut().filter(|_| has_forces) {
            planes.add(&scorer.elements, scorer.features(), &scorer.grades.gamma);
        }
        count += 1;
        bar.set(frames.position(), || output::count(count, "frame"));
    }
    if count == 0 {
        return Err(CommandError::input(FileError::Empty(input.to_owned())));
    }
    drop(bar);
    labels.report(input).map(Some)
}
