//! Updates of the covariances from a collected structure, about fixed centroids.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::component::{Component, Statistics};
use crate::grade::{DISTANCE_FLOOR, GradeError, Grades, THRESHOLD_FLOOR};
use crate::linear::{LinearError, VECTORS_PER_PASS, dot, product, symmetric_products, symmetrised, view};
use crate::mixture::{ChangedComponent, Mixture};

/// How the new covariance of a touched component follows from the old one and that of the batch.
///
/// C_batch = Σ **δδ**ᵀ / n is taken about the fixed centroid, so it includes the distance of the batch from it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CovarianceUpdate {
    /// C ← (1 − α) C + α C_batch (paper, Methods). Directions that the batch does not visit shrink.
    Convex {
        /// Weight of the batch, 0 < α ≤ 1.
        alpha: f64,
    },
    /// C ← C + α C_batch. Nothing shrinks.
    Additive {
        /// Weight of the batch, α > 0.
        alpha: f64,
    },
    /// Adds scatter and counts as if the batch had been in the training data.
    Accumulate,
}

/// Why an update failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum UpdateError {
    /// The batch cannot be graded.
    #[error(transparent)]
    Grade(#[from] GradeError),
    /// A structure without atoms.
    #[error("a structure without atoms cannot update a mixture")]
    Empty,
    /// The mixture has no statistics and can only grade.
    #[error(
        "component {slot} of element {element} has no scatter and counts, so it cannot be updated; \
         load gmm_artifacts.npz instead of the exported model"
    )]
    NoStatistics {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
    },
    /// A covariance that cannot be inverted.
    #[error("covariance of component {slot} of element {element}: {source}")]
    Linear {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
        /// What failed.
        source: LinearError,
    },
}

/// The atoms of a structure that updates a mixture, grouped by the components they touch.
#[derive(Debug, Clone)]
pub struct Batch {
    atoms: usize,
    gamma: Vec<f64>,
    pub(crate) groups: Vec<Group>,
}

/// The atoms of a batch that belong to one component.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    pub element: usize,
    pub slot: usize,
    pub component: Arc<Component>,
    /// Indices in the batch, ascending.
    pub atoms: Vec<usize>,
    /// z − μ, `[atoms × D]`.
    pub deltas: Vec<f64>,
    /// Covariance before the update.
    pub old: Vec<f64>,
    /// Covariance of the batch about the centroid.
    pub batch: Vec<f64>,
    counts: (f64, f64),
}

impl Batch {
    /// Assigns the atoms of a structure to their nearest components.
    ///
    /// `elements` has the element index of each atom, `features` is `[atoms × D]`.
    ///
    /// # Errors
    /// A structure that has no atoms or cannot be graded, a component without statistics.
    pub fn new(mixture: &Mixture, elements: &[usize], features: &[f64]) -> Result<Self, UpdateError> {
        let mut grades = Grades::default();
        grades.evaluate(mixture, elements, features, None)?;
        let mut places: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
        for (atom, (&element, &slot)) in elements.iter().zip(&grades.component).enumerate() {
            places.entry((element, slot)).or_default().push(atom);
        }
        if places.is_empty() {
            return Err(UpdateError::Empty);
        }
        let groups = places.into_iter().filter_map(|((element, slot), atoms)| {
            let component = mixture.component(element, slot)?;
            Some(Group::new(element, slot, component, atoms, features))
        });
        Ok(Self { atoms: elements.len(), gamma: grades.gamma, groups: groups.collect::<Result<_, _>>()? })
    }

    /// γ of each atom before the update, `[atoms]`.
    pub fn gamma(&self) -> &[f64] {
        &self.gamma
    }

    /// The touched components after an update, each with its actual regularised inverse.
    ///
    /// New effective count = old + batch, new scatter = C · new effective count. Centroids and thresholds do
    /// not change.
    ///
    /// # Errors
    /// A covariance whose eigenvalues do not converge.
    pub fn updated(&self, update: CovarianceUpdate) -> Result<Vec<ChangedComponent>, UpdateError> {
        let changed = self.groups.iter().map(|group| {
            let covariance = group.updated_covariance(update);
            let (count, effective_count) = group.counts;
            let added = group.atoms.len() as f64;
            group.changed(&group.component, &covariance, count + added, effective_count + added)
        });
        changed.collect()
    }

    /// The touched components with their scatter multiplied by `factor`.
    ///
    /// `changed` comes from [`Batch::updated`] of the same batch, or from this function.
    ///
    /// # Errors
    /// As [`Batch::updated`].
    pub fn inflated(
        &self,
        changed: &[ChangedComponent],
        factor: f64,
    ) -> Result<Vec<ChangedComponent>, UpdateError> {
        let inflated = self.groups.iter().zip(changed).map(|(group, ChangedComponent { component, .. })| {
            let statistics = component.statistics().ok_or_else(|| group.no_statistics())?;
            let mut covariance = statistics.covariance();
            covariance.iter_mut().for_each(|value| *value *= factor);
            group.changed(component, &covariance, statistics.count, statistics.effective_count)
        });
        inflated.collect()
    }

    /// γ of each atom under updated components, `[atoms]`. Centroids are fixed, so the assignment does not
    /// change.
    ///
    /// `changed` comes from [`Batch::updated`] or [`Batch::inflated`] of the same batch.
    pub fn gamma_under(&self, changed: &[ChangedComponent]) -> Vec<f64> {
        let groups = self.groups.iter().zip(changed);
        self.spread(groups.map(|(group, ChangedComponent { component, .. })| group.grades_under(component)))
    }

    /// Reorders the grades of the atoms of each group to the order of the batch.
    pub(crate) fn spread(&self, grades: impl Iterator<Item = Vec<f64>>) -> Vec<f64> {
        let mut out = vec![0.0; self.atoms];
        for (group, grades) in self.groups.iter().zip(grades) {
            for (&atom, grade) in group.atoms.iter().zip(grades) {
                if let Some(place) = out.get_mut(atom) {
                    *place = grade;
                }
            }
        }
        out
    }
}

impl Group {
    fn new(
        element: usize,
        slot: usize,
        component: &Arc<Component>,
        atoms: Vec<usize>,
        features: &[f64],
    ) -> Result<Self, UpdateError> {
        let Some(statistics) = component.statistics() else {
            return Err(UpdateError::NoStatistics { element, slot });
        };
        let Statistics { count, effective_count, .. } = *statistics;
        let dimension = component.dimension();
        let mut deltas = Vec::with_capacity(atoms.len() * dimension);
        for &atom in &atoms {
            let z = features.chunks_exact(dimension).nth(atom).unwrap_or_default();
            deltas.extend(z.iter().zip(component.centroid()).map(|(z, centre)| z - centre));
        }
        let rows = view(&deltas, atoms.len(), dimension);
        let mut batch = symmetrised(product(rows.transpose(), rows).as_ref());
        batch.iter_mut().for_each(|value| *value /= atoms.len() as f64);
        Ok(Self {
            element,
            slot,
            component: Arc::clone(component),
            old: statistics.covariance(),
            batch,
            counts: (count, effective_count),
            atoms,
            deltas,
        })
    }

    pub(crate) fn updated_covariance(&self, update: CovarianceUpdate) -> Vec<f64> {
        let (old, new) = match update {
            CovarianceUpdate::Convex { alpha } => (1.0 - alpha, alpha),
            CovarianceUpdate::Additive { alpha } => (1.0, alpha),
            CovarianceUpdate::Accumulate => {
                let (before, added) = (self.counts.1, self.atoms.len() as f64);
                (before / (before + added), added / (before + added))
            }
        };
        self.old.iter().zip(&self.batch).map(|(a, b)| old * a + new * b).collect()
    }

    fn changed(
        &self,
        component: &Component,
        covariance: &[f64],
        count: f64,
        effective_count: f64,
    ) -> Result<ChangedComponent, UpdateError> {
        let &Self { element, slot, .. } = self;
        let component = component
            .with_covariance(covariance, count, effective_count)
            .map_err(|source| UpdateError::Linear { element, slot, source })?;
        Ok(ChangedComponent { element, slot, component: Arc::new(component) })
    }

    fn no_statistics(&self) -> UpdateError {
        UpdateError::NoStatistics { element: self.element, slot: self.slot }
    }

    /// γ of each atom under an updated component.
    fn grades_under(&self, component: &Component) -> Vec<f64> {
        let dimension = component.dimension();
        let mut products = vec![0.0; self.deltas.len()];
        let several = VECTORS_PER_PASS * dimension;
        for (deltas, products) in self.deltas.chunks(several).zip(products.chunks_mut(several)) {
            symmetric_products(component.inverse(), dimension, deltas, products);
        }
        let rows = self.deltas.chunks_exact(dimension).zip(products.chunks_exact(dimension));
        rows.map(|(delta, product)| self.grade(dot(delta, product))).collect()
    }

    /// γ from σ² without its floor. σ² < 0 from an ill-conditioned inverse gives γ = ∞, so that the trial
    /// fails.
    pub(crate) fn grade(&self, squared: f64) -> f64 {
        let sigma = (squared + DISTANCE_FLOOR).sqrt();
        let gamma = sigma / self.component.threshold().max(THRESHOLD_FLOOR);
        if gamma.is_nan() { f64::INFINITY } else { gamma }
    }
}
