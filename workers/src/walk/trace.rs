//! The points of a walk's trace ([`wire::TracePoint`]), and the work of its bias.

use atoms::units::GPA_PER_EV_A3;
use atoms::{Matrix3, Structure};
use calm::grade::maximum;
use wire::{MAX_KEPT_POINTS, TracePoint, thin};

use super::{RunningWalk, WalkError, gamma};
use crate::cell_bias::CellBias;

impl RunningWalk<'_> {
    /// Counts the work of the bias up to the step that was just made, if the power of the bias is known there, and adds a point if one is
    /// due.
    pub(super) fn trace_step(&mut self) -> Result<(), WalkError> {
        if let Some(steps) = self.potential.measured_after() {
            let power = self.potential.bias_power(&self.dynamics.state().velocities);
            let time_step = self.dynamics.checkpoint().time_step;
            self.potential.state.work.advance(power, steps as f64 * time_step);
        }
        self.trace_if_due()
    }

    /// Adds a point if one is due at this step. The first is the start of the walk.
    pub(super) fn trace_if_due(&mut self) -> Result<(), WalkError> {
        let interval = self.settings.trace_interval;
        let in_reference_run = self.state.reference_run.is_some();
        if interval == 0 || in_reference_run || !self.step().is_multiple_of(interval) {
            return Ok(());
        }
        let Some(point) = self.trace_point()? else { return Ok(()) };
        self.state.trace_points += 1;
        self.trace.push(point);
        // Long assignments have many points.
        if self.trace.len() > 2 * MAX_KEPT_POINTS {
            thin(&mut self.trace);
        }
        Ok(())
    }

    /// The points since the start of the assignment, for its report.
    pub(super) fn take_trace(&mut self) -> Vec<TracePoint> {
        thin(&mut self.trace);
        std::mem::take(&mut self.trace)
    }

    /// `None` if forces and bias of the step cannot be told apart: the walk continues.
    fn trace_point(&mut self) -> Result<Option<TracePoint>, WalkError> {
        let (gamma_max, gamma_max_original) = self.largest_grades()?;
        match self.separate_bias() {
            Ok(()) => {}
            Err(WalkError::Unavailable(reason)) => return Err(WalkError::Unavailable(reason)),
            Err(_) => return Ok(None),
        }
        let trace = |tensor: &Matrix3| tensor[0][0] + tensor[1][1] + tensor[2][2];
        // The dynamics know no virial of the bias.
        let of_bias = trace(self.potential.bias_virial()) / self.dynamics.structure().cell.volume();
        let pressure = self.dynamics.pressure_tensor().map(|pressure| trace(&pressure) - of_bias);
        Ok(Some(TracePoint {
            number: self.state.trace_points,
            segment: self.state.segment,
            step: self.step(),
            time: self.step() as f64 * self.dynamics.checkpoint().time_step,
            temperature: self.dynamics.temperature(),
            pressure: pressure.map(|pressure| GPA_PER_EV_A3 * pressure / 3.0),
            relative_volume: self.relative_volume(),
            cell: cell(self.dynamics.structure()),
            conserved_energy: self.dynamics.conserved_energy(),
            gamma_max,
            bias_scale: self.potential.bias_scale(),
            cell_gain: self.state.cell_bias.as_ref().map_or(0.0, CellBias::gain),
            bias_share: self.potential.bias_share(),
            bias_work: self.potential.state.work.total,
            gamma_max_original,
        }))
    }

    /// γ_max under the walker's mixture and under the original one, if the structure can be graded.
    fn largest_grades(&mut self) -> Result<(Option<f64>, Option<f64>), WalkError> {
        let gamma_max = match gamma(&mut self.potential, &self.dynamics).map_err(WalkError::from) {
            Ok(gamma) => maximum(gamma),
            Err(WalkError::Unavailable(reason)) => return Err(WalkError::Unavailable(reason)),
            // The walk continues, or ends where its grades are needed.
            Err(_) => return Ok((None, None)),
        };
        let original = self.potential.grades_under(self.original).ok();
        Ok((Some(gamma_max), original.map(|grades| maximum(&grades.gamma))))
    }
}

/// Lengths (Å) and angles (°) of the lattice vectors, if there is a periodic direction and they span space.
fn cell(structure: &Structure) -> Option<[f64; 6]> {
    let periodic = structure.periodic.contains(&true) && structure.cell.volume() > 0.0;
    periodic.then(|| structure.cell.lengths_and_angles())
}
