//! The cost of derivatives with respect to weights, in calls that give energy and forces.

use std::time::Instant;

use atoms::{Evaluation, NeighbourList};
use potentials::grace::{LossGradient, Precision, TrainableGrace};

use crate::case::{Call, Case, Model};
use crate::{EDGES, SECONDS, quantiles};

/// Prints the ratio of both times for the smaller crystal, which alternate, and the time of an update beside them.
pub fn report(model: &Model) {
    let Some(folder) = model.folder() else { return };
    let mut case = Case::new(model, EDGES[0], Precision::Double);
    let mut trainable = TrainableGrace::load(&folder.join("kokkos.npz")).expect("a model");
    let mut neighbours = NeighbourList::new(trainable.model().cutoff(), 0.0);
    neighbours.update(&case.structure).expect("a crystal");
    let (mut sums, weights) = (trainable.sums(), trainable.weights().to_vec());
    let (begin, mut ratios, mut of_updates, mut plain) = (Instant::now(), Vec::new(), Vec::new(), Vec::new());
    while begin.elapsed().as_secs_f64() < 2.0 * SECONDS || ratios.len() < 5 {
        let one = case.seconds(Call::Plain);
        let mut worker = trainable.worker();
        let run = |worker: &mut potentials::grace::GradientWorker, sums: &mut _| {
            let start = Instant::now();
            let loss = |found: &Evaluation| LossGradient {
                energy: 1.0,
                forces: found.forces.clone(),
                virial: found.virial,
            };
            worker.accumulate(&case.structure, &neighbours, loss, sums).expect("a crystal");
            start.elapsed().as_secs_f64()
        };
        run(&mut worker, &mut sums);
        let gradient = run(&mut worker, &mut sums);
        drop(worker);
        let start = Instant::now();
        let found = trainable.gradient(&sums);
        assert!(found.iter().all(|x| x.is_finite()));
        sums.clear();
        trainable.set_weights(&weights);
        of_updates.push(start.elapsed().as_secs_f64());
        ratios.push(gradient / one);
        plain.push(one);
    }
    let ([low, median, high], update) = (quantiles(&ratios), quantiles(&of_updates)[1]);
    println!(
        "  {}: {} weights, {} atoms: energy and forces {:.2} ms; derivatives with respect to all weights {median:.2} \
         ({low:.2} to {high:.2}) times that; new matrices and tables {:.2} ms an update",
        model.name,
        weights.len(),
        case.structure.len(),
        1e3 * quantiles(&plain)[1],
        1e3 * update
    );
}
