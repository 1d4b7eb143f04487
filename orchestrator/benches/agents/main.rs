//! A thousand simulated walkers on 32 simulated agents with one orchestrator. Reactor, database and transport between
//! hosts are those of real campaigns; agents connect over TCP and keep their mixture in shared memory. Walkers do no
//! dynamics: after some time they offer a recorded candidate, and 2 % of the candidates are new.
//!
//! `cargo bench -p orchestrator --bench agents`, with two optional arguments after `--`: candidates per second of all
//! walkers (0: as many as possible), and duration in seconds. Uses the PostgreSQL server at the URL in
//! `CALMWALK_POSTGRES` if set, see `.ci/postgres`, or else SQLite. Results are in `docs/benchmarks.md`.
#![allow(dead_code, reason = "the other benches use the rest of what they share")]

#[path = "../selector/campaign.rs"]
mod campaign;
#[path = "../selector/database.rs"]
mod database;
mod orchestrator;
#[path = "../selector/random.rs"]
mod random;
#[path = "../selector/recording.rs"]
mod recording;
mod simulated;

use std::time::{Duration, SystemTime, UNIX_EPOCH};

const AGENTS: usize = 32;
const WALKERS: usize = 1024;
const RATE: f64 = 400.0;
const SECONDS: f64 = 60.0;
/// Number of periods with separate results, which show growth.
const PERIODS: usize = 4;

/// What to simulate.
#[derive(Clone, Copy)]
struct Plan {
    port: u16,
    /// Candidates per second of all walkers; 0 for as many as possible.
    rate: f64,
    duration: Duration,
    /// Start of the measurement, s: agents have joined and walkers have their first assignments by then.
    begun: f64,
}

const START: f64 = 10.0;

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let numbers: Vec<f64> = arguments.iter().filter_map(|text| text.parse().ok()).collect();
    let rate = numbers.first().copied().unwrap_or(RATE);
    let duration = Duration::from_secs_f64(numbers.get(1).copied().unwrap_or(SECONDS));
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
    match numbers.get(2..4) {
        Some(&[port, begun]) => {
            runtime.block_on(simulated::agents(Plan { port: port as u16, rate, duration, begun }))
        }
        _ => runtime.block_on(orchestrator::lead(Plan {
            port: free_port(),
            rate,
            duration,
            begun: now() + START,
        })),
    }
}

fn free_port() -> u16 {
    std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

fn endpoint(plan: Plan) -> wire::net::Endpoint {
    format!("tcp/127.0.0.1:{}", plan.port).parse().unwrap()
}

/// The period that contains a time.
fn period(time: f64, plan: Plan) -> Option<usize> {
    let period = PERIODS as f64 * (time - plan.begun) / plan.duration.as_secs_f64();
    (0.0..PERIODS as f64).contains(&period).then_some(period as usize)
}

/// The clock of this host, shared by both processes, s.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64()
}

/// A quantile of numbers, which it sorts; NaN without any.
fn quantile(numbers: &mut [f64], share: f64) -> f64 {
    numbers.sort_by(f64::total_cmp);
    let last = numbers.len().saturating_sub(1);
    numbers.get((share * last as f64).round() as usize).copied().unwrap_or(f64::NAN)
}
