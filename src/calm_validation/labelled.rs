//! What labelled structures say about the scores of atoms, such as γ and γ_nbr: how well they rank force errors, and what
//! a limit of the score keeps (paper, sections on the threshold and SI). [`LabelledErrors`] reads one graded structure
//! after another, with bounded memory; [`LabelledReport`] has the numbers, of which `tables` and `figures` are drawn.

mod collect;
mod composition_tables;
mod deviations;
mod estimate;
mod figures;
mod mixtures;
mod report;
mod score_name;
mod sets;
mod tables;
#[cfg(test)]
mod tests;

pub use self::collect::{LabelledErrors, LabelledStructure, ScoreColumn};
pub use self::estimate::BOOTSTRAP;
pub use self::figures::{all as figures, error_grid, mixture_map, mixtures as mixtures_figure};
pub use self::mixtures::{ComparedMixture, table as mixtures_table};
pub use self::report::{LabelledReport, TrainingErrors};
pub use self::sets::{ComparedModel, LabelledSet, table as sets_table};
pub use self::tables::{all as tables, write, write_table};
