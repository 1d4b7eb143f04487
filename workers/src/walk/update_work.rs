//! The energy that an update of the mixture gives to a biased walk.
//!
//! The bias is a potential −τ_r Σγ. An update that covers what the walk visits lowers Σγ at once and so lifts the walk by
//! τ_r (Σγ_before − Σγ_after), which becomes heat. [`RunningWalk::remove_update_work`] takes it out of the kinetic energy, as the reference's
//! walker does (`grace_uq hal --remove-update-work`).

use super::{RunningWalk, WalkError, gamma};

/// Share of the kinetic energy at the temperature of the thermostat that is never taken.
const FLOOR: f64 = 0.5;

impl RunningWalk<'_> {
    /// Σγ with the version of the mixture, if the bias acts and its work is wanted.
    pub(super) fn bias_sum(&mut self) -> Option<(u64, f64)> {
        if !self.settings.remove_update_work || self.potential.bias_scale() == 0.0 {
            return None;
        }
        let gamma = gamma(&mut self.potential, &self.dynamics).ok()?;
        Some((self.mixture_version, gamma.iter().sum()))
    }

    /// Takes out of the kinetic energy what an update since the last step has given to the walk, if that is more than nothing.
    pub(super) fn remove_update_work(&mut self) -> Result<(), WalkError> {
        let Some((version, before)) = self.state.bias_sum.filter(|_| self.settings.remove_update_work) else {
            return Ok(());
        };
        if version == self.mixture_version || self.potential.state.gradient_norm <= 0.0 {
            return Ok(());
        }
        // The bias is off in this evaluation, which no average follows.
        self.potential.tau = 0.0;
        let after: f64 = gamma(&mut self.potential, &self.dynamics)?.iter().sum();
        self.state.bias_sum = Some((self.mixture_version, after));
        let averages = self.potential.state;
        let scale = self.state.tau * averages.force_norm / averages.gradient_norm;
        let work = scale * (before - after);
        let present = self.dynamics.kinetic_energy();
        let temperature = self.assignment.conditions.temperature;
        let thermal = md::thermal_energy(temperature, self.dynamics.degrees_of_freedom());
        let kept = (present - work).max(FLOOR * thermal);
        if kept < present {
            let factor = (kept / present).sqrt();
            self.dynamics.scale_velocities(factor);
            self.potential.state.work.velocities_scaled(factor, kept - present);
        }
        Ok(())
    }
}
