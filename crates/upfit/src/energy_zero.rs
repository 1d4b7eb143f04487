//! The zero of the energies: codes count energies from different zeros, and a fit to energies far from the model's would
//! first have to learn a constant of each element.

use std::collections::BTreeSet;

use analysis::{EnergyOffsets, LabelledEnergy, quantile};
use atoms::{Species, element_symbol};
use potentials::grace::WeightGroup;
use serde::{Deserialize, Serialize};

use crate::collinearity::{Collinearity, MAX_CONDITION};

/// Smaller shifts are errors of the model and no other zero, eV/atom.
const SAME_ZERO: f64 = 0.1;
/// Differences per atom that vary by less than this are a constant, eV/atom.
const CONSTANT: f64 = 0.1;
/// The share of the structures of which that is asked.
const CONSTANT_SHARE: f64 = 0.9;

/// Largest share of the error of a label that shifts may take up. Of one with more, the residual would show hardly anything.
const MAX_LEVERAGE: f64 = 0.9;

/// The weights that are added to the energy of each atom of an element.
const SHIFTS: &str = "shift_values";

/// How the zero of the model's energies was moved to that of the labels.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EnergyZero {
    /// What was added for each atom of an element; empty if the zeros were the same.
    pub shifts: Vec<ElementShift>,
    /// Whether the compositions did not determine the elements' own shifts, so that all are the same.
    pub is_constant: bool,
}

/// The shift of an element.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ElementShift {
    /// Its symbol.
    pub element: String,
    /// eV/atom.
    pub shift: f64,
}

/// Why the zero cannot be moved.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EnergyZeroFault {
    /// Compositions that do not distinguish elements, and differences that vary.
    #[error(
        "the labels' energies have another zero than the model's: they differ by {median:.3} eV/atom (median), and the compositions of \
         {structures} structures do not determine the shifts of {elements}: {reason}. Subtract the energies of the atoms from the \
         labels, or add structures of other compositions"
    )]
    Undetermined {
        /// Label − model, eV/atom.
        median: f64,
        /// Number of structures.
        structures: usize,
        /// Symbols of those whose shifts are not determined.
        elements: String,
        /// Why they are not, with what is expected.
        reason: String,
    },
    /// A model without shifts by element.
    #[error(
        "the labels' energies have another zero than the model's, and the model has no 'shift_values' for {expected} elements to move it; \
         subtract the difference from the labels"
    )]
    NoShifts {
        /// Number of the model's elements.
        expected: usize,
    },
}

impl EnergyZero {
    /// Fits the shifts of the elements to the differences per atom. They are zero where labels and model have the same zero, up to
    /// 0.1 eV/atom. If the compositions do not determine the shifts, a difference that is the same for all structures is taken
    /// for each element. [`Collinearity`] has the criterion for the structures that are no outliers; an element must have some of
    /// these, and no shift may depend on one of them alone. `places` are those of the structures, for the message.
    ///
    /// # Errors
    /// Compositions that do not determine the shifts, and a difference that is not the same for all structures.
    pub fn find(energies: &[LabelledEnergy], places: &[&str]) -> Result<Self, EnergyZeroFault> {
        let elements = elements(energies);
        let weak = match determined_shifts(energies, &elements, places) {
            Ok(shifts) => return Ok(Self::new(shifts, false)),
            Err(weak) => weak,
        };
        let atoms = |label: &LabelledEnergy| -> f64 {
            label.composition.iter().map(|(_, number)| f64::from(*number)).sum()
        };
        let differences = energies.iter().map(|label| (label.label - label.model) / atoms(label));
        let (median, sizes) = (quantile_of(differences.clone(), 0.5), differences.clone().map(f64::abs));
        let spread = quantile_of(differences.map(|difference| (difference - median).abs()), CONSTANT_SHARE);
        if quantile_of(sizes, 0.5) <= SAME_ZERO {
            return Ok(Self::default());
        }
        if spread > CONSTANT {
            let symbols: Vec<_> = weak.elements.into_iter().map(element_symbol).collect();
            return Err(EnergyZeroFault::Undetermined {
                median,
                structures: energies.len(),
                elements: symbols.join(", "),
                reason: weak.reason,
            });
        }
        Ok(Self::new(elements.into_iter().map(|element| (element, median)).collect(), true))
    }

    /// With these shifts by atomic number, unless all are small.
    fn new(shifts: Vec<(u8, f64)>, is_constant: bool) -> Self {
        if shifts.iter().all(|(_, shift)| shift.abs() <= SAME_ZERO) {
            return Self::default();
        }
        let shift = |(element, shift)| ElementShift { element: element_symbol(element).to_owned(), shift };
        Self { shifts: shifts.into_iter().map(shift).collect(), is_constant }
    }

    /// The shift of all atoms of a composition, eV.
    pub(crate) fn of(&self, composition: &[(u8, u32)]) -> f64 {
        composition
            .iter()
            .map(|(element, number)| f64::from(*number) * self.of_element(element_symbol(*element)))
            .sum()
    }

    /// Adds the shifts to the weights of a model with these groups and elements. Elements without structures keep theirs.
    ///
    /// # Errors
    /// A model without one shift for each element.
    pub(crate) fn apply(
        &self,
        weights: &mut [f64],
        groups: &[WeightGroup],
        elements: &[Species],
    ) -> Result<(), EnergyZeroFault> {
        if self.shifts.is_empty() {
            return Ok(());
        }
        let group = groups.iter().find(|group| group.name == SHIFTS && group.range.len() == elements.len());
        let group = group.ok_or(EnergyZeroFault::NoShifts { expected: elements.len() })?;
        for (weight, element) in weights[group.range.clone()].iter_mut().zip(elements) {
            *weight += self.of_element(element.symbol());
        }
        Ok(())
    }

    fn of_element(&self, symbol: &str) -> f64 {
        self.shifts.iter().find(|shift| shift.element == symbol).map_or(0.0, |shift| shift.shift)
    }
}

/// Elements whose shifts are not determined, and why.
struct WeakElements {
    elements: Vec<u8>,
    reason: String,
}

/// Elements of all structures, ascending.
fn elements(energies: &[LabelledEnergy]) -> Vec<u8> {
    let each = energies.iter().flat_map(|label| label.composition.iter().map(|(element, _)| *element));
    each.collect::<BTreeSet<_>>().into_iter().collect()
}

/// The shift of each element, if the compositions determine all of them well.
fn determined_shifts(
    energies: &[LabelledEnergy],
    elements: &[u8],
    places: &[&str],
) -> Result<Vec<(u8, f64)>, WeakElements> {
    let weak = |elements: Vec<u8>, reason: String| Err(WeakElements { elements, reason });
    let fit = match EnergyOffsets::fit(energies) {
        Ok(fit) => fit,
        Err(few) => {
            let reason = format!("expected at least {} structures with energies", few.needed);
            return weak(elements.to_vec(), reason);
        }
    };
    let used: Vec<_> =
        energies.iter().zip(fit.used()).filter(|(_, used)| **used).map(|(label, _)| label.clone()).collect();
    let of_used = self::elements(&used);
    let missing: Vec<_> = elements.iter().copied().filter(|element| !of_used.contains(element)).collect();
    if !missing.is_empty() {
        let reason = "the energies of all structures with them are outliers, expected one that is none";
        return weak(missing, reason.to_owned());
    }
    let Collinearity { condition, elements } = Collinearity::of(&used, &of_used);
    if !elements.is_empty() {
        let reason = format!("their condition number is {condition:.1e}, expected at most {MAX_CONDITION}");
        return weak(elements, reason);
    }
    let decides = |label: &LabelledEnergy| fit.support(&label.composition) * MAX_LEVERAGE < 1.0;
    let alone = energies.iter().zip(fit.used()).position(|(label, used)| *used && decides(label));
    if let Some(alone) = alone {
        let place = places.get(alone).copied().unwrap_or("one structure");
        let elements = energies[alone].composition.iter().map(|(element, _)| *element).collect();
        return weak(
            elements,
            format!("{place} alone decides them, expected at least one more such structure"),
        );
    }
    Ok(fit.elements().map(|found| (found.element, found.offset)).collect())
}

/// A quantile; 0 without numbers.
pub fn quantile_of(numbers: impl Iterator<Item = f64>, q: f64) -> f64 {
    let mut ascending: Vec<_> = numbers.collect();
    ascending.sort_by(f64::total_cmp);
    quantile(&ascending, q).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Structures with these numbers of Al and Ni, and differences that `shift` gives.
    fn energies(compositions: &[(u32, u32)], shift: impl Fn(f64, f64) -> f64) -> Vec<LabelledEnergy> {
        let energy = |(al, ni): &(u32, u32)| {
            let composition = [(13, *al), (28, *ni)].into_iter().filter(|(_, number)| *number > 0).collect();
            let model = -3.4 * f64::from(al + ni);
            LabelledEnergy { composition, model, label: model + shift(f64::from(*al), f64::from(*ni)) }
        };
        compositions.iter().map(energy).collect()
    }

    fn find(energies: &[LabelledEnergy]) -> Result<EnergyZero, EnergyZeroFault> {
        let places: Vec<_> = (1..=energies.len()).map(|line| format!("a.xyz:{line}")).collect();
        EnergyZero::find(energies, &places.iter().map(String::as_str).collect::<Vec<_>>())
    }

    const ALLOYS: [(u32, u32); 5] = [(4, 0), (3, 1), (1, 3), (0, 4), (2, 2)];
    const ONE_ALLOY: [(u32, u32); 4] = [(2, 2), (4, 4), (8, 8), (1, 1)];

    #[test]
    fn each_element_has_its_shift() {
        let zero = find(&energies(&ALLOYS, |al, ni| -100.0 * al + 7.0 * ni)).unwrap();
        assert!(!zero.is_constant && zero.shifts.len() == 2);
        assert!((zero.of(&[(13, 2), (28, 1)]) + 193.0).abs() < 1e-9, "{zero:?}");

        let groups = [WeightGroup { name: SHIFTS.into(), shape: vec![3], range: 1..4 }];
        let elements = [28, 1, 13].map(|element| Species::from_atomic_number(element).unwrap());
        let mut weights = [1.0; 5];
        zero.apply(&mut weights, &groups, &elements).unwrap();
        for (weight, expected) in weights.iter().zip([1.0, 8.0, 1.0, -99.0, 1.0]) {
            assert!((weight - expected).abs() < 1e-9, "{weights:?}");
        }
        let fault = zero.apply(&mut weights, &groups, &elements[..2]).unwrap_err();
        assert!(fault.to_string().contains("no 'shift_values' for 2 elements"), "{fault}");
    }

    #[test]
    fn errors_of_the_model_are_no_other_zero() {
        for compositions in [&ALLOYS[..], &ONE_ALLOY] {
            let zero = find(&energies(compositions, |al, ni| 0.05 * al - 0.02 * ni)).unwrap();
            assert_eq!(zero, EnergyZero::default());
        }
        assert_eq!(find(&[]).unwrap(), EnergyZero::default());
    }

    #[test]
    fn a_constant_needs_no_compositions() {
        for compositions in [&ONE_ALLOY[..], &ONE_ALLOY[..1]] {
            let zero = find(&energies(compositions, |al, ni| 5.0 * (al + ni))).unwrap();
            assert!(zero.is_constant && (zero.of(&[(28, 3)]) - 15.0).abs() < 1e-9, "{zero:?}");
        }
    }

    #[test]
    fn shifts_that_are_not_determined_are_refused() {
        let energies = energies(&ONE_ALLOY, |al, ni| (al + ni) * (5.0 + 0.3 * al));
        let fault = find(&energies).unwrap_err().to_string();
        assert!(
            fault.contains("the compositions of 4 structures") && fault.contains("Al, Ni: their"),
            "{fault}"
        );
        let fault = find(&energies[..2]).unwrap_err().to_string();
        assert!(fault.contains("expected at least 3 structures"), "{fault}");
    }

    #[test]
    fn compositions_that_hardly_differ_do_not_determine_shifts() {
        let zeros = |al: f64, ni: f64| -100.0 * al + 7.0 * ni;
        let close = energies(&[(50, 50), (51, 49), (49, 51), (50, 50)], zeros);
        let fault = find(&close).unwrap_err().to_string();
        assert!(fault.contains("Al, Ni: their condition number is 7.1e1, expected at most 30"), "{fault}");
        let apart = energies(&[(50, 50), (60, 40), (40, 60), (50, 50)], zeros);
        assert!((find(&apart).unwrap().of(&[(13, 1)]) + 100.0).abs() < 1e-6);
    }

    #[test]
    fn an_element_whose_structures_are_all_outliers_is_named() {
        // Energies beyond 10⁷ eV/atom count for nothing.
        let mut energies = energies(&[(4, 0), (3, 0), (2, 0), (0, 4)], |al, ni| 5.0 * al + 1e9 * ni);
        energies[1].label += 9.0;
        let fault = find(&energies).unwrap_err().to_string();
        assert!(fault.contains("the shifts of Ni: the energies of all structures with them"), "{fault}");
    }

    /// Otherwise an absurd energy would be fitted exactly, and no residual would show it.
    #[test]
    fn no_shift_depends_on_one_structure() {
        let mut compositions = vec![(4, 2); 199];
        compositions.push((0, 3));
        let other_zeros = |al: f64, ni: f64| -13.0 * al - 430.0 * ni;
        let fault = find(&energies(&compositions, other_zeros)[100..]).map(|zero| zero.is_constant);
        assert_eq!(fault, Ok(true), "the others have a constant difference");
        // A wrong energy remains where it is.
        let mut wrong = energies(&compositions, |_, _| 0.0);
        wrong[199].label += 450.0;
        assert_eq!(find(&wrong), Ok(EnergyZero::default()));
        // Two such structures decide together, and a wrong one of three is an outlier.
        compositions.push((0, 6));
        let zero = find(&energies(&compositions, other_zeros)).unwrap();
        assert!(
            (zero.of(&[(13, 1)]) + 13.0).abs() < 1e-6 && (zero.of(&[(28, 1)]) + 430.0).abs() < 1e-6,
            "{zero:?}"
        );
        compositions.push((0, 9));
        let mut wrong = energies(&compositions, other_zeros);
        wrong[199].label += 450.0;
        let zero = find(&wrong).unwrap();
        assert!((zero.of(&[(28, 1)]) + 430.0).abs() < 1e-6, "{zero:?}");
        // Where the others differ too, the structure is named.
        let varied: Vec<_> = (1..30).map(|number| (number, number)).chain([(0, 3)]).collect();
        let fault = find(&energies(&varied, |al, ni| 0.02 * al * al - 430.0 * ni)).unwrap_err().to_string();
        assert!(fault.contains("the shifts of Ni: a.xyz:30 alone decides them"), "{fault}");
    }

    /// What is left out of the fit tells no elements apart.
    #[test]
    fn outliers_do_not_determine_compositions() {
        let mut compositions = vec![(2, 2); 20];
        compositions.extend([(4, 0), (0, 4)]);
        let mut labels = energies(&compositions, |al, ni| 5.0 * al + 7.0 * ni);
        labels[20].label += 4e3;
        labels[21].label -= 9e3;
        let zero = find(&labels).unwrap();
        assert!(zero.is_constant && (zero.of(&[(13, 1)]) - 6.0).abs() < 1e-9, "{zero:?}");
    }
}
