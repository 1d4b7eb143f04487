//! One group of labelled structures: how large the errors are, and how well the grades rank them.

use std::collections::BTreeSet;

use analysis::{Bootstrap, ERROR_THRESHOLDS, SystematicSample, threshold_place};
use atoms::Species;
use serde::Serialize;

use super::super::LARGE_FORCE_ERROR;
use super::super::frames::{ComparedAtom, ComparedFrame, FrameErrors, mean};
use super::ranked_atoms::RankedAtoms;
use super::units::{
    ConfidenceEstimate, MIN_UNITS, NumberedUnits, ResamplingUnits, median, median_range, sorted_values,
};

/// Largest number of atoms of a group whose statistics are computed for every draw. Of more, a systematic sample.
const MAX_DRAWN_ATOMS: usize = 1 << 14;

/// Labelled structures of one kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ComparedGroup {
    /// Their number.
    pub structures: u64,
    /// Structures of the same kind whose labels failed: their errors are unknown.
    pub failed: u64,
    /// Their seed structures and walks, and which of them the bootstrap draws.
    pub units: ResamplingUnits,
    /// Mean kinetic temperature, K.
    pub mean_temperature: Option<f64>,
    /// Mean V/V₀.
    pub mean_relative_volume: Option<f64>,
    /// Median over the structures of the mean absolute error of their force components, eV/Å.
    pub median_force_mae: ConfidenceEstimate,
    /// The range of that median, whatever the errors of the failed structures are; without an upper end if they are too many.
    pub median_force_mae_between: Option<(f64, Option<f64>)>,
    /// Median over the structures of |E_model − E_label| per atom without the offsets of the elements, eV.
    pub median_energy: ConfidenceEstimate,
    /// Median over the structures of the root mean square error of the stress, eV/Å³.
    pub median_stress: ConfidenceEstimate,
    /// Number of atoms in the sample for the following estimates.
    pub sampled_atoms: u64,
    /// Number of atoms in the sample for their intervals.
    pub resampled_atoms: u64,
    /// Median of |F_model − F_label| over the atoms, eV/Å.
    pub median_error: ConfidenceEstimate,
    /// How well γ ranks the errors.
    pub gamma: GradeRanking,
    /// How well γ_nbr does.
    pub gamma_nbr: GradeRanking,
    /// The same of the atoms of each element, by atomic number.
    pub elements: Vec<ElementRanking>,
}

/// How well a grade under the original mixture ranks force errors.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct GradeRanking {
    /// Spearman's ρ.
    pub spearman: ConfidenceEstimate,
    /// ROC-AUC for errors above each of the thresholds. Intervals take [`MIN_UNITS`] resampled units with an error above it, and as
    /// many with one that is not.
    pub roc_auc: Vec<ConfidenceEstimate>,
}

impl GradeRanking {
    /// The ROC-AUC for errors above one of the thresholds.
    pub fn area_above(&self, threshold: f64) -> ConfidenceEstimate {
        threshold_place(threshold).and_then(|place| self.roc_auc.get(place)).copied().unwrap_or_default()
    }
}

/// Errors and grades of the atoms of an element.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ElementRanking {
    /// Chemical symbol.
    pub element: &'static str,
    /// Number of its atoms in the sample.
    pub sampled_atoms: u64,
    /// Number of resampled units with any of them. Intervals take [`MIN_UNITS`].
    pub units: usize,
    /// Median of |F_model − F_label|, eV/Å.
    pub median_error: ConfidenceEstimate,
    /// How well γ ranks the errors, with the ROC-AUC for errors above 1 eV/Å only.
    pub gamma: GradeRanking,
    /// How well γ_nbr does.
    pub gamma_nbr: GradeRanking,
}

/// The atoms of a group, all of them and by element.
struct GroupAtoms {
    all: RankedAtoms,
    elements: Vec<RankedAtoms>,
}

impl ComparedGroup {
    /// Statistics of structures and of a sample of their atoms. `failed`: number of structures of the same kind whose labels failed.
    pub(super) fn new(
        frames: &[&ComparedFrame],
        atoms: &[&ComparedAtom],
        failed: u64,
        bootstrap: Bootstrap,
    ) -> Self {
        let places = frames.iter().map(|frame| frame.place).chain(atoms.iter().map(|atom| atom.place));
        let units = NumberedUnits::new(places);
        let known = |of: fn(&FrameErrors) -> Option<f64>| {
            frames.iter().filter_map(move |frame| Some((of(&frame.errors)?, frame.place)))
        };
        let of_structures: [fn(&FrameErrors) -> Option<f64>; 3] =
            [|errors| errors.force_mae, |errors| errors.energy, |errors| errors.stress];
        let columns =
            of_structures.map(|of| sorted_values(known(of).map(|(error, place)| (error, units.unit(place)))));
        let mut force_maes: Vec<_> = known(of_structures[0]).map(|(error, _)| error).collect();
        force_maes.sort_by(f64::total_cmp);

        let of_units: Vec<_> = atoms.iter().map(|atom| (*atom, units.unit(atom.place))).collect();
        let elements: BTreeSet<Species> = atoms.iter().map(|atom| atom.species).collect();
        let whole = GroupAtoms::new(&of_units, &elements);
        let drawn = GroupAtoms::new(&thinned(&of_units), &elements);
        let values = |of: &GroupAtoms, multiplicities: &[u32]| {
            let of_structures = columns.iter().map(|column| median(column, multiplicities));
            of_structures.chain(of.values(multiplicities)).collect::<Vec<_>>()
        };
        let estimates = units.estimates(bootstrap, |all| values(&whole, all), |draw| values(&drawn, draw));
        let mut estimates = estimates.into_iter();
        let mut next = || estimates.next().unwrap_or_default();
        let [median_force_mae, median_energy, median_stress] = [next(), next(), next()];
        let (median_error, gamma, gamma_nbr) = rankings(&mut estimates, &drawn.all, &ERROR_THRESHOLDS);
        let element = |(element, (all, drawn)): (&Species, (&RankedAtoms, &RankedAtoms))| {
            let (median_error, gamma, gamma_nbr) = rankings(&mut estimates, drawn, &[LARGE_FORCE_ERROR]);
            let (sampled_atoms, units) = (all.len() as u64, all.units());
            ElementRanking { element: element.symbol(), sampled_atoms, units, median_error, gamma, gamma_nbr }
        };
        Self {
            structures: frames.len() as u64,
            failed,
            units: units.summary,
            mean_temperature: mean(frames.iter().map(|frame| frame.temperature)),
            mean_relative_volume: mean(frames.iter().map(|frame| frame.relative_volume)),
            median_force_mae,
            median_force_mae_between: median_range(&force_maes, failed).filter(|_| failed > 0),
            median_energy,
            median_stress,
            sampled_atoms: whole.all.len() as u64,
            resampled_atoms: drawn.all.len() as u64,
            median_error,
            gamma,
            gamma_nbr,
            elements: elements.iter().zip(whole.elements.iter().zip(&drawn.elements)).map(element).collect(),
        }
    }
}

impl GroupAtoms {
    fn new(atoms: &[(&ComparedAtom, u32)], elements: &BTreeSet<Species>) -> Self {
        let of = |element: &Species| {
            let of: Vec<_> = atoms.iter().copied().filter(|(atom, _)| atom.species == *element).collect();
            RankedAtoms::new(&of)
        };
        Self { all: RankedAtoms::new(atoms), elements: elements.iter().map(of).collect() }
    }

    /// Of all atoms for every threshold, then of each element for large errors.
    fn values(&self, multiplicities: &[u32]) -> Vec<Option<f64>> {
        let mut values = self.all.values(multiplicities, &ERROR_THRESHOLDS);
        for element in &self.elements {
            values.extend(element.values(multiplicities, &[LARGE_FORCE_ERROR]));
        }
        values
    }
}

/// At most [`MAX_DRAWN_ATOMS`] of the atoms.
fn thinned<'a>(atoms: &[(&'a ComparedAtom, u32)]) -> Vec<(&'a ComparedAtom, u32)> {
    let mut sample = SystematicSample::new(MAX_DRAWN_ATOMS);
    atoms.iter().for_each(|atom| sample.add(*atom));
    sample.items().copied().collect()
}

/// The next estimates, in the order of [`RankedAtoms::values`] for these thresholds. They keep their intervals where enough units have
/// any of the atoms `drawn`, and areas where enough units have errors on both sides of the threshold.
fn rankings(
    estimates: &mut impl Iterator<Item = ConfidenceEstimate>,
    drawn: &RankedAtoms,
    thresholds: &[f64],
) -> (ConfidenceEstimate, GradeRanking, GradeRanking) {
    let mut next = |units: usize| {
        let estimate = estimates.next().unwrap_or_default();
        ConfidenceEstimate { interval: estimate.interval.filter(|_| units >= MIN_UNITS), ..estimate }
    };
    let median_error = next(drawn.units());
    let mut ranking = || GradeRanking {
        spearman: next(drawn.units()),
        roc_auc: thresholds.iter().map(|threshold| next(drawn.units_on_both_sides(*threshold))).collect(),
    };
    (median_error, ranking(), ranking())
}
