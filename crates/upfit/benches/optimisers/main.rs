//! Optimisers for fine-tuning, by the number of times that each takes the gradients of all training structures.
//!
//!     cargo bench -p upfit --bench optimisers
//!
//! The model of the demonstration learns structures that it has not seen: three of five of each test set of `configs/aluminium.toml`,
//! beside 40 of its own 50 training frames. The others test. All begin with the same weights and have the loss of that
//! configuration. Adam and SOAP are those of `upfit`, with batches of eight structures; L-BFGS takes all at once.

mod lbfgs;
mod objective;

use std::time::Instant;

use lbfgs::lbfgs;
use objective::{Objective, loss};
use upfit::{CosineDecay, Optimiser, TrainingData, UpfitSettings};

/// Passes over the training structures after which errors are shown.
const PASSES: [u64; 4] = [4, 8, 16, 40];
const RATES: [f64; 5] = [0.005, 0.01, 0.02, 0.05, 0.1];

fn main() {
    let mut objective = Objective::demonstration();
    println!("{:<20} {:>6} {:>7}  {}", "", "passes", "s", objective.titles());
    let begin = objective.model.weights().to_vec();
    objective.show("before", 0, 0.0, &begin);
    for optimiser in [Optimiser::Adam, Optimiser::Soap] {
        for epochs in PASSES {
            RATES.into_iter().for_each(|rate| train(&mut objective, optimiser, epochs, rate));
        }
    }
    lbfgs(&mut objective, &PASSES);
}

fn train(objective: &mut Objective, optimiser: Optimiser, epochs: u64, rate: f64) {
    let begun = Instant::now();
    let data = TrainingData { training: objective.labelled(), validation: Vec::new() };
    let settings = UpfitSettings {
        epochs,
        batch_size: 8,
        optimiser,
        loss: loss(),
        learning_rate: CosineDecay { first: rate, last: 0.01 * rate },
        seed: 1,
        frozen: Vec::new(),
        average: None,
        patience: None,
        threads: 1,
    };
    let trained = upfit::run(objective.model.clone(), &data, &settings, None, &|| false, |_| {});
    let weights = trained.unwrap().unwrap().model.weights().to_vec();
    let seconds = begun.elapsed().as_secs_f64();
    objective.show(&format!("{}, rate {rate}", optimiser.name()), epochs, seconds, &weights);
}
