//! The figures, one per file.

mod bond_scans;
mod defects;
mod feature_space;
mod layout;
mod solutions;
mod structures;

use super::defects::DefectKind;
use super::{Validation, labelled};
use crate::page::FigureEntry;

/// All figures, in the order of the page.
pub fn all(validation: &Validation) -> Vec<FigureEntry> {
    let part = |name, title, drawn| FigureEntry { name, title, drawn };
    let defects = |name, kind| defects::draw(validation, name, kind);
    let mut figures = vec![
        part("bond-scans", "Compression and stretching", bond_scans::draw(validation)),
        part("vacancies", "Vacancies", defects("vacancies", DefectKind::Vacancy)),
        part("surfaces", "Surfaces", defects("surfaces", DefectKind::Surface)),
        part("grain-boundaries", "Grain boundaries", defects("grain-boundaries", DefectKind::GrainBoundary)),
        part("structures", "Atoms at defects", structures::draw(validation)),
        part("solutions", "Solid solutions", solutions::draw(validation)),
        part("feature-space", "Components in the feature space", feature_space::draw(validation)),
    ];
    figures.extend(validation.labelled.iter().flat_map(labelled::figures));
    let mixtures = |report| labelled::mixtures_figure(&validation.mixtures, report);
    figures.extend(validation.labelled.iter().filter_map(mixtures));
    let map = |report| labelled::mixture_map(&validation.mixtures, report);
    figures.extend(validation.labelled.iter().filter_map(map));
    figures
}
