//! The bias on the cell of a walk at constant pressure.
//!
//! σ_bias = −τ_s B Ŵ with the stress scale B and the averaged unit direction Ŵ of ∂𝒰/∂ε (paper, Methods and SI
//! 'Details of uncertainty-biased collection'). The gain τ_s follows the drift of the volume.

use serde::{Deserialize, Serialize};

/// Settings of the bias on the cell.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellBiasSettings {
    /// B, eV/Å³; `None` for the bulk modulus of the model at the seed structure.
    pub stress_scale: Option<f64>,
    /// τ_s at the start.
    pub gain: f64,
    /// Smallest and largest τ_s.
    pub gain_range: [f64; 2],
    /// Biased steps after which τ_s is adjusted.
    pub window: u64,
    /// Drift of V/V₀ in a window below which τ_s grows.
    pub min_drift: f64,
    /// Drift of V/V₀ in a window above which τ_s is halved.
    pub max_drift: f64,
    /// Smallest and largest V/V₀.
    pub volume_range: [f64; 2],
    /// A walk that has collected this many structures ends after `contacts_to_end` contacts.
    pub collected_to_end: u32,
    /// Contacts with a boundary of the volume within a window.
    pub contacts_to_end: u32,
}

impl Default for CellBiasSettings {
    /// The paper's where it names one. A gain of 0.02 is that of its walker (`grace_uq hal`). With a drift of 0.01 in a window, a walk
    /// of 100,000 steps crosses the range of volumes once; three times that is too fast.
    fn default() -> Self {
        Self {
            stress_scale: None,
            gain: 0.02,
            gain_range: [0.005, 0.10],
            window: 2000,
            min_drift: 0.01,
            max_drift: 0.03,
            volume_range: [0.75, 1.30],
            collected_to_end: 50,
            contacts_to_end: 3,
        }
    }
}

/// Factor on a gain that drives the volume too slowly.
const FASTER: f64 = 1.3;
/// Factor on a gain that drives it too fast or close to a boundary.
const SLOWER: f64 = 0.5;
/// What is close to a boundary, V/V₀.
const MARGIN: f64 = 0.05;

/// What a walk remembers of the bias on its cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellBias {
    /// B, eV/Å³.
    stress_scale: f64,
    /// τ_s.
    gain: f64,
    /// Steps in the window so far.
    steps: u64,
    /// Sums of V/V₀ over the first and the second half of the window.
    sums: [f64; 2],
    /// Steps of the contacts with a boundary within a window before the last.
    contacts: Vec<u64>,
}

impl CellBias {
    /// The bias at its start. `stress_scale` B in eV/Å³.
    pub fn new(settings: &CellBiasSettings, stress_scale: f64) -> Self {
        Self { stress_scale, gain: settings.gain, steps: 0, sums: [0.0; 2], contacts: Vec::new() }
    }

    /// τ_s.
    pub fn gain(&self) -> f64 {
        self.gain
    }

    /// τ_s B, eV/Å³.
    pub fn stress(&self) -> f64 {
        self.gain * self.stress_scale
    }

    /// Takes note of V/V₀ after a biased step, and adjusts τ_s at the end of a window.
    pub fn observe(&mut self, settings: &CellBiasSettings, relative_volume: f64) {
        let half = settings.window / 2;
        self.sums[usize::from(self.steps >= half)] += relative_volume;
        self.steps += 1;
        if self.steps < settings.window {
            return;
        }
        let means = [self.sums[0] / half as f64, self.sums[1] / (settings.window - half) as f64];
        // The means lie half a window apart.
        let drift = 2.0 * (means[1] - means[0]).abs();
        let [low, high] = settings.volume_range;
        let near_boundary = means[1] < low + MARGIN || means[1] > high - MARGIN;
        let factor = match drift {
            _ if near_boundary => SLOWER,
            drift if drift > settings.max_drift => SLOWER,
            drift if drift < settings.min_drift => FASTER,
            _ => 1.0,
        };
        let [smallest, largest] = settings.gain_range;
        self.gain = (factor * self.gain).clamp(smallest, largest);
        (self.steps, self.sums) = (0, [0.0; 2]);
    }

    /// The bias with its gain multiplied by `factor`, after a roll back.
    pub fn weakened(self, settings: &CellBiasSettings, factor: f64) -> Self {
        let [smallest, largest] = settings.gain_range;
        Self { gain: (factor * self.gain).clamp(smallest, largest), ..self }
    }

    /// Takes note of a contact with a boundary at `step`.
    pub fn touch(&mut self, settings: &CellBiasSettings, step: u64) {
        self.contacts.retain(|contact| step.saturating_sub(*contact) <= settings.window);
        self.contacts.push(step);
    }

    /// Whether a walk at `step` that has collected this many structures has touched the boundary so often within a window that
    /// it ends.
    pub fn ends(&self, settings: &CellBiasSettings, step: u64, collected: u64) -> bool {
        let recent = |contact: &&u64| step.saturating_sub(**contact) <= settings.window;
        let contacts = self.contacts.iter().filter(recent).count();
        collected >= u64::from(settings.collected_to_end) && contacts >= settings.contacts_to_end as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paper() -> CellBiasSettings {
        CellBiasSettings::default()
    }

    /// The gain after a window in which V/V₀ changes linearly.
    fn after(bias: &mut CellBias, from: f64, to: f64) -> f64 {
        let steps = paper().window;
        (0..steps).for_each(|step| bias.observe(&paper(), from + (to - from) * step as f64 / steps as f64));
        bias.gain()
    }

    #[test]
    fn the_gain_follows_the_drift_of_the_volume() {
        let mut bias = CellBias::new(&paper(), 0.5);
        assert_eq!(bias.stress(), 0.01);
        bias.observe(&paper(), 1.0);
        assert_eq!(bias.gain(), 0.02, "before the end of the window");
        let mut bias = CellBias::new(&paper(), 0.5);
        assert_eq!(after(&mut bias, 1.0, 1.009), 0.02 * 1.3, "below the pace");
        assert_eq!(after(&mut bias, 1.01, 0.999), 0.02 * 1.3, "at the pace");
        assert_eq!(after(&mut bias, 1.0, 0.969), 0.5 * (0.02 * 1.3), "too fast");
        assert_eq!(after(&mut bias, 1.25, 1.27), 0.25 * (0.02 * 1.3), "near the upper boundary");
        assert_eq!(after(&mut bias, 0.79, 0.79), 0.005, "near the lower one, and at the smallest gain");
        (0..20).for_each(|_| _ = after(&mut bias, 1.0, 1.0));
        assert_eq!(bias.gain(), 0.10, "at the largest gain");
    }

    /// Noise of the volume is no drift.
    #[test]
    fn fluctuations_are_averaged() {
        let mut bias = CellBias::new(&paper(), 0.5);
        let noise = |step: u64| if step.is_multiple_of(2) { 0.05 } else { -0.05 };
        (0..paper().window).for_each(|step| bias.observe(&paper(), 1.0 + noise(step)));
        assert_eq!(bias.gain(), 0.02 * 1.3);
    }

    #[test]
    fn a_walk_ends_at_its_boundary_once_it_has_collected_enough() {
        let mut bias = CellBias::new(&paper(), 0.5);
        for step in [100, 1000, 2101] {
            bias.touch(&paper(), step);
        }
        assert!(!bias.ends(&paper(), 2101, 500), "in 2001 steps");
        bias.touch(&paper(), 2500);
        assert!(bias.ends(&paper(), 2500, 50) && !bias.ends(&paper(), 2500, 49));
        assert!(bias.ends(&paper(), 3000, 50) && !bias.ends(&paper(), 3001, 50), "long after");
    }

    #[test]
    fn a_roll_back_weakens_the_bias() {
        let bias = CellBias::new(&paper(), 0.5).weakened(&paper(), 0.5);
        assert_eq!(bias.gain(), 0.01);
        assert_eq!(bias.weakened(&paper(), 0.1).gain(), 0.005, "not below the smallest gain");
    }
}
