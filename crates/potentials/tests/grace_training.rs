//! Derivatives with respect to weights, against finite differences and TensorFlow.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use atoms::{Cell, Evaluation, Matrix3, NeighbourList, Structure};
use npyz::npz::NpzArchive;
use potentials::grace::{Grace, GraceModel, LossGradient, TrainableGrace, WeightGroup};

use crate::common::golden::{Npz, committed, golden, peer};
use crate::common::{assert_close, evaluate};

/// Reproducible numbers in [−½, ½).
fn noise(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
    }
}

/// L = Ē E + Σ F̄·F + Σ W̄ W + ¼ Σ E² + ½ Σ F² + ¼ Σ W² with random coefficients.
struct SmoothLoss {
    energy: f64,
    forces: Vec<[f64; 3]>,
    virial: Matrix3,
}

impl SmoothLoss {
    fn new(n: usize) -> Self {
        let mut noise = noise(11);
        Self {
            energy: noise(),
            forces: (0..n).map(|_| [noise(), noise(), noise()]).collect(),
            virial: std::array::from_fn(|_| std::array::from_fn(|_| noise())),
        }
    }

    /// The coefficients of a file.
    fn read(file: &mut Npz) -> Self {
        Self {
            energy: file.floats("a")[0],
            forces: file.rows("F_bar"),
            virial: file.rows("W_bar").try_into().unwrap(),
        }
    }

    fn value(&self, found: &Evaluation) -> f64 {
        let energy: f64 = found.atomic_energies.iter().sum();
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let (f, w) = (found.forces.as_flattened(), found.virial.as_flattened());
        self.energy * energy
            + dot(self.forces.as_flattened(), f)
            + dot(self.virial.as_flattened(), w)
            + 0.25 * energy * energy / found.forces.len() as f64
            + 0.5 * dot(f, f)
            + 0.25 * dot(w, w) / found.forces.len() as f64
    }

    fn gradient(&self, found: &Evaluation) -> LossGradient {
        let n = found.forces.len() as f64;
        let mut gradient = LossGradient {
            energy: self.energy + 0.5 * found.atomic_energies.iter().sum::<f64>() / n,
            forces: self.forces.clone(),
            virial: self.virial,
        };
        let forces = gradient.forces.as_flattened_mut().iter_mut();
        forces.zip(found.forces.as_flattened()).for_each(|(g, f)| *g += f);
        let virial = gradient.virial.as_flattened_mut().iter_mut();
        virial.zip(found.virial.as_flattened()).for_each(|(g, w)| *g += 0.5 * w / n);
        gradient
    }
}

/// The loss and its derivatives.
fn loss(model: &TrainableGrace, structure: &Structure, smooth: &SmoothLoss) -> (f64, Vec<f64>) {
    let mut neighbours = NeighbourList::new(model.model().cutoff(), 0.0);
    neighbours.update(structure).unwrap();
    let (mut sums, mut value) = (model.sums(), 0.0);
    let of = |found: &Evaluation| {
        value = smooth.value(found);
        smooth.gradient(found)
    };
    model.worker().accumulate(structure, &neighbours, of, &mut sums).unwrap();
    (value, model.gradient(&sums))
}

/// The loss alone.
fn value(model: &TrainableGrace, structure: &Structure, smooth: &SmoothLoss) -> f64 {
    smooth.value(&evaluate(&mut Grace::new(Arc::new(model.model().clone())), structure))
}

/// The derivative along a direction by differences of the eighth order.
fn difference(mut along: impl FnMut(f64) -> f64, h: f64) -> f64 {
    let weights = [4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0];
    let pair = |(k, weight): (usize, f64)| {
        let step = (k + 1) as f64 * h;
        weight * (along(step) - along(-step)) / h
    };
    weights.into_iter().enumerate().map(pair).sum()
}

/// Compares the derivative along a random direction in each group with a difference.
fn check(file: &Path, structure: &Structure) {
    let mut model = TrainableGrace::load(file).unwrap();
    let smooth = SmoothLoss::new(structure.species.len());
    let weights = model.weights().to_vec();
    let (_, gradient) = loss(&model, structure, &smooth);
    let groups = model.groups().to_vec();
    for WeightGroup { name, range, .. } in &groups {
        let mut noise = noise(range.start as u64 + 5);
        let scale = weights[range.clone()].iter().fold(0.1_f64, |scale, w| scale.max(w.abs()));
        let direction: Vec<f64> = range.clone().map(|_| noise()).collect();
        let exact: f64 = gradient[range.clone()].iter().zip(&direction).map(|(g, d)| g * d).sum();
        let largest = gradient[range.clone()].iter().fold(0.0_f64, |largest, g| largest.max(g.abs()));
        let found = difference(
            |step| {
                let mut changed = weights.clone();
                changed[range.clone()].iter_mut().zip(&direction).for_each(|(w, d)| *w += step * d);
                model.set_weights(&changed);
                value(&model, structure, &smooth)
            },
            2e-3 * scale / (range.len() as f64).sqrt(),
        );
        let error = (found - exact).abs() / largest;
        assert!(largest > 0.0, "{name} has no effect");
        assert!(error < 1e-7, "{}: {name}: {exact} is {found} by differences: {error:e}", file.display());
    }
}

#[test]
fn weight_gradients_are_differences() {
    let al = committed("al_eam_1l");
    check(&al.join("kokkos.npz"), &golden(&al)[0].structure);
    let two_layers = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/two_layers.npz");
    check(&two_layers, &alloy());
}

/// Two elements in a small skewed cell.
fn alloy() -> Structure {
    let positions = vec![[0.1, 0.0, 0.05], [0.0, 1.9, 1.7], [1.8, 0.1, 1.9], [1.9, 1.8, 0.0]];
    Structure {
        species: ["W", "Mo", "Mo", "W"].map(|symbol| symbol.parse().unwrap()).to_vec(),
        positions,
        cell: Cell([[3.7, 0.1, 0.0], [-0.2, 3.9, 0.1], [0.3, 0.0, 3.6]]),
        periodic: [true, true, false],
    }
}

/// `tests/data/weight_gradients.py` writes the files.
#[test]
fn weight_gradients_are_those_of_tensorflow() {
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data");
    for (name, model) in [
        ("al_eam_1l", committed("al_eam_1l").join("kokkos.npz")),
        ("two_layers_trained", data.join("two_layers_trained.npz")),
    ] {
        let model = TrainableGrace::load(&model).unwrap();
        let mut file = Npz::open(data.join(format!("weight_gradients_{name}.npz")));
        let structure = file.structure("").unwrap();
        let smooth = SmoothLoss::read(&mut file);
        // TensorFlow evaluates the radial networks themselves. In training, tables have errors of up to 10⁻⁸, which all
        // groups but the shifts feel. TensorFlow with such tables is off by 3 · 10⁻⁹ for the two layers.
        let tolerance = 1e-7;
        let found = evaluate(&mut Grace::new(Arc::new(model.model().clone())), &structure);
        assert_close(name, &[found.energy()], &file.floats("energy"), tolerance);
        assert_close(name, found.forces.as_flattened(), &file.floats("forces"), tolerance);
        assert_close(name, found.virial.as_flattened(), &file.floats("virial"), tolerance);
        let (value, gradient) = loss(&model, &structure, &smooth);
        assert_close(name, &[value], &file.floats("loss"), 1e-8);
        for WeightGroup { name: array, range, .. } in model.groups() {
            let expected = file.floats(&format!("gradient_{array}"));
            let tolerance = if array == "shift_values" { 1e-10 } else { tolerance };
            assert_close(&format!("{name}: {array}"), &gradient[range.clone()], &expected, tolerance);
        }
    }
}

#[test]
fn weight_gradients_of_peer_models_are_differences() {
    // Structures of two to eight atoms; the larger the model, the smaller they are.
    for (name, at) in [
        ("grace1l_tiny", &[3, 6][..]),
        ("grace1l_tiny_bondcut", &[3, 6]),
        ("grace2l_tiny", &[3, 6]),
        ("grace1l_paper", &[1]),
        ("grace2l_small", &[1]),
    ] {
        let Some(model) = peer(name) else { return };
        for at in at {
            check(&model.join("kokkos.npz"), &golden(&model)[*at].structure);
        }
    }
}

/// Dtype and shape of each array of a file but those of the mixture.
fn layout(file: &Path) -> BTreeMap<String, (String, Vec<u64>)> {
    let mut archive = NpzArchive::open(file).unwrap();
    let names: Vec<String> = archive.array_names().map(str::to_owned).collect();
    let mut layout = BTreeMap::new();
    for name in names {
        let array = archive.by_name(&name).unwrap().unwrap();
        layout.insert(name, (format!("{:?}", array.header().dtype()), array.shape().to_vec()));
    }
    layout
}

#[test]
fn a_trained_model_is_written_like_the_export_that_it_came_from() {
    let directory = tempfile::tempdir().unwrap();
    let two_layers = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/two_layers_trained.npz");
    for (file, symbol) in [(two_layers, "Ni"), (committed("al_eam_1l").join("kokkos.npz"), "Al")] {
        let mut model = TrainableGrace::load(&file).unwrap();
        let mut noise = noise(3);
        let weights: Vec<f64> = model.weights().iter().map(|w| w + 0.01 * noise()).collect();
        model.set_weights(&weights);
        let written = directory.path().join(format!("{symbol}.npz"));
        model.write(&written, "a note").unwrap();

        let found = layout(&written);
        for (name, of_export) in layout(&file) {
            let is_mixture = name.starts_with("uq_") && !name.starts_with("uq_rp_");
            let is_kept = found.get(&name).is_some_and(|written| *written == of_export);
            assert!(is_kept || is_mixture, "{name}: {of_export:?}, {:?}", found.get(&name));
        }
        assert!(!found.contains_key("uq_centroids") && found.contains_key("calmwalk_note"));

        let mut structure = alloy();
        structure.species = vec![symbol.parse().unwrap(); 4];
        let mut read = Grace::new(Arc::new(GraceModel::load(&written).unwrap()));
        let mut trained = Grace::new(Arc::new(model.model().clone()));
        let [read, trained] = [&mut read, &mut trained].map(|grace| evaluate(grace, &structure));
        let difference =
            read.atomic_energies.iter().zip(&trained.atomic_energies).map(|(a, b)| (a - b).abs());
        assert!(difference.fold(0.0, f64::max) < 1e-6);
        assert!(TrainableGrace::load(&written).unwrap().weights() == weights);
    }
}
