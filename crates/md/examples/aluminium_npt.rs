//! Aluminium at 1 bar with a fully flexible cell, for comparison with LAMMPS (`npt_against_lammps.py` beside this file).
//!
//! `cargo run --release -p md --example aluminium_npt -- START SERIES TEMPERATURE STEPS EVERY THERMOSTAT STRETCH`
//!
//! Writes the initial positions and velocities of 108 atoms to START and, every EVERY steps of 2 fs, a line to SERIES:
//! step, potential energy per atom (eV), volume (Å³), temperature (K), pressure (bar), lengths of the lattice vectors (Å).
//! THERMOSTAT is `chain`, `rescaling`, `langevin` or `none` (constant enthalpy). The crystal is stretched by the factor STRETCH along z.

use std::fmt::Write as _;
use std::path::PathBuf;

use atoms::cell::norm;
use atoms::{Cell, Structure};
use md::{
    BAR_PER_EV_A3, BarostatSettings, Dynamics, DynamicsSettings, LangevinSettings, NoseHooverSettings, State,
    Stream, ThermostatSettings, VelocityRescalingSettings,
};
use potentials::Eam;

const POTENTIAL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/data/Al_mm.eam.fs");

/// Lattice constant, Å.
const LATTICE_CONSTANT: f64 = 4.06;

/// Cubic cells in each direction.
const REPETITION: usize = 3;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [start, series, temperature, steps, every, thermostat, stretch] = &arguments[..] else {
        return Err("arguments: START SERIES TEMPERATURE STEPS EVERY THERMOSTAT STRETCH".into());
    };
    let (temperature, every): (f64, u64) = (temperature.parse()?, every.parse()?);
    let mut potential = Eam::load(POTENTIAL)?;
    let mut dynamics = begin(temperature, thermostat, stretch.parse()?, &mut potential)?;
    std::fs::write(PathBuf::from(start), phase_space(dynamics.state()))?;
    let mut lines = line(&dynamics);
    for step in 1..=steps.parse()? {
        dynamics.step(&mut potential)?;
        if step % every == 0 {
            lines += &line(&dynamics);
        }
    }
    std::fs::write(PathBuf::from(series), lines)?;
    Ok(())
}

fn begin(
    temperature: f64,
    thermostat: &str,
    stretch: f64,
    potential: &mut Eam,
) -> Result<Dynamics, Box<dyn std::error::Error>> {
    let thermostat = match thermostat {
        "chain" => {
            ThermostatSettings::NoseHoover(NoseHooverSettings { relaxation_time: 100.0, chain_length: 3 })
        }
        "rescaling" => {
            ThermostatSettings::VelocityRescaling(VelocityRescalingSettings { relaxation_time: 100.0 })
        }
        "langevin" => ThermostatSettings::Langevin(LangevinSettings { friction: 0.01 }),
        "none" => ThermostatSettings::None {},
        other => return Err(format!("thermostat {other}: chain, rescaling, langevin or none").into()),
    };
    let stream = Stream::new(24, 0, 0);
    // Half of the kinetic energy becomes potential energy.
    let state = State::thermal(crystal(stretch), 2.0 * temperature, &stream);
    let thermostat = thermostat.start(temperature);
    let cell_motion = BarostatSettings::default().start(temperature, &thermostat, &state.structure).into();
    let settings = DynamicsSettings { time_step: 2.0, thermostat, cell_motion, stream, skin: 0.5 };
    Ok(Dynamics::new(state, settings, potential)?)
}

fn crystal(stretch: f64) -> Structure {
    let basis = [[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [0.5, 0.0, 0.5], [0.0, 0.5, 0.5]];
    let constants = [LATTICE_CONSTANT, LATTICE_CONSTANT, stretch * LATTICE_CONSTANT];
    let mut positions = Vec::new();
    for cell in 0..REPETITION.pow(3) {
        let corner = [cell % REPETITION, cell / REPETITION % REPETITION, cell / REPETITION.pow(2)];
        positions.extend(basis.map(|b| std::array::from_fn(|k| constants[k] * (corner[k] as f64 + b[k]))));
    }
    let [a, b, c] = constants.map(|constant| constant * REPETITION as f64);
    let aluminium = "Al".parse().expect("a symbol");
    Structure {
        species: vec![aluminium; positions.len()],
        positions,
        cell: Cell::orthorhombic(a, b, c),
        periodic: [true; 3],
    }
}

/// The lengths of the cell, then positions (Å) and velocities (Å/fs) of an atom on each line.
fn phase_space(state: &State) -> String {
    let [a, b, c] = state.structure.cell.0.map(norm);
    let mut text = format!("{a} {b} {c} 0 0 0\n");
    for ([x, y, z], [u, v, w]) in state.structure.positions.iter().zip(&state.velocities) {
        let _ = writeln!(text, "{x} {y} {z} {u} {v} {w}");
    }
    text
}

fn line(dynamics: &Dynamics) -> String {
    let structure = dynamics.structure();
    let energy = dynamics.evaluation().energy() / structure.len() as f64;
    let tensor = dynamics.pressure_tensor().unwrap_or_default();
    let pressure = BAR_PER_EV_A3 * (tensor[0][0] + tensor[1][1] + tensor[2][2]) / 3.0;
    let [a, b, c] = structure.cell.0.map(norm);
    let (step, volume, temperature) =
        (dynamics.state().step, structure.cell.volume(), dynamics.temperature());
    format!("{step} {energy:.9} {volume:.6} {temperature:.4} {pressure:.3} {a:.7} {b:.7} {c:.7}\n")
}
