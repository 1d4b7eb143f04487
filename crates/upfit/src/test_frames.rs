//! Frames and model of the demonstration, for unit tests.

use std::path::{Path, PathBuf};

use atoms::read_extxyz;
use potentials::grace::TrainableGrace;

use crate::data::LabelledFrame;
use crate::learning_rate::CosineDecay;
use crate::loss::LossSettings;
use crate::optimiser::Optimiser;
use crate::settings::UpfitSettings;

fn demonstration(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/data/al_eam_1l").join(name)
}

/// The model of the demonstration.
pub fn model() -> TrainableGrace {
    TrainableGrace::load(&demonstration("kokkos.npz")).unwrap()
}

/// The first frames of the training data of the model, 108 atoms each; each is a group of its own.
pub fn aluminium(count: usize) -> Vec<LabelledFrame> {
    let frames = read_extxyz(&demonstration("seed_frames.extxyz")).unwrap();
    let labelled = frames.into_iter().take(count).map(|frame| {
        let labels = frame.labels().unwrap();
        let place = format!("seed_frames.extxyz:{}", frame.line);
        LabelledFrame::new(place.clone(), place, frame.structure, labels, 1.0).unwrap()
    });
    labelled.collect()
}

/// The same with labels of a potential that is a tenth stronger.
pub fn stronger(count: usize) -> Vec<LabelledFrame> {
    let mut frames = aluminium(count);
    for frame in &mut frames {
        frame.energy *= 1.1;
        frame.forces.as_flattened_mut().iter_mut().for_each(|force| *force *= 1.1);
        frame.stress = frame.stress.map(|stress| stress.map(|row| row.map(|x| 1.1 * x)));
    }
    frames
}

/// Two epochs of small steps, mostly towards better forces: energies are stiff, so that a few steps may not improve them.
pub fn settings() -> UpfitSettings {
    let mut loss = LossSettings::demo();
    loss.stages[0].weights.energy = 1.0;
    UpfitSettings {
        epochs: 2,
        batch_size: 2,
        optimiser: Optimiser::Adam,
        loss,
        learning_rate: CosineDecay { first: 1e-4, last: 1e-5 },
        seed: 42,
        frozen: Vec::new(),
        average: None,
        patience: None,
        threads: 1,
    }
}
