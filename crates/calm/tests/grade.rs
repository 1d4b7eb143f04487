//! σ, γ, component and γ_nbr against gracemaker; the gradient against finite differences.

use std::f64::consts::PI;
use std::path::Path;
use std::sync::Arc;

use calm::{
    Artifact, Component, ComponentError, Grades, Mixture, NeighbourWeights, Pair, neighbourhood_average,
};

use crate::common::{assert_close, data, indices, niobium, numbers, optional, peer};

/// Both sides compute in f64 from the same f32 inverse; only the order of summation differs.
const TOLERANCE: f64 = 1e-9;

const MODELS: [&str; 6] = [
    "grace1l_tiny",
    "grace1l_tiny_bondcut",
    "grace1l_paper",
    "grace2l_tiny",
    "grace2l_small",
    "grace3l_tiny",
];

#[test]
fn niobium_atoms_have_the_reference_grades() {
    let (mixture, reference) = (niobium().mixture, data("niobium_reference.npz"));
    let features = numbers(&reference, "features");
    let elements = vec![1; features.len() / 130];
    let mut grades = Grades::default();
    grades.evaluate(&mixture, &elements, &features, None).unwrap();
    assert_eq!(grades.component, indices(&reference, "cluster"));
    assert_close("sigma", &grades.sigma, &numbers(&reference, "sigma"), TOLERANCE);
    assert_close("gamma", &grades.gamma, &numbers(&reference, "gamma"), TOLERANCE);
}

#[test]
fn an_absent_element_is_graded_by_its_length() {
    let mixture = niobium().mixture;
    let features = numbers(&data("niobium_reference.npz"), "features");
    let mut grades = Grades::default();
    grades.evaluate(&mixture, &[3], &features[..130], None).unwrap();
    let squared: f64 = features[..130].iter().map(|z| 1e6 * z * z).sum();
    assert_close("gamma", &grades.gamma, &[(squared + 1e-8).sqrt()], 1e-14);
}

#[test]
fn every_model_has_the_reference_grades() {
    for model in MODELS {
        let Some(folder) = peer(&format!("grace/{model}")) else { return };
        let golden = folder.join("golden.npz");
        let export = Artifact::load_export(folder.join("kokkos.npz")).unwrap();
        let mut artifacts = vec![export];
        if folder.join("gmm_artifacts.npz").exists() {
            artifacts.push(Artifact::load(folder.join("gmm_artifacts.npz")).unwrap());
        }
        for artifact in artifacts {
            for structure in 0..15 {
                check_structure(model, &artifact, &golden, &format!("s{structure:02}"));
            }
        }
    }
}

fn check_structure(model: &str, artifact: &Artifact, golden: &Path, structure: &str) {
    let key = |name: &str| format!("{structure}_{name}");
    let elements = element_indices(artifact, &indices(golden, &key("numbers")));
    let features = numbers(golden, &key("features"));
    let mut grades = Grades::default();
    grades.evaluate(&artifact.mixture, &elements, &features, None).unwrap();
    let name = format!("{model} {structure}");
    assert_eq!(grades.component, indices(golden, &key("cluster")), "{name}");
    assert_close(&format!("{name} sigma"), &grades.sigma, &numbers(golden, &key("sigma")), TOLERANCE);
    assert_close(&format!("{name} gamma"), &grades.gamma, &numbers(golden, &key("gamma")), TOLERANCE);
    let pairs = brute_force_pairs(golden, structure, &elements, artifact.symbols.len());
    let averaged = neighbourhood_average(&grades.gamma, pairs).unwrap();
    assert_close(&format!("{name} gamma_nbr"), &averaged, &numbers(golden, &key("gamma_nbr")), TOLERANCE);
}

fn element_indices(artifact: &Artifact, atomic_numbers: &[usize]) -> Vec<usize> {
    let symbol = |number: &usize| match number {
        41 => "Nb",
        42 => "Mo",
        73 => "Ta",
        74 => "W",
        other => panic!("atomic number {other}"),
    };
    let index = |number| artifact.symbols.iter().position(|found| found == symbol(number)).unwrap();
    atomic_numbers.iter().map(index).collect()
}

/// Every pair within its cutoff by testing all images; periodic in all directions unless there is no cell.
fn brute_force_pairs(golden: &Path, structure: &str, elements: &[usize], element_count: usize) -> Vec<Pair> {
    let positions = numbers(golden, &format!("{structure}_positions"));
    let cell = numbers(golden, &format!("{structure}_cell"));
    let export = golden.with_file_name("kokkos.npz");
    let longest = numbers(golden, "cutoff")[0];
    let cutoffs =
        optional(&export, "bond_cutoff_map").unwrap_or_else(|| vec![longest; element_count * element_count]);
    let range = if cell.iter().all(|&value| value == 0.0) { 0 } else { 6 };
    let mut pairs = Vec::new();
    for (i, from) in positions.chunks_exact(3).enumerate() {
        for (j, to) in positions.chunks_exact(3).enumerate() {
            let cutoff = cutoffs[elements[i] * element_count + elements[j]];
            for image in images(range) {
                let component = |axis: usize| {
                    let shift: f64 = (0..3).map(|row| f64::from(image[row]) * cell[3 * row + axis]).sum();
                    to[axis] - from[axis] + shift
                };
                let distance = (0..3).map(|axis| component(axis).powi(2)).sum::<f64>().sqrt();
                if distance < cutoff && (i != j || image != [0; 3]) {
                    pairs.push(Pair::new(i, j, distance, cutoff));
                }
            }
        }
    }
    pairs
}

fn images(range: i32) -> impl Iterator<Item = [i32; 3]> {
    let steps = move || -range..=range;
    steps().flat_map(move |a| steps().flat_map(move |b| steps().map(move |c| [a, b, c])))
}

#[test]
fn the_gradient_is_that_of_the_grade() {
    let mixture = niobium().mixture;
    let features = numbers(&data("niobium_reference.npz"), "features");
    let elements = vec![1; features.len() / 130];
    let mut gradient = vec![0.0; features.len()];
    let mut grades = Grades::default();
    grades.evaluate(&mixture, &elements, &features, Some(&mut gradient)).unwrap();
    let (mut shifted, step) = (Grades::default(), 1e-5);
    for atom in [0, 7, 20, 41] {
        let z = &features[130 * atom..130 * (atom + 1)];
        let row = &gradient[130 * atom..130 * (atom + 1)];
        let scale = row.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
        for channel in 0..130 {
            let mut gamma_at = |sign: f64| {
                let mut z = z.to_vec();
                z[channel] += sign * step;
                shifted.evaluate(&mixture, &[1], &z, None).unwrap();
                assert_eq!(shifted.component[0], grades.component[atom]);
                shifted.gamma[0]
            };
            let difference = (gamma_at(1.0) - gamma_at(-1.0)) / (2.0 * step);
            assert!((difference - row[channel]).abs() < 1e-5 * scale, "atom {atom} channel {channel}");
        }
    }
}

#[test]
fn an_atom_keeps_its_bits_in_any_company() {
    let mixture = niobium().mixture;
    let features = numbers(&data("niobium_reference.npz"), "features");
    let elements = vec![1; features.len() / 130];
    let (mut together, mut alone) = (Grades::default(), Grades::default());
    let (mut gradient, mut row) = (vec![0.0; features.len()], vec![0.0; 130]);
    together.evaluate(&mixture, &elements, &features, Some(&mut gradient)).unwrap();
    for (atom, z) in features.chunks_exact(130).enumerate() {
        alone.evaluate(&mixture, &[1], z, Some(&mut row)).unwrap();
        assert_eq!(alone.gamma[0].to_bits(), together.gamma[atom].to_bits());
        assert_eq!(row, gradient[130 * atom..130 * (atom + 1)]);
    }
}

#[test]
fn what_cannot_be_graded_is_an_error() {
    let mixture = niobium().mixture;
    let mut grades = Grades::default();
    let mut grade =
        |elements: &[usize], features: &[f64]| grades.evaluate(&mixture, elements, features, None);
    let message = |result: Result<(), calm::GradeError>| result.unwrap_err().to_string();
    assert!(message(grade(&[1], &[0.0; 129])).contains("129 numbers"));
    assert!(message(grade(&[4], &[0.0; 130])).contains("element index 4"));
    assert!(message(grade(&[1, 1], &[[0.0; 130], [f64::NAN; 130]].concat())).contains("atom 1"));
    assert!(grade(&[], &[]).is_ok());
}

#[test]
fn a_pair_counts_by_its_cosine_weight() {
    let pairs = [Pair::new(0, 1, 2.0, 4.0), Pair::new(0, 0, 4.0 / 3.0, 4.0), Pair::new(1, 0, 4.0, 4.0)];
    let averaged = neighbourhood_average(&[1.0, 3.0], pairs).unwrap();
    assert_close("average", &averaged, &[(1.0 + 0.5 * 3.0 + 0.75) / (1.0 + 0.5 + 0.75), 3.0], 1e-15);
    let error = neighbourhood_average(&[1.0], pairs).unwrap_err();
    assert_eq!((error.i, error.j, error.atoms), (0, 1, 1));
}

#[test]
fn weights_have_a_shape_and_a_radius() {
    let weights = |text: &str| text.parse::<NeighbourWeights>().unwrap();
    let distances = [2.0, 2.9, 3.0, 3.5];
    for (text, expected) in [
        (
            "cosine",
            [
                0.5,
                0.5 * (1.0 + (PI * 0.725).cos()),
                0.5 * (1.0 + (PI * 0.75).cos()),
                0.5 * (1.0 + (PI * 0.875).cos()),
            ],
        ),
        ("uniform", [1.0, 1.0, 1.0, 1.0]),
        ("uniform:3", [1.0, 1.0, 0.0, 0.0]),
        ("cosine:2.5", [0.5 * (1.0 + (PI * 0.8).cos()), 0.0, 0.0, 0.0]),
        // The cutoff of the pair stays the largest radius.
        ("uniform:9", [1.0, 1.0, 1.0, 1.0]),
    ] {
        let found = distances.map(|r| weights(text).weight(r, 4.0));
        assert_close(text, &found, &expected, 1e-15);
        assert_eq!((weights(text).weight(4.0, 4.0), weights(text).to_string()), (0.0, text.to_owned()));
    }
    assert_eq!(weights("cosine"), NeighbourWeights::default());
    for text in ["", "gauss", "uniform:", "uniform:0", "cosine:-1", "cosine:inf", "uniform:3 Å"] {
        assert!(text.parse::<NeighbourWeights>().is_err(), "{text}");
    }
}

/// Shared numbers give the same bits as owned ones and compare equal.
#[test]
fn a_lent_component_is_as_good_as_an_owned_one() {
    struct Block(Vec<f64>);
    impl AsRef<[f64]> for Block {
        fn as_ref(&self) -> &[f64] {
            &self.0
        }
    }
    let owned = niobium().mixture;
    let block = |component: &Component| Block([component.inverse(), component.centroid()].concat());
    let lend = |component: &Arc<Component>| {
        let lent = Component::from_shared(Arc::new(block(component)), 130, component.threshold()).unwrap();
        assert_eq!(lent.view().centroid, component.centroid());
        Arc::new(lent)
    };
    let elements = 0..owned.element_count();
    let elements = elements.map(|element| owned.components(element).unwrap().iter().map(lend).collect());
    let lent = Mixture::new(0, elements.collect()).unwrap();
    assert!(!lent.can_be_updated());
    let features = numbers(&data("niobium_reference.npz"), "features");
    let elements = vec![1; features.len() / 130];
    let grade = |mixture: &Mixture| {
        let (mut grades, mut gradient) = (Grades::default(), vec![0.0; features.len()]);
        grades.evaluate(mixture, &elements, &features, Some(&mut gradient)).unwrap();
        (grades, gradient)
    };
    assert_eq!(grade(&lent), grade(&owned));

    let lent = |length: usize, dimension, threshold| {
        Component::from_shared(Arc::new(Block(vec![0.0; length])), dimension, threshold)
    };
    assert_eq!(lent(0, 0, 1.0), Err(ComponentError::Empty));
    let length = |found| ComponentError::Length { what: "lent component", found, expected: 12 };
    assert_eq!(lent(11, 3, 1.0), Err(length(11)));
    assert_eq!(lent(13, 3, 1.0), Err(length(13)));
    assert!(matches!(lent(12, 3, -1.0), Err(ComponentError::Number { what: "threshold", .. })));
    assert!(matches!(lent(12, 3, f64::NAN), Err(ComponentError::Number { what: "threshold", .. })));
    let private = Component::new(vec![0.0; 3], vec![0.0; 9], 1.0, None);
    assert_eq!(lent(12, 3, 1.0), private);
}
