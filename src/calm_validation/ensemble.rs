//! The disagreement of several models of the same elements on the energy (the deep ensemble of the paper's Table 1).

use std::sync::Arc;

use atoms::Structure;
use potentials::ModelWithFeatures;

use super::{AtomScore, DetectionRule};
use crate::features::FeatureCalculator;

/// Scores all atoms of a structure by the standard deviation of the energy per atom over the models, eV.
pub struct EnergySpread {
    models: Vec<Arc<dyn ModelWithFeatures>>,
    calculators: Vec<FeatureCalculator>,
}

impl EnergySpread {
    /// The spread over these models, two or more.
    pub fn new(models: Vec<Arc<dyn ModelWithFeatures>>) -> Self {
        let calculators = models.iter().cloned().map(FeatureCalculator::new).collect();
        Self { models, calculators }
    }
}

impl AtomScore for EnergySpread {
    fn name(&self) -> &str {
        "energy spread"
    }

    fn rule(&self) -> Option<DetectionRule> {
        Some(DetectionRule::TENFOLD)
    }

    fn for_thread(&self) -> Box<dyn AtomScore> {
        Box::new(Self::new(self.models.clone()))
    }

    fn score(&mut self, structure: &Structure, elements: &[usize], _: &[f64]) -> Result<Vec<f64>, String> {
        let mut energies = Vec::new();
        for calculator in &mut self.calculators {
            calculator.compute(structure).map_err(|error| error.to_string())?;
            let energy: f64 = calculator.potential.atomic_energies().iter().sum();
            energies.push(energy / structure.len() as f64);
        }
        Ok(vec![standard_deviation(&energies); elements.len()])
    }
}

fn standard_deviation(values: &[f64]) -> f64 {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    (values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_spread_is_a_standard_deviation() {
        assert!((standard_deviation(&[1.0, 2.0, 3.0, 6.0]) - 3.5_f64.sqrt()).abs() < 1e-12);
    }
}
