//! Disagreement of several models.

use std::fmt;

/// Forces of models that do not describe the same atoms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EnsembleError {
    /// Index of the model.
    pub model: usize,
    /// Its number of atoms.
    pub found: usize,
    /// That of the first.
    pub expected: usize,
}

impl fmt::Display for EnsembleError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { model, found, expected } = self;
        write!(
            f,
            "model {model} has forces of {found} atoms, the first has {expected}; expected two or more models of the same atoms"
        )
    }
}

impl std::error::Error for EnsembleError {}

/// The norm of the standard deviation of the force over M models, for each atom, eV/Å:
/// √(Σ_α (1/M) Σ_m (F_mα − ⟨F_α⟩)²) (paper, Methods, "Validation models, datasets and metrics").
///
/// `forces` is `[models][atoms]`, eV/Å.
///
/// # Errors
/// Fewer than two models, or unequal numbers of atoms.
pub fn force_deviation<F: AsRef<[[f64; 3]]>>(forces: &[F]) -> Result<Vec<f64>, EnsembleError> {
    let expected = forces.first().map_or(0, |first| first.as_ref().len());
    if forces.len() < 2 {
        return Err(EnsembleError { model: forces.len(), found: 0, expected });
    }
    if let Some((model, other)) = forces.iter().enumerate().find(|(_, of)| of.as_ref().len() != expected) {
        return Err(EnsembleError { model, found: other.as_ref().len(), expected });
    }
    let deviation = |atom: usize| {
        let along = |axis: usize| standard_deviation(forces.iter().map(move |of| of.as_ref()[atom][axis]));
        let [x, y, z] = [along(0), along(1), along(2)];
        (x * x + y * y + z * z).sqrt()
    };
    Ok((0..expected).map(deviation).collect())
}

/// √((1/M) Σ (x − ⟨x⟩)²); 0 without values.
pub fn standard_deviation(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / count;
    (values.map(|x| (x - mean) * (x - mean)).sum::<f64>() / count).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deviations_are_those_of_numpy() {
        let models = [
            vec![[0.1, -0.2, 0.3], [1.0, 2.0, 3.0]],
            vec![[0.4, 0.1, -0.3], [1.0, 2.0, 3.0]],
            vec![[-0.2, 0.5, 0.6], [1.0, 2.0, 3.0]],
        ];
        // np.linalg.norm(np.std(models, axis=0), axis=-1)
        let found = force_deviation(&models).unwrap();
        assert!((found[0] - 0.5312459150169743).abs() < 1e-15, "{found:?}");
        assert_eq!(found[1], 0.0);
        assert_eq!(standard_deviation([2.0, 4.0].into_iter()), 1.0);
        assert_eq!(standard_deviation(std::iter::empty()), 0.0);
    }

    #[test]
    fn models_must_describe_the_same_atoms() {
        let one = vec![[0.0; 3]; 2];
        let found = force_deviation(&[one.clone(), vec![[0.0; 3]]]).unwrap_err();
        assert_eq!(found, EnsembleError { model: 1, found: 1, expected: 2 });
        assert!(force_deviation(&[one]).is_err());
        assert!(force_deviation::<Vec<[f64; 3]>>(&[]).is_err());
    }
}
