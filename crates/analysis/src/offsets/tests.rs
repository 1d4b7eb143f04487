use proptest::prelude::*;

use super::*;

const H: u8 = 1;
const O: u8 = 8;
const SI: u8 = 14;
const GE: u8 = 32;

/// A label with the energy of the model plus these offsets and an error of `error` eV/atom.
fn label(composition: &[(u8, u32)], offsets: &[(u8, f64)], error: f64) -> LabelledEnergy {
    let atoms: u32 = composition.iter().map(|(_, number)| number).sum();
    let offset = |element: u8| offsets.iter().find(|(other, _)| *other == element).unwrap().1;
    let shift: f64 = composition.iter().map(|(element, number)| f64::from(*number) * offset(*element)).sum();
    let model = -4.5 * f64::from(atoms);
    LabelledEnergy {
        composition: composition.to_vec(),
        model,
        label: model + shift + error * f64::from(atoms),
    }
}

fn offsets(fit: &EnergyOffsets) -> Vec<(u8, f64, bool)> {
    fit.elements().map(|offset| (offset.element, offset.offset, offset.is_separate)).collect()
}

fn assert_near(found: f64, expected: f64, tolerance: f64) {
    assert!((found - expected).abs() <= tolerance, "{found} is not {expected} ± {tolerance}");
}

#[test]
fn the_offset_of_one_element_is_the_mean_difference() {
    let zeros = [(SI, -107.25)];
    let labels: Vec<_> = [-0.02, 0.0, 0.05].iter().map(|error| label(&[(SI, 8)], &zeros, *error)).collect();
    let fit = EnergyOffsets::fit(&labels).unwrap();
    assert_eq!((fit.structures(), fit.left_out()), (3, 0));
    let [(SI, offset, true)] = offsets(&fit)[..] else { panic!("{:?}", offsets(&fit)) };
    assert_near(offset, -107.24, 1e-10);
    // The label is 0.05 eV above model plus true offsets, and 0.04 eV above the fit.
    assert_near(fit.error_per_atom(&labels[2], 2.0).unwrap(), -0.04, 1e-10);
    assert_near(fit.support(&[(SI, 64)]), 3.0, 1e-10);
    // Another element has no support.
    assert_eq!(fit.support(&[(GE, 1)]), 0.0);
    assert_eq!(fit.error_per_atom(&label(&[(GE, 1)], &[(GE, 0.0)], 0.0), 0.0), None);
}

#[test]
fn elements_are_distinguished_by_compositions() {
    let zeros = [(O, -432.0), (SI, -107.0)];
    let compositions: [&[(u8, u32)]; 6] = [
        &[(SI, 8)],
        &[(O, 2), (SI, 1)],
        &[(O, 8), (SI, 4)],
        &[(SI, 64)],
        &[(O, 1), (SI, 1)],
        &[(O, 6), (SI, 4)],
    ];
    let labels: Vec<_> = compositions.iter().map(|composition| label(composition, &zeros, 0.0)).collect();
    let fit = EnergyOffsets::fit(&labels).unwrap();
    for ((_, found, separate), (_, expected)) in offsets(&fit).into_iter().zip(zeros) {
        assert_near(found, expected, 1e-9);
        assert!(separate);
    }
}

#[test]
fn too_few_labels_give_no_fit() {
    let zeros = [(O, 1.0), (SI, 2.0)];
    let labels = [label(&[(O, 2), (SI, 1)], &zeros, 0.0), label(&[(SI, 4)], &zeros, 0.0)];
    assert_eq!(EnergyOffsets::fit(&labels), Err(TooFewLabels { structures: 2, needed: 3 }));
    assert_eq!(EnergyOffsets::fit(&[]), Err(TooFewLabels { structures: 0, needed: 2 }));
    let one = label(&[(SI, 4)], &zeros, 0.0);
    assert_eq!(EnergyOffsets::fit(&[one]), Err(TooFewLabels { structures: 1, needed: 2 }));
}

/// With only SiO₂, only O₂ + Si is determined; the minimum-norm offsets that add up to it have the ratio 2 : 1.
#[test]
fn where_compositions_are_all_the_same_only_their_sum_is_known() {
    let zeros = [(O, -432.0), (SI, -107.0)];
    let labels: Vec<_> = (1..5).map(|n| label(&[(O, 2 * n), (SI, n)], &zeros, 0.0)).collect();
    let fit = EnergyOffsets::fit(&labels).unwrap();
    let [(O, oxygen, false), (SI, silicon, false)] = offsets(&fit)[..] else { panic!("{:?}", offsets(&fit)) };
    assert_near(2.0 * oxygen + silicon, -971.0, 1e-9);
    assert_near(oxygen, 2.0 * silicon, 1e-9);
    assert_near(fit.error_per_atom(&label(&[(O, 40), (SI, 20)], &zeros, 0.25), 2.0).unwrap(), -0.25, 1e-9);
    assert_near(fit.support(&[(O, 2), (SI, 1)]), 4.0, 1e-9);
    // Another stoichiometry cannot be predicted.
    assert_eq!(fit.support(&[(O, 1), (SI, 1)]), 0.0);
    assert_eq!(fit.error_per_atom(&label(&[(O, 1), (SI, 1)], &zeros, 0.0), 0.0), None);
}

#[test]
fn two_elements_that_always_come_together_do_not_spoil_a_third() {
    let zeros = [(H, -13.0), (O, -432.0), (SI, -107.0)];
    let compositions: [&[(u8, u32)]; 6] = [
        &[(SI, 8)],
        &[(SI, 16)],
        &[(H, 2), (O, 1), (SI, 8)],
        &[(H, 4), (O, 2), (SI, 8)],
        &[(H, 2), (O, 1), (SI, 4)],
        &[(H, 6), (O, 3), (SI, 8)],
    ];
    let labels: Vec<_> = compositions.iter().map(|composition| label(composition, &zeros, 0.0)).collect();
    let fit = EnergyOffsets::fit(&labels).unwrap();
    let found = offsets(&fit);
    assert_eq!(found.iter().map(|(_, _, separate)| *separate).collect::<Vec<_>>(), [false, false, true]);
    assert_near(found[2].1, -107.0, 1e-8);
    assert_near(2.0 * found[0].1 + found[1].1, -458.0, 1e-8);
}

#[test]
fn an_outlier_does_not_move_the_fit() {
    let zeros = [(SI, -107.0)];
    let mut labels: Vec<_> = (0..4).map(|k| label(&[(SI, 8)], &zeros, 0.01 * f64::from(k))).collect();
    let before = EnergyOffsets::fit(&labels).unwrap();
    for outlier in [3.0, -1e3, 1e6, 1e9, 1e290, -1e300, f64::NAN, f64::INFINITY] {
        labels.push(label(&[(SI, 8)], &zeros, outlier));
        let fit = EnergyOffsets::fit(&labels).unwrap();
        assert_eq!((fit.structures(), fit.left_out()), (4, 1), "{outlier}");
        assert_eq!(offsets(&fit), offsets(&before));
        labels.pop();
    }
}

/// Two outliers of five: the breakdown point.
#[test]
fn as_long_as_most_labels_are_good_the_fit_is() {
    let zeros = [(SI, -107.0)];
    let errors = [0.0, 0.02, -0.02, 5e4, 6e4];
    let labels: Vec<_> = errors.iter().map(|error| label(&[(SI, 2)], &zeros, *error)).collect();
    let fit = EnergyOffsets::fit(&labels).unwrap();
    assert_eq!((fit.structures(), fit.left_out()), (3, 2));
    assert_near(offsets(&fit)[0].1, -107.0, 1e-9);
}

/// The only structure with an element may be wrong, which is undetectable: the element is undetermined, the
/// others unaffected.
#[test]
fn what_a_single_structure_says_of_an_element_is_not_believed() {
    let zeros = [(SI, -107.0), (GE, -2000.0)];
    let mut labels: Vec<_> = (1..8).map(|n| label(&[(SI, 8 * n)], &zeros, 0.01)).collect();
    labels.push(label(&[(GE, 1), (SI, 31)], &zeros, 5e5));
    let fit = EnergyOffsets::fit(&labels).unwrap();
    assert_near(offsets(&fit)[0].1, -106.99, 1e-6);
    assert!(fit.support(&[(GE, 1), (SI, 31)]) < 1.1, "{}", fit.support(&[(GE, 1), (SI, 31)]));
    assert_eq!(fit.error_per_atom(&labels[7], 2.0), None);
    assert!(fit.error_per_atom(&labels[0], 2.0).is_some());
}

/// Outliers among few structures with a rare element whose offset differs strongly.
#[test]
fn a_rare_element_is_no_outlier() {
    let zeros = [(SI, -107.0), (GE, -56_000.0)];
    let mut labels: Vec<_> = (0..500).map(|k| label(&[(SI, 32)], &zeros, 1e-3 * f64::from(k % 7))).collect();
    (0..4).for_each(|_| labels.push(label(&[(GE, 1), (SI, 31)], &zeros, 0.003)));
    let fit = EnergyOffsets::fit(&labels).unwrap();
    assert_eq!((fit.structures(), fit.left_out()), (504, 0));
    assert_near(offsets(&fit)[1].1, -56_000.0, 0.1);
    assert_near(fit.support(&[(GE, 1), (SI, 31)]), 4.0, 0.1);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    /// Errors do not depend on the offsets: they equal those of labels with the model's own zero.
    #[test]
    fn zeros_of_elements_do_not_change_errors(
        seed in 0_u32..1000,
        zeros in prop::collection::vec(-5e4_f64..5e4, 3),
    ) {
        let zeros: Vec<_> = [H, O, SI].into_iter().zip(zeros).collect();
        let none = [(H, 0.0), (O, 0.0), (SI, 0.0)];
        let number = |k: u32| (k.wrapping_mul(2_654_435_761).wrapping_add(seed * 97) >> 7) % 1000;
        let composition = |k: u32| vec![(H, 1 + number(k) % 5), (O, 1 + number(k + 50) % 7), (SI, 1 + number(k + 99) % 3)];
        let error = |k: u32| 1e-3 * f64::from(number(k + 200)) - 0.5;
        let labels = |zeros: &[(u8, f64)]| -> Vec<_> {
            (0..30).map(|k| label(&composition(k), zeros, error(k))).collect()
        };
        let (moved, plain) = (labels(&zeros), labels(&none));
        let (fit, reference) = (EnergyOffsets::fit(&moved).unwrap(), EnergyOffsets::fit(&plain).unwrap());
        prop_assert_eq!(fit.structures(), 30);
        for (label, plain) in moved.iter().zip(&plain) {
            let (found, expected) = (fit.error_per_atom(label, 2.0), reference.error_per_atom(plain, 2.0));
            prop_assert_eq!(found.is_some(), expected.is_some());
            if let (Some(found), Some(expected)) = (found, expected) {
                prop_assert!((found - expected).abs() < 1e-6, "{} {}", found, expected);
            }
        }
    }
}
