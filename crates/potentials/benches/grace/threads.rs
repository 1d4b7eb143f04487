//! Two threads against one on the larger crystal, and against two concurrent copies of it, which show what two
//! cores yield at that time; on a virtual machine this may be little more than one.

use std::time::Instant;

use potentials::grace::{Precision, Threads};

use crate::case::{Call, Case, Model};
use crate::{SECONDS, quantiles};

/// Prints the speed-up of two threads; all variants alternate.
pub fn report(model: &Model, cells: usize) {
    let [mut one, mut two, mut copy] = [1, 2, 1].map(|n| {
        Case::with_threads(model, cells, Precision::Double, Threads::new(n).expect("the system has threads"))
    });
    for (name, call) in [("energy, forces", Call::Plain), ("with γ and ∇Σγ", Call::Graded)] {
        let (begin, mut of_one, mut of_copies) = (Instant::now(), Vec::new(), Vec::new());
        while begin.elapsed().as_secs_f64() < 2.0 * SECONDS || of_one.len() < 5 {
            let threads = two.seconds(call);
            of_one.push(one.seconds(call) / threads);
            of_copies.push(side_by_side(&mut one, &mut copy, call) / two.seconds(call));
        }
        for (other, ratios) in [("one", of_one), ("two copies", of_copies)] {
            let [low, median, high] = quantiles(&ratios);
            println!("    {name}, two threads: {median:.2} times as fast as {other} ({low:.2} to {high:.2})");
        }
    }
}

/// Time of each of two concurrent calls, s.
fn side_by_side(a: &mut Case, b: &mut Case, call: Call) -> f64 {
    let start = Instant::now();
    std::thread::scope(|scope| {
        let other = scope.spawn(|| b.seconds(call));
        a.seconds(call);
        other.join().expect("it ends");
    });
    start.elapsed().as_secs_f64() / 2.0
}
