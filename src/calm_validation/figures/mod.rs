//! The figures, one per file.

mod bond_scans;
mod defects;
mod feature_space;
mod layout;
mod solutions;
mod structures;

use super::defects::DefectKind;
use super::labelled::LabelledSet;
use super::set_names::of_set;
use super::{Validation, labelled};
use crate::page::FigureEntry;

/// All figures, in the order of the page.
pub fn all(validation: &Validation) -> Vec<FigureEntry> {
    let part = |name: &'static str, title, drawn| FigureEntry { name: name.into(), title, drawn };
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
    figures.extend(labelled::error_grid(&validation.labelled));
    let training = validation.training.as_ref().and_then(|training| training.errors);
    for (number, LabelledSet { report, mixtures, .. }) in validation.labelled.iter().enumerate() {
        let mut parts = labelled::figures(report, training);
        parts.extend(labelled::mixtures_figure(mixtures, report));
        parts.extend(labelled::mixture_map(mixtures, report));
        parts.iter_mut().for_each(|part| rename(part, number));
        figures.extend(parts);
    }
    figures
}

/// Gives a figure the name that it has for this set of labelled structures.
fn rename(part: &mut FigureEntry, number: usize) {
    part.name = of_set(&part.name, number).into();
    if let Ok(content) = &mut part.drawn {
        content.figure.name = of_set(&content.figure.name, number);
    }
}
