//! GRACE against the framework that trained the models: energy, forces, virial, features, Σγ and its gradient.

use std::path::Path;
use std::sync::Arc;

use atoms::{Evaluation, NeighbourList};
use potentials::grace::{Grace, GraceModel, Precision, PullBack, RadialPath};

use crate::common::golden::{Golden, Mixture, committed, golden, peer, six};

/// The largest deviations for a model; relative ones refer to the largest value of a structure.
#[derive(Debug, Default)]
struct Deviations {
    energy_per_atom: f64,
    features: f64,
    forces: f64,
    virial: f64,
    sigma: f64,
    gamma: f64,
    gamma_gradient: f64,
    gamma_virial: f64,
}

fn absolute(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    found
        .iter()
        .zip(expected)
        .map(|(f, e)| (f - e).abs())
        .fold(0.0, |a, b| if b.is_nan() { b } else { a.max(b) })
}

/// Relative to the largest expected value; values that should vanish are compared with `floor`.
fn relative(found: &[f64], expected: &[f64], floor: f64) -> f64 {
    absolute(found, expected) / expected.iter().fold(floor, |m: f64, x| m.max(x.abs()))
}

fn raise(worst: &mut f64, deviation: f64) {
    assert!(!deviation.is_nan());
    *worst = worst.max(deviation);
}

fn compare(model: &Path, path: RadialPath) -> Deviations {
    let mixture = Mixture::read(model);
    let model_file = model.join("kokkos.npz");
    let mut grace = Grace::new(Arc::new(GraceModel::load_in(&model_file, Precision::Double, path).unwrap()));
    assert_eq!(grace.model().feature_dimension(), mixture.dimension);
    let mut worst = Deviations::default();
    let structures = golden(model);
    assert!(structures.len() >= 4);
    for reference in &structures {
        compare_structure(&mut grace, &mixture, reference, &mut worst);
    }
    eprintln!("{} {path:?}: {worst:?}", model.display());
    worst
}

fn compare_structure(grace: &mut Grace, mixture: &Mixture, reference: &Golden, worst: &mut Deviations) {
    let structure = &reference.structure;
    let mut neighbours = NeighbourList::new(grace.model().cutoff(), 0.3);
    neighbours.update(structure).unwrap();
    grace.forward(structure, &neighbours).unwrap();
    let elements = grace.model().element_indices(&structure.species).unwrap();
    let (mut sigmas, mut gammas, mut cotangent) = (Vec::new(), Vec::new(), Vec::new());
    for (element, z) in elements.iter().zip(grace.features().chunks(mixture.dimension)) {
        let (sigma, gamma, gradient) = mixture.grade(*element, z);
        sigmas.push(sigma);
        gammas.push(gamma);
        cotangent.extend(gradient);
    }
    let (mut energy, mut pull_back) = (Evaluation::default(), PullBack::default());
    grace.backward(Some(&cotangent), &mut energy, &mut pull_back);

    raise(&mut worst.energy_per_atom, (energy.energy() - reference.energy).abs() / structure.len() as f64);
    if let Some(energies) = &reference.atomic_energies {
        raise(&mut worst.energy_per_atom, absolute(&energy.atomic_energies, energies));
    }
    if let Some(features) = &reference.features {
        raise(&mut worst.features, absolute(grace.features(), features));
    }
    raise(&mut worst.forces, relative(energy.forces.as_flattened(), &reference.forces, 1e-3));
    if let Some(virial) = &reference.virial {
        raise(&mut worst.virial, relative(&six(&energy.virial), virial, 1e-3));
    }
    raise(&mut worst.sigma, relative(&sigmas, &reference.sigma, 1e-3));
    raise(&mut worst.gamma, relative(&gammas, &reference.gamma, 1e-3));
    let gradient = relative(pull_back.gradient.as_flattened(), &reference.gamma_gradient, 1e-3);
    raise(&mut worst.gamma_gradient, gradient);
    raise(&mut worst.gamma_virial, relative(&six(&pull_back.virial), &reference.gamma_virial, 1e-3));
}

fn check(model: &Path) {
    for path in [RadialPath::Exact, RadialPath::Table] {
        let worst = compare(model, path);
        for (what, deviation) in [
            ("energy per atom, eV", worst.energy_per_atom),
            ("features", worst.features),
            ("forces", worst.forces),
            ("virial", worst.virial),
            ("σ", worst.sigma),
            ("γ", worst.gamma),
            ("∇Σγ", worst.gamma_gradient),
            ("virial of Σγ", worst.gamma_virial),
        ] {
            assert!(deviation <= 1e-9, "{} {path:?} {what}: {deviation:.2e}", model.display());
        }
    }
}

#[test]
fn aluminium() {
    check(&committed("al_eam_1l"));
}

#[test]
fn silicon() {
    check(&committed("si_sw_1l"));
}

#[test]
fn nickel_aluminium_hydrogen() {
    check(&committed("ni_al_h_eam_1l"));
}

#[test]
fn four_elements() {
    if let Some(model) = peer("grace1l_tiny") {
        check(&model);
    }
}

#[test]
fn four_elements_with_cutoffs_for_each_pair() {
    if let Some(model) = peer("grace1l_tiny_bondcut") {
        check(&model);
    }
}

#[test]
fn four_elements_at_the_size_of_the_paper() {
    if let Some(model) = peer("grace1l_paper") {
        check(&model);
    }
}

#[test]
fn two_layers() {
    if let Some(model) = peer("grace2l_tiny") {
        check(&model);
    }
}

#[test]
fn two_layers_at_the_size_of_use() {
    if let Some(model) = peer("grace2l_small") {
        check(&model);
    }
}

#[test]
fn three_layers() {
    if let Some(model) = peer("grace3l_tiny") {
        check(&model);
    }
}
