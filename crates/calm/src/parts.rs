//! Grades of a structure that come some atoms at a time.

use crate::grade::{GradeError, Grades};
use crate::mixture::Mixture;

/// What [`Grades::evaluate`] gives, to the last bit, where the features of a structure are known some atoms at a time.
#[derive(Debug, Clone, Default)]
pub struct GradesInParts {
    all: Grades,
    some: Grades,
    elements: Vec<usize>,
    error: Option<GradeError>,
}

impl GradesInParts {
    /// Begins with a structure of `n` atoms.
    pub fn begin(&mut self, n: usize) {
        self.error = None;
        self.all.sigma.resize(n, 0.0);
        self.all.gamma.resize(n, 0.0);
        self.all.component.resize(n, 0);
    }

    /// Grades some `atoms` of it, and writes ∂γ_a/∂**z**_a, `[atoms × D]`, which is zero where they cannot be graded.
    ///
    /// `elements` are those of the whole structure, `features` those of the atoms, `[atoms × D]`.
    pub fn add(
        &mut self,
        mixture: &Mixture,
        elements: &[usize],
        atoms: &[u32],
        features: &[f64],
        gradient: &mut [f64],
    ) {
        self.elements.clear();
        self.elements.extend(atoms.iter().map(|atom| elements[*atom as usize]));
        if let Err(error) = self.some.evaluate(mixture, &self.elements, features, Some(gradient)) {
            gradient.fill(0.0);
            self.error.get_or_insert(error.of_atoms(atoms));
            return;
        }
        for (k, atom) in atoms.iter().map(|atom| *atom as usize).enumerate() {
            self.all.sigma[atom] = self.some.sigma[k];
            self.all.gamma[atom] = self.some.gamma[k];
            self.all.component[atom] = self.some.component[k];
        }
    }

    /// The grades of all atoms.
    ///
    /// # Errors
    /// The first that was met.
    pub fn finish(&self) -> Result<&Grades, GradeError> {
        match &self.error {
            Some(error) => Err(error.clone()),
            None => Ok(&self.all),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::component::Component;

    /// Two elements, three features; what stands on the diagonals and in the centres does not matter.
    fn mixture() -> Mixture {
        let component = |k: usize| {
            let inverse = (0..9).map(|e| if e % 4 == 0 { 1.0 + (k + e) as f64 } else { 0.1 }).collect();
            Arc::new(Component::new(vec![k as f64, -1.0, 0.5], inverse, 1.5, None).unwrap())
        };
        Mixture::new(0, vec![vec![component(0), component(1)], vec![component(2)]]).unwrap()
    }

    #[test]
    fn parts_have_the_bits_of_the_whole() {
        let (mixture, elements) = (mixture(), [0, 1, 0, 1, 0]);
        let features: Vec<f64> = (0..15).map(|k| (0.7 * k as f64).sin()).collect();
        let (mut whole, mut gradient) = (Grades::default(), [0.0; 15]);
        whole.evaluate(&mixture, &elements, &features, Some(&mut gradient)).unwrap();
        let mut parts = GradesInParts::default();
        for n in [7, 5] {
            parts.begin(n); // once with more atoms, of which nothing must be left
        }
        for atoms in [&[3_u32, 0][..], &[1], &[4, 2]] {
            let rows = |of: &[f64]| {
                atoms.iter().flat_map(|a| of[*a as usize * 3..][..3].to_vec()).collect::<Vec<f64>>()
            };
            let mut part = vec![f64::NAN; 3 * atoms.len()];
            parts.add(&mixture, &elements, atoms, &rows(&features), &mut part);
            assert_eq!(part, rows(&gradient));
        }
        let found = parts.finish().unwrap();
        assert_eq!((&found.sigma, &found.gamma), (&whole.sigma, &whole.gamma));
        assert_eq!(found.component, whole.component);
    }

    #[test]
    fn an_error_names_the_atom_of_the_structure() {
        let (mixture, elements) = (mixture(), [0, 1, 0, 1]);
        let mut parts = GradesInParts::default();
        parts.begin(4);
        let mut gradient = [1.0; 6];
        parts.add(&mixture, &elements, &[0, 1], &[0.1; 6], &mut gradient);
        let mut last = [1.0; 6];
        parts.add(&mixture, &elements, &[3, 2], &[0.1, 0.1, 0.1, 0.2, f64::NAN, 0.2], &mut last);
        assert_eq!(last, [0.0; 6]);
        let error = parts.finish().unwrap_err();
        assert!(matches!(error, GradeError::Distance { atom: 2, element: 0, .. }), "{error}");
        parts.begin(4);
        assert!(parts.finish().is_ok());
    }
}
