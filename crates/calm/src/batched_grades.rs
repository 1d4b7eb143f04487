//! Grades of a structure computed in batches of atoms.

use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::grade::{GradeError, Grades};
use crate::mixture::Mixture;

/// Gives the same bits as [`Grades::evaluate`] where the features of a structure arrive in batches of atoms
/// from several threads.
#[derive(Debug, Default)]
pub struct BatchedGrades {
    collected: Mutex<Collected>,
    /// Buffers that no thread uses.
    idle: Mutex<Vec<GradeBuffers>>,
}

#[derive(Debug, Default)]
struct Collected {
    grades: Grades,
    error: Option<GradeError>,
}

/// Buffers of one thread.
#[derive(Debug, Default)]
struct GradeBuffers {
    elements: Vec<usize>,
    grades: Grades,
}

impl BatchedGrades {
    /// Starts a structure of `n` atoms.
    pub fn begin(&mut self, n: usize) {
        let Collected { grades, error } = self.collected.get_mut().unwrap_or_else(PoisonError::into_inner);
        *error = None;
        grades.sigma.resize(n, 0.0);
        grades.gamma.resize(n, 0.0);
        grades.component.resize(n, 0);
    }

    /// Grades the batch `atoms` and writes ∂γ_a/∂**z**_a, `[atoms × D]`, unless `gradient` is empty. The
    /// gradient is zero where grading fails.
    ///
    /// `elements` has the element index of every atom of the structure, `features` the features of the batch,
    /// `[atoms × D]`.
    pub fn add(
        &self,
        mixture: &Mixture,
        elements: &[usize],
        atoms: &[u32],
        features: &[f64],
        gradient: &mut [f64],
    ) {
        let mut scratch = lock(&self.idle).pop().unwrap_or_default();
        scratch.elements.clear();
        scratch.elements.extend(atoms.iter().map(|atom| elements[*atom as usize]));
        let result = scratch.grades.evaluate(
            mixture,
            &scratch.elements,
            features,
            (!gradient.is_empty()).then_some(&mut *gradient),
        );
        if result.is_err() {
            gradient.fill(0.0);
        }
        lock(&self.collected).add(atoms, result.map(|()| &scratch.grades));
        lock(&self.idle).push(scratch);
    }

    /// The grades of all atoms.
    ///
    /// # Errors
    /// The error of the first atom that has one.
    pub fn finish(&mut self) -> Result<&Grades, GradeError> {
        let Collected { grades, error } = self.collected.get_mut().unwrap_or_else(PoisonError::into_inner);
        match error {
            Some(error) => Err(error.clone()),
            None => Ok(grades),
        }
    }
}

impl Collected {
    fn add(&mut self, atoms: &[u32], result: Result<&Grades, GradeError>) {
        match result {
            Ok(some) => {
                for (k, atom) in atoms.iter().map(|atom| *atom as usize).enumerate() {
                    self.grades.sigma[atom] = some.sigma[k];
                    self.grades.gamma[atom] = some.gamma[k];
                    self.grades.component[atom] = some.component[k];
                }
            }
            Err(error) => {
                let error = error.with_atom_indices(atoms);
                if self.error.as_ref().is_none_or(|known| error.atom() < known.atom()) {
                    self.error = Some(error);
                }
            }
        }
    }
}

/// A poisoned lock is harmless: what a panicked thread left here is never read.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::component::Component;

    /// Two elements, three features, arbitrary centroids and diagonals.
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
        let mut parts = BatchedGrades::default();
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
        let collected = parts.finish().unwrap();
        assert_eq!((&collected.sigma, &collected.gamma), (&whole.sigma, &whole.gamma));
        assert_eq!(collected.component, whole.component);
    }

    #[test]
    fn an_error_names_the_atom_of_the_structure() {
        let (mixture, elements) = (mixture(), [0, 1, 0, 1]);
        let mut parts = BatchedGrades::default();
        parts.begin(4);
        let mut gradient = [1.0; 6];
        parts.add(&mixture, &elements, &[0, 1], &[0.1; 6], &mut gradient);
        let mut last = [1.0; 6];
        parts.add(&mixture, &elements, &[3, 2], &[0.1, 0.1, 0.1, 0.2, f64::NAN, 0.2], &mut last);
        assert_eq!(last, [0.0; 6]);
        parts.add(&mixture, &elements, &[3], &[f64::NAN; 3], &mut [1.0; 3]);
        let error = parts.finish().unwrap_err();
        assert!(matches!(error, GradeError::Distance { atom: 2, element: 0, .. }), "{error}");
        parts.begin(4);
        assert!(parts.finish().is_ok());
    }
}
