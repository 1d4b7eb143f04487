//! The name of a score in a table.

use super::report::ScoreReport;
use crate::page::{TableCell, text};
/// The name of a score without markup, which cells do not support.
pub(super) fn name(score: &ScoreReport) -> TableCell {
    text(::figures::plain(&score.name))
}
