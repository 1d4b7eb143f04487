//! Errors and scores by element, and by the composition of structures.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use analysis::{quantile, spearman};
use atoms::element_symbol;

use super::super::collect::{SampledAtom, ScoreColumn};
use super::super::report::{CompositionGroup, CompositionScan, ElementErrors, ErrorSpread, ScoreMean};
use super::StructureEnergyError;

/// Groups are one of this number of equal steps of the share apart.
const STEPS: usize = 10;
/// Elements whose share is scanned.
const MAX_ELEMENTS: usize = 6;
/// Quantiles of an error.
const LEVELS: [f64; 5] = [0.1, 0.25, 0.5, 0.75, 0.9];

/// By ascending atomic number.
pub fn by_element(atoms: &[&SampledAtom], columns: &[ScoreColumn]) -> Vec<ElementErrors> {
    let mut elements: BTreeMap<u8, Vec<&SampledAtom>> = BTreeMap::new();
    for atom in atoms {
        elements.entry(atom.species.atomic_number()).or_default().push(atom);
    }
    let element = |(number, atoms): (u8, Vec<&SampledAtom>)| {
        let errors: Vec<_> = atoms.iter().map(|atom| atom.error).collect();
        let rank = |k| spearman(&atoms.iter().map(|atom| atom.scores[k]).collect::<Vec<_>>(), &errors);
        Some(ElementErrors {
            element: element_symbol(number),
            atoms: atoms.len(),
            scores: score_means(&atoms, columns),
            spearman: (0..columns.len()).map(rank).collect(),
            forces: ErrorSpread::new(errors)?,
        })
    };
    elements.into_iter().filter_map(element).collect()
}

/// By the share of each of the elements with the most atoms in a structure. Of two elements, the heavier one is enough.
pub fn by_composition(
    atoms: &[&SampledAtom],
    structures: &[StructureEnergyError],
    columns: &[ScoreColumn],
) -> Vec<CompositionScan> {
    let scan = |element: u8| {
        let mut groups = vec![GroupMembers::default(); STEPS + 1];
        for (structure, energy) in structures {
            let group = &mut groups[step(&structure.composition, element)];
            group.structures += 1;
            group.energies.extend(*energy);
        }
        for atom in atoms {
            groups[step(&atom.composition, element)].atoms.push(atom);
        }
        let groups = groups.into_iter().enumerate().filter(|(_, group)| group.structures > 0);
        let group = |(step, members): (usize, GroupMembers)| members.group(step, columns);
        CompositionScan { element: element_symbol(element), groups: groups.map(group).collect() }
    };
    scanned(structures).into_iter().map(scan).collect()
}

/// Spearman's ρ of the mean score of a structure and the absolute error of its energy.
pub fn energy_rank(structures: &[StructureEnergyError], column: usize) -> Option<f64> {
    let pairs = structures.iter().filter_map(|(structure, energy)| {
        let score = structure.scores.get(column).copied().filter(|score| score.is_finite())?;
        Some((score, energy.filter(|error| error.is_finite())?))
    });
    let (scores, errors): (Vec<_>, Vec<_>) = pairs.unzip();
    spearman(&scores, &errors)
}

/// Elements whose share differs between structures, those with the most atoms first.
fn scanned(structures: &[StructureEnergyError]) -> Vec<u8> {
    let mut totals: BTreeMap<u8, u64> = BTreeMap::new();
    for (element, atoms) in structures.iter().flat_map(|(structure, _)| structure.composition.iter()) {
        *totals.entry(*element).or_default() += u64::from(*atoms);
    }
    if totals.len() == 2 {
        totals.pop_first();
    }
    let differs = |element: &u8| {
        let mut steps = structures.iter().map(|(structure, _)| step(&structure.composition, *element));
        let first = steps.next();
        steps.any(|step| Some(step) != first)
    };
    let mut elements: Vec<_> = totals.into_iter().collect();
    elements.sort_by_key(|(element, atoms)| (Reverse(*atoms), *element));
    elements.into_iter().map(|(element, _)| element).filter(differs).take(MAX_ELEMENTS).collect()
}

/// The nearest step of the share of an element.
fn step(composition: &[(u8, u32)], element: u8) -> usize {
    let all: u32 = composition.iter().map(|(_, atoms)| atoms).sum();
    let of = composition.iter().find(|(other, _)| *other == element).map_or(0, |(_, atoms)| *atoms);
    (STEPS as f64 * f64::from(of) / f64::from(all.max(1))).round() as usize
}

/// The sampled structures and atoms of a step.
#[derive(Clone, Default)]
struct GroupMembers<'a> {
    structures: usize,
    /// Absolute errors per atom without the offsets of elements, eV.
    energies: Vec<f64>,
    atoms: Vec<&'a SampledAtom>,
}

impl GroupMembers<'_> {
    fn group(self, step: usize, columns: &[ScoreColumn]) -> CompositionGroup {
        CompositionGroup {
            share: step as f64 / STEPS as f64,
            structures: self.structures,
            energy: ErrorSpread::new(self.energies),
            atoms: self.atoms.len(),
            forces: ErrorSpread::new(self.atoms.iter().map(|atom| atom.error).collect()),
            scores: score_means(&self.atoms, columns),
        }
    }
}

/// Mean of each score, and the share beyond its limit; none without atoms.
fn score_means(atoms: &[&SampledAtom], columns: &[ScoreColumn]) -> Vec<ScoreMean> {
    if atoms.is_empty() {
        return Vec::new();
    }
    let number = atoms.len() as f64;
    let of = |(k, column): (usize, &ScoreColumn)| ScoreMean {
        mean: atoms.iter().map(|atom| atom.scores[k]).sum::<f64>() / number,
        beyond: column
            .limit
            .map(|limit| atoms.iter().filter(|atom| atom.scores[k] > limit).count() as f64 / number),
    };
    columns.iter().enumerate().map(of).collect()
}

impl ErrorSpread {
    /// Of absolute errors; `None` without finite ones.
    fn new(mut errors: Vec<f64>) -> Option<Self> {
        errors.retain(|error| error.is_finite());
        errors.sort_by(f64::total_cmp);
        let median = quantile(&errors, 0.5)?;
        Some(Self {
            number: errors.len(),
            mean: errors.iter().sum::<f64>() / errors.len() as f64,
            quantiles: LEVELS.map(|level| quantile(&errors, level).unwrap_or(median)),
        })
    }
}
