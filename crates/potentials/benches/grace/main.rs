//! Benchmarks GRACE on one thread in double and mixed precision: energy and forces, with and without γ and ∇Σγ.
//! If `CALMWALK_GRACEMAKER_PYTHON` names a Python with gracemaker, compares with gracemaker's calculator in
//! double and single precision, alternating on one core to which `taskset` (util-linux) pins both.
//!
//! `cargo bench -p potentials --bench grace [-- MODEL…]`; the larger models are in `CALMWALK_PEER_DATA`. With
//! `scale` before the models, measures time and memory of crystals from 108 to 19 652 atoms; with `training`, the cost of
//! derivatives with respect to weights.

mod case;
mod peak;
mod peer;
mod scale;
mod threads;
mod training;

use std::time::Instant;

use case::{Call, Case, MODELS, Model};
use peak::{Peak, Rates};
use peer::Peer;
use potentials::grace::Precision;

/// Unit cells along an edge of the crystals, four atoms each: 108 and 500 atoms.
const EDGES: [usize; 2] = [3, 5];

/// Duration of each measurement, s.
const SECONDS: f64 = 4.0;

/// Number of alternations between our code and gracemaker.
const ROUNDS: usize = 9;

fn main() {
    let mut wanted: Vec<String> =
        std::env::args().skip(1).filter(|argument| !argument.starts_with('-')).collect();
    let first = wanted.first().map_or("", String::as_str);
    let (grow, train) = (first == "scale", first == "training");
    if grow || train {
        wanted.remove(0);
    }
    let peak = if grow || train { Peak::default() } else { peak::report() };
    for model in
        MODELS.iter().filter(|model| wanted.is_empty() || wanted.iter().any(|name| name == model.name))
    {
        match model.folder() {
            Some(folder) if folder.join("kokkos.npz").exists() && grow => scale::report(model),
            Some(folder) if folder.join("kokkos.npz").exists() && train => training::report(model),
            Some(folder) if folder.join("kokkos.npz").exists() => report(model, peak),
            _ => println!("\n{}: not here (CALMWALK_PEER_DATA names the folder that has it)", model.name),
        }
    }
}

fn report(model: &Model, peak: Peak) {
    for precision in [Precision::Double, Precision::Mixed] {
        println!("\n{}, {precision} precision", model.name);
        let cases: Vec<Case> = EDGES.iter().map(|edge| Case::new(model, *edge, precision)).collect();
        let peer = Peer::start(model, precision, &cases);
        report_cases(cases, peer, peak.rates(precision));
    }
    threads::report(model, EDGES[1]);
}

fn report_cases(mut cases: Vec<Case>, mut peer: Option<Peer>, rates: Rates) {
    for (k, case) in cases.iter_mut().enumerate() {
        let atoms = case.structure.len() as f64;
        let found = measure(case, |call| peer.as_mut().and_then(|peer| peer.seconds(k, call)));
        println!("  {atoms} atoms, {:.1} bonds an atom", case.bonds() as f64 / atoms);
        for (name, call, times, peer) in [
            ("energy, forces", Call::Plain, &found.plain, &found.peer_plain),
            ("with γ and ∇Σγ", Call::Graded, &found.graded, &found.peer_graded),
        ] {
            let [low, median, high] = quantiles(times);
            let count = case.multiply_adds(call) as f64;
            println!(
                "    {name}: {:.4} ms an atom ({:.4} to {:.4}); {:.3} M multiply-adds an atom, {:.0} % of the peak",
                1e3 * median / atoms,
                1e3 * low / atoms,
                1e3 * high / atoms,
                1e-6 * count / atoms,
                100.0 * count / median / rates.highest
            );
            if !peer.is_empty() {
                let (seconds, times): (Vec<f64>, Vec<f64>) = peer.iter().copied().unzip();
                let [low, median, high] = quantiles(&seconds).map(|seconds| 1e3 * seconds / atoms);
                println!("      gracemaker: {median:.3} ms an atom ({low:.3} to {high:.3})");
                let [low, median, high] = quantiles(&times);
                println!("      {median:.1} times ours ({low:.1} to {high:.1})");
            }
        }
        let differences: Vec<f64> =
            found.gamma.iter().zip(&found.plain).map(|(both, plain)| both - plain).collect();
        let [low, median, high] =
            quantiles(&differences).map(|seconds| seconds * rates.projection / case.of_gamma() as f64);
        println!(
            "    γ alone costs {median:.2} times its projection and quadratic form as a matrix product ({low:.2} to {high:.2})"
        );
        let ratios: Vec<f64> =
            found.graded.iter().zip(&found.plain).map(|(both, plain)| both / plain).collect();
        let [low, median, high] = quantiles(&ratios);
        println!("    both gradients over plain: {median:.2} ({low:.2} to {high:.2})");
    }
}

/// Times of the calls in each round, s.
#[derive(Default)]
struct Timings {
    plain: Vec<f64>,
    gamma: Vec<f64>,
    graded: Vec<f64>,
    /// Times of gracemaker, one per round, with their ratio to our median in the same round.
    peer_plain: Vec<(f64, f64)>,
    peer_graded: Vec<(f64, f64)>,
}

/// In every round, measures our calls for a while, then one plain and one graded call of the peer.
fn measure(case: &mut Case, mut peer: impl FnMut(Call) -> Option<f64>) -> Timings {
    let mut found = Timings::default();
    for _ in 0..2 {
        for call in [Call::Plain, Call::Gamma, Call::Graded] {
            case.seconds(call);
        }
    }
    for _ in 0..ROUNDS {
        let (begin, first) = (Instant::now(), found.plain.len());
        while begin.elapsed().as_secs_f64() < SECONDS / ROUNDS as f64 || found.plain.len() == first {
            found.plain.push(case.seconds(Call::Plain));
            found.gamma.push(case.seconds(Call::Gamma));
            found.graded.push(case.seconds(Call::Graded));
        }
        let beside = |seconds: f64, ours: &[f64]| (seconds, seconds / quantiles(&ours[first..])[1]);
        found.peer_plain.extend(peer(Call::Plain).map(|seconds| beside(seconds, &found.plain)));
        found.peer_graded.extend(peer(Call::Graded).map(|seconds| beside(seconds, &found.graded)));
    }
    found
}

/// Lower quartile, median and upper quartile.
pub fn quantiles(times: &[f64]) -> [f64; 3] {
    let mut sorted = times.to_vec();
    sorted.sort_by(f64::total_cmp);
    [1, 2, 3].map(|quarter| sorted[(sorted.len() - 1) * quarter / 4])
}
