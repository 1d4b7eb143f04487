//! `calmwalk md`

mod config;

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::Instant;

use atoms::Potential;
use atoms::units::GPA_PER_EV_A3;
use md::{Dynamics, DynamicsSettings, State, Stream, default_time_step};

use self::config::{DynamicsSection, MdConfig, OutputSection};
use super::{CommandError, ExitStatus};
use crate::atomic_file::refuse_to_replace;
use crate::output::{Bar, count, decimals, print};
use crate::signals;
use crate::trajectory::{Trajectory, TrajectoryStep};

const BAR: &str = "{bar:32} {pos}/{len} steps  {eta} left  {msg}";

/// Run unbiased molecular dynamics with any supported potential
///
/// Writes a trajectory, extended XYZ or a LAMMPS dump as its name says, with energy (eV), forces (eV/Å), stress (eV/Å³, tension positive, without the kinetic
/// part), momenta (in the units of ASE), step, time_fs and temperature (K; 3n − 3 degrees of freedom if the momentum is
/// conserved, 3n with Langevin). With dynamics.barostat, the lines of progress have the pressure (GPa, that of the atoms'
/// motion included) and the volume relative to that at the start. On Ctrl-C or SIGTERM, writes the last step and exits.
#[derive(Debug, clap::Args)]
pub struct MdArgs {
    /// Configuration (TOML): structure, [potential], [dynamics], [output]; see configs/md-aluminium.toml
    #[arg(value_name = "CONFIG")]
    config: PathBuf,
    /// Trajectory file [default: output.trajectory of the configuration]
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
}

impl MdArgs {
    pub fn run(self) -> Result<ExitStatus, CommandError> {
        let (config, start, mut potential) = MdConfig::load(&self.config)?;
        let path = self.output.unwrap_or_else(|| config.output.trajectory.clone());
        let inputs = [
            (self.config.as_path(), "the configuration"),
            (config.structure.get_ref().as_path(), "the structure to start from"),
            (config.potential.get_ref().as_path(), "the potential"),
        ];
        refuse_to_replace(&path, inputs)?;
        let state = initial_state(&config.dynamics, start.structure);
        let settings = settings(&config.dynamics, &state);
        let mut dynamics = Dynamics::new(state, settings, &mut *potential).map_err(|error| {
            CommandError::Input(format!("{}:{}: {error}", config.structure.get_ref().display(), start.line))
        })?;
        let stopping = signals::stop_token()?;
        let mut trajectory = Trajectory::create(&path)?;
        let started = Instant::now();
        let progress = MdProgress::new(&config, &dynamics);
        let outcome = integrate(&mut dynamics, &mut *potential, config.dynamics.steps, |dynamics| {
            progress.update(dynamics);
            if dynamics.state().step.is_multiple_of(config.output.every.get()) {
                trajectory.push(&TrajectoryStep::of_run(dynamics))?;
            }
            Ok(!stopping.is_cancelled())
        });
        drop(progress);
        if outcome.is_ok() && !dynamics.state().step.is_multiple_of(config.output.every.get()) {
            trajectory.push(&TrajectoryStep::of_run(&dynamics))?;
        }
        let (frames, file) = (trajectory.frames, path.display());
        trajectory.finish()?;
        outcome.map_err(|failure| match failure {
            CommandError::Failed(message) => {
                CommandError::Failed(format!("{message}; {frames} frames are in {file}"))
            }
            other => other,
        })?;
        print(|out| {
            let (steps, seconds) = (dynamics.state().step, started.elapsed().as_secs_f64());
            let atoms = dynamics.structure().len();
            let (steps, atoms, frames) = (count(steps, "step"), count(atoms, "atom"), count(frames, "frame"));
            writeln!(out, "{steps} of {atoms} in {seconds:.1} s, {frames} in {file}")
        })?;
        let interrupted = dynamics.state().step < config.dynamics.steps;
        Ok(if interrupted { ExitStatus::Interrupted } else { ExitStatus::Done })
    }
}

/// Maxwell–Boltzmann velocities.
fn initial_state(dynamics: &DynamicsSection, structure: atoms::Structure) -> State {
    State::thermal(structure, dynamics.temperature.get(), &Stream::new(dynamics.rng_seed, 0, 0))
}

fn settings(dynamics: &DynamicsSection, state: &State) -> DynamicsSettings {
    let default = default_time_step(&state.structure.species);
    let temperature = dynamics.temperature.get();
    let thermostat = dynamics.thermostat.start(temperature);
    let barostat = dynamics.barostat.map(|it| it.start(temperature, &thermostat, &state.structure));
    DynamicsSettings {
        time_step: dynamics.time_step.map_or(default, |time_step| time_step.get()),
        thermostat,
        cell_motion: barostat.into(),
        stream: Stream::new(dynamics.rng_seed, 0, 0),
        skin: dynamics.skin.get(),
    }
}

/// Makes `steps` steps. Calls `observe` before the first and after every step, and stops early if it returns false.
fn integrate(
    dynamics: &mut Dynamics,
    potential: &mut dyn Potential,
    steps: u64,
    mut observe: impl FnMut(&Dynamics) -> Result<bool, CommandError>,
) -> Result<(), CommandError> {
    while observe(dynamics)? && dynamics.state().step < steps {
        let step = dynamics.state().step + 1;
        dynamics.step(potential).map_err(|error| CommandError::Failed(format!("step {step}: {error}")))?;
    }
    Ok(())
}

/// Reports progress: with a bar on a terminal, otherwise with lines.
struct MdProgress {
    every: u64,
    /// With a barostat: volume at the start, Å³.
    volume: Option<f64>,
    bar: Option<Bar>,
}

impl MdProgress {
    fn new(config: &MdConfig, start: &Dynamics) -> Self {
        let OutputSection { every, log_every, .. } = config.output;
        let volume = config.dynamics.barostat.map(|_| md::extent(start.structure()));
        let bar = std::io::stderr().is_terminal().then(|| Bar::new(Some(config.dynamics.steps), BAR));
        let titles = ["step", "time (ps)", "energy (eV)", "temperature (K)", "conserved (eV)"];
        if bar.is_none() {
            let of_cell: &[_] = if volume.is_some() { &["pressure (GPa)", "volume/first"] } else { &[] };
            print_row(titles.iter().chain(of_cell).map(|title| (*title).to_owned()));
        }
        Self { every: log_every.unwrap_or(every).get(), volume, bar }
    }

    fn update(&self, dynamics: &Dynamics) {
        let step = dynamics.state().step;
        if let Some(bar) = &self.bar {
            bar.set(step, || format!("{:.0} K", dynamics.temperature()));
        } else if step.is_multiple_of(self.every) {
            let mut row = vec![
                step.to_string(),
                format!("{:.3}", TrajectoryStep::of_run(dynamics).time / 1000.0),
                format!("{:.6}", dynamics.evaluation().energy()),
                format!("{:.1}", dynamics.temperature()),
                decimals(dynamics.conserved_energy(), 6),
            ];
            if let Some(volume) = self.volume {
                let pressure = dynamics.pressure_tensor();
                let mean = pressure.map(|p| GPA_PER_EV_A3 * (p[0][0] + p[1][1] + p[2][2]) / 3.0);
                row.push(decimals(mean, 3));
                row.push(format!("{:.4}", md::extent(dynamics.structure()) / volume));
            }
            print_row(row.into_iter());
        }
    }
}

/// Prints a row to standard error, ignoring errors.
fn print_row(columns: impl Iterator<Item = String>) {
    const WIDTHS: [usize; 7] = [10, 10, 16, 15, 16, 14, 12];
    let columns = columns.zip(WIDTHS).map(|(text, width)| format!("{text:>width$}"));
    let _ = writeln!(std::io::stderr().lock(), "{}", columns.collect::<Vec<_>>().join("  "));
}
