//! Other features of a model: the linear projected basis and the hidden layer of the readout.

use std::path::Path;
use std::sync::Arc;

use atoms::{Cell, Evaluation, NeighbourList, Species, Structure};
use potentials::grace::{FeatureForm, Grace, GraceModel, Precision, PullBack, RadialPath, Threads};

use crate::common::golden::committed;
use crate::common::model_file::{array, changed, deep, floats, floats_of};
use crate::common::{assert_close, position_gradient, strain_gradient};

const MODELS: [&str; 3] = ["al_eam_1l", "two_layers", "three_layers"];

fn model(name: &str) -> GraceModel {
    let file = match name {
        "al_eam_1l" => committed(name).join("kokkos.npz"),
        _ => Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/data/{name}.npz")),
    };
    GraceModel::load_in(&file, Precision::Double, RadialPath::Table).unwrap()
}

/// Four atoms in a skewed cell, of all elements of the model that has at most two.
fn structure(model: &GraceModel) -> Structure {
    let elements: &[Species] = model.elements();
    Structure {
        species: (0..4).map(|atom| elements[atom % elements.len()]).collect(),
        positions: vec![[0.0, 0.1, 0.0], [0.2, 2.1, 1.9], [2.0, -0.1, 2.2], [2.1, 2.0, 0.1]],
        cell: Cell([[4.1, 0.1, 0.0], [0.0, 4.2, 0.0], [0.2, 0.0, 4.0]]),
        periodic: [true; 3],
    }
}

fn forward(grace: &mut Grace, structure: &Structure) {
    let mut neighbours = NeighbourList::new(grace.model().cutoff(), 0.0);
    neighbours.update(structure).unwrap();
    grace.forward(structure, &neighbours).unwrap();
}

/// Reproducible numbers in (−1, 1).
fn numbers(count: usize) -> Vec<f64> {
    (0..count).map(|k| (1.7 * k as f64 + 0.3).sin()).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[test]
fn features_in_another_form_are_those_of_a_file_that_says_so() {
    let flags = |form: FeatureForm| {
        let flag = |on: bool| array(&[], &[i32::from(on)]);
        let normalised = form == FeatureForm::Normalised;
        let dimension = if normalised { 130 } else { 128 };
        vec![
            ("uq_schema_version", array(&[], &[if normalised { 6_i32 } else { 3 }])),
            ("uq_feature_dim", array(&[], &[dimension])),
            ("uq_rp_normalize", flag(normalised)),
            ("uq_rp_add_density_channel", flag(normalised)),
            ("uq_feature_transform", flag(false)),
        ]
    };
    let own = changed(&[]).unwrap();
    let structure = structure(&own);
    for form in [FeatureForm::Normalised, FeatureForm::Linear] {
        let mut found = Grace::new(own.with_features(form).unwrap().into());
        let mut expected = Grace::new(changed(&flags(form)).unwrap().into());
        forward(&mut found, &structure);
        forward(&mut expected, &structure);
        assert_eq!(found.features(), expected.features());
        assert_eq!(found.features().len(), 4 * found.model().feature_dimension());
        assert_eq!(found.model().description(), expected.model().description());
    }
}

#[test]
fn the_linear_basis_is_pulled_back() {
    for name in MODELS {
        let linear = model(name).with_features(FeatureForm::Linear).unwrap();
        let (structure, mut grace) = (structure(&linear), Grace::new(Arc::new(linear)));
        forward(&mut grace, &structure);
        let cotangent = numbers(grace.features().len());
        let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
        grace.backward(Some(&cotangent), &mut energy, &mut pull_back);
        let mut sum = |structure: &Structure| {
            forward(&mut grace, structure);
            dot(grace.features(), &cotangent)
        };
        let gradient = position_gradient(&structure, 4e-4, &mut sum);
        assert_close("gradient", pull_back.gradient.as_flattened(), gradient.as_flattened(), 1e-8);
        let virial = strain_gradient(&structure, 1e-4, &mut sum);
        assert_close("virial", pull_back.virial.as_flattened(), virial.as_flattened(), 1e-8);
    }
}

/// A pull-back leaves what the forward pass computed as it was.
#[test]
fn pull_backs_may_be_repeated() {
    for name in MODELS {
        for form in [FeatureForm::Normalised, FeatureForm::Linear] {
            let model = model(name).with_features(form).unwrap();
            let (structure, mut grace) = (structure(&model), Grace::new(Arc::new(model)));
            forward(&mut grace, &structure);
            let cotangent = numbers(grace.features().len());
            let pulled_back = |grace: &mut Grace, cotangent: &[f64]| {
                let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
                grace.backward(Some(cotangent), &mut energy, &mut pull_back);
                (energy, pull_back.gradient, pull_back.virial)
            };
            let first = pulled_back(&mut grace, &cotangent);
            let doubled: Vec<_> = cotangent.iter().map(|c| 2.0 * c).collect();
            pulled_back(&mut grace, &doubled);
            assert_eq!(pulled_back(&mut grace, &cotangent), first, "{name}");
        }
    }
}

#[test]
fn the_hidden_layer_is_pulled_back() {
    for name in MODELS {
        let own = Arc::new(model(name));
        let structure = structure(&own);
        let mut grace = Grace::with(own, potentials::grace::Instructions::best(), Threads::new(2).unwrap());
        forward(&mut grace, &structure);
        let mut hidden = Vec::new();
        grace.hidden_layer(&mut hidden);
        assert_eq!(hidden.len(), 4 * grace.model().hidden_dimension());
        // energy_mlp_W0 of the first model is [8, 64]; the ninth density counts linearly.
        if name == "al_eam_1l" {
            assert_eq!((grace.model().density_dimension(), grace.model().hidden_dimension()), (9, 65));
        }
        let cotangent = numbers(hidden.len());
        let mut pull_back = PullBack::default();
        grace.pull_back_hidden_layer(&cotangent, &mut pull_back);

        // What the energy needs is left as it was.
        let (mut after, mut fresh) = (Evaluation::default(), Evaluation::default());
        grace.backward(None, &mut after, &mut PullBack::default());
        forward(&mut grace, &structure);
        grace.backward(None, &mut fresh, &mut PullBack::default());
        assert_eq!(after, fresh);

        let mut sum = |structure: &Structure| {
            forward(&mut grace, structure);
            grace.hidden_layer(&mut hidden);
            dot(&hidden, &cotangent)
        };
        let gradient = position_gradient(&structure, 4e-4, &mut sum);
        assert_close("gradient", pull_back.gradient.as_flattened(), gradient.as_flattened(), 1e-8);
        let virial = strain_gradient(&structure, 1e-4, &mut sum);
        assert_close("virial", pull_back.virial.as_flattened(), virial.as_flattened(), 1e-8);
    }
}

/// E = s (h_0 + w · h) + shift with the last weights of the file, and the forces are the pull-back of this cotangent.
#[test]
fn the_energy_is_linear_in_the_hidden_layer() {
    for name in ["al_eam_1l", "two_layers"] {
        let bytes = (name == "two_layers").then(|| deep("two_layers.npz"));
        let read = |key: &str| bytes.as_ref().map_or_else(|| floats(key), |bytes| floats_of(bytes, key)).1;
        let (scale, norm) = (read("output_scale")[0], read("energy_mlp_norm1")[0]);
        let weights = read("energy_mlp_W1").into_iter().map(|w| scale * norm * w);
        let weights: Vec<f64> = std::iter::once(scale).chain(weights).collect();
        let shifts = read("shift_values");

        let own = Arc::new(model(name));
        let (structure, mut grace) = (structure(&own), Grace::new(Arc::clone(&own)));
        forward(&mut grace, &structure);
        let mut hidden = Vec::new();
        grace.hidden_layer(&mut hidden);
        assert_eq!(weights.len(), own.hidden_dimension());
        let elements = own.element_indices(&structure.species).unwrap();
        let rows = hidden.chunks_exact(weights.len()).zip(&elements);
        let energies: Vec<f64> = rows.map(|(h, element)| dot(h, &weights) + shifts[*element]).collect();
        assert_close("energies", grace.atomic_energies(), &energies, 1e-13);

        let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
        grace.backward(None, &mut energy, &mut PullBack::default());
        grace.pull_back_hidden_layer(&weights.repeat(4), &mut pull_back);
        let forces: Vec<f64> = pull_back.gradient.as_flattened().iter().map(|x| -x).collect();
        assert_close("forces", &forces, energy.forces.as_flattened(), 1e-12);
    }
}
