//! The copy of a mixture that learns what greedy selection picks: additive updates of the covariances of its components.

use std::io;

use faer::Mat;

use super::SelectionError;
use super::inverse_factor::{DeltaPanels, InverseFactor};
use super::pool::{Pool, PoolAtom};
use crate::component::Component;
use crate::grade::{DISTANCE_FLOOR, GradeError, THRESHOLD_FLOOR, maximum};
use crate::linear::{LinearError, product, regularised_factor, symmetrised, view};
use crate::mixture::Mixture;
use crate::rules::CovarianceUpdateKind;
use crate::search::{INFLATION_ROUNDS, inflation_factor};
use crate::update::UpdateError;

/// The components that atoms of a pool belong to. Centroids, thresholds and the assignment of atoms do not change.
#[derive(Debug)]
pub(super) struct LearnedMixture {
    components: Vec<LearnedComponent>,
    /// Place in `components` by element index and slot.
    places: Vec<Vec<usize>>,
    target: f64,
}

/// One of them.
#[derive(Debug)]
pub(super) struct LearnedComponent {
    element: usize,
    slot: usize,
    centroid: Vec<f64>,
    threshold: f64,
    covariance: Covariance,
    /// Number of updates.
    pub updates: usize,
    /// The γ of an atom under the given mixture, times this, is an upper bound of its γ under any covariance that is learned.
    pub bound_factor: f64,
}

/// A covariance C, `[D × D]`, and W of (C + εI)⁻¹ = WᵀW.
#[derive(Debug)]
struct Covariance {
    matrix: Vec<f64>,
    inverse: InverseFactor,
}

/// The atoms of a structure that belong to one component.
struct ComponentAtoms {
    /// Place of the component.
    place: usize,
    deltas: DeltaPanels,
    /// C_b = Σ **δδ**ᵀ / n, `[D × D]`.
    covariance: Vec<f64>,
}

/// New covariances for groups of atoms.
#[derive(Default)]
struct TriedUpdate {
    covariances: Vec<Covariance>,
    /// Largest γ of the atoms under them.
    gamma_max: f64,
}

/// How a structure was learned.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Learned {
    /// α of the update.
    pub alpha: f64,
    /// Largest γ of its atoms after the update.
    pub gamma_max: f64,
}

impl LearnedMixture {
    /// A copy of the components that atoms of the pool belong to. Updates bring the γ of a structure below `target`.
    ///
    /// # Errors
    /// A component without statistics or with a covariance that cannot be inverted, a pool that belongs to another mixture.
    pub fn new(mixture: &Mixture, pool: &Pool, target: f64) -> Result<Self, SelectionError> {
        let slots = |element: usize| mixture.components(element).map_or(0, <[_]>::len);
        let mut places: Vec<_> =
            (0..mixture.element_count()).map(|element| vec![usize::MAX; slots(element)]).collect();
        let mut components = Vec::new();
        for atom in pool.atoms() {
            let (element, slot) = (usize::from(atom.element), usize::from(atom.slot));
            let unknown = || GradeError::Element { atom: 0, element, elements: mixture.element_count() };
            let place = places.get_mut(element).and_then(|slots| slots.get_mut(slot)).ok_or_else(unknown)?;
            if *place == usize::MAX {
                *place = components.len();
                let component = mixture.component(element, slot).ok_or_else(unknown)?;
                components.push(LearnedComponent::new(component, element, slot)?);
            }
        }
        Ok(Self { components, places, target })
    }

    /// Place of the component of an atom of the pool.
    pub fn place(&self, atom: &PoolAtom) -> usize {
        self.places[usize::from(atom.element)][usize::from(atom.slot)]
    }

    /// The component at a place.
    pub fn component(&self, place: usize) -> &LearnedComponent {
        &self.components[place]
    }

    /// Learns atoms of the pool: C ← C + αC_b of their components, with the smallest α that brings their γ below the target, or with
    /// the largest α and the bounded inflation ([`crate::search::inflate`]).
    ///
    /// # Errors
    /// A temporary file that cannot be read, a covariance that cannot be inverted.
    pub fn learn(&mut self, pool: &Pool, mut atoms: Vec<usize>) -> Result<Learned, SelectionError> {
        let place = |atom: usize| self.place(&pool.atoms()[atom]);
        atoms.sort_by_key(|atom| place(*atom));
        let groups: Vec<_> = atoms
            .chunk_by(|a, b| place(*a) == place(*b))
            .map(|atoms| ComponentAtoms::new(pool, atoms, place(atoms[0]), self.component(place(atoms[0]))))
            .collect::<Result<_, _>>()?;
        let (alpha, mut update) = self.smallest_alpha(&groups)?;
        for _ in 0..INFLATION_ROUNDS {
            if update.gamma_max < self.target {
                break;
            }
            let factor = inflation_factor(update.gamma_max, self.target);
            let inflated =
                |k: usize| update.covariances[k].matrix.iter().map(|value| value * factor).collect();
            update = self.update(&groups, f64::INFINITY, inflated)?;
        }
        for (group, covariance) in groups.iter().zip(update.covariances) {
            let component = &mut self.components[group.place];
            component.covariance = covariance;
            component.updates += 1;
        }
        Ok(Learned { alpha, gamma_max: update.gamma_max })
    }

    /// The update with the smallest α that brings γ below the target, or with the largest. γ only falls with α, so bisection finds it.
    fn smallest_alpha(&self, groups: &[ComponentAtoms]) -> Result<(f64, TriedUpdate), SelectionError> {
        let alphas: Vec<f64> = CovarianceUpdateKind::Additive.default_alphas().into();
        let largest = alphas.len() - 1;
        let mut found = (0.0, TriedUpdate::default());
        // For most structures the first is enough.
        let (mut least, mut tried, mut enough) = (0, 0, alphas.len());
        while least < enough {
            let alpha = alphas[tried];
            let added = |k: usize| {
                let ComponentAtoms { place, covariance, .. } = &groups[k];
                let old = &self.components[*place].covariance.matrix;
                old.iter().zip(covariance).map(|(old, new)| old + alpha * new).collect()
            };
            let limit = if tried < largest { self.target } else { f64::INFINITY };
            let update = self.update(groups, limit, added)?;
            if update.gamma_max < self.target {
                enough = tried;
            } else {
                least = tried + 1;
            }
            if enough == tried || tried == largest {
                found = (alpha, update);
            }
            tried = (least + enough) / 2;
        }
        Ok(found)
    }

    /// New covariances for groups of atoms. Ends behind the first group with a γ that is not below `limit`.
    fn update(
        &self,
        groups: &[ComponentAtoms],
        limit: f64,
        covariance: impl Fn(usize) -> Vec<f64>,
    ) -> Result<TriedUpdate, SelectionError> {
        let mut update = TriedUpdate::default();
        for (k, group) in groups.iter().enumerate() {
            let component = &self.components[group.place];
            let covariance = component.new_covariance(covariance(k))?;
            let gamma = component.gamma_under(&covariance, &group.deltas);
            update.gamma_max = update.gamma_max.max(maximum(&gamma));
            update.covariances.push(covariance);
            if update.gamma_max >= limit {
                break;
            }
        }
        Ok(update)
    }
}

impl LearnedComponent {
    fn new(component: &Component, element: usize, slot: usize) -> Result<Self, SelectionError> {
        let statistics = component.statistics().ok_or(UpdateError::NoStatistics { element, slot })?;
        let (matrix, dimension) = (statistics.covariance(), component.dimension());
        let linear = |source| SelectionError::Linear { element, slot, source };
        Ok(Self {
            element,
            slot,
            centroid: component.centroid().to_vec(),
            threshold: component.threshold().max(THRESHOLD_FLOOR),
            bound_factor: bound_factor(&matrix, component.inverse(), dimension).map_err(linear)?,
            covariance: Covariance::new(matrix, dimension).map_err(linear)?,
            updates: 0,
        })
    }

    /// γ of atoms of the pool that belong to this component, `[atoms]`.
    ///
    /// # Errors
    /// A temporary file that cannot be read, a γ that is not finite.
    pub fn gamma(&self, pool: &Pool, atoms: &[usize]) -> Result<Vec<f64>, SelectionError> {
        let &Self { element, slot, .. } = self;
        let deltas = DeltaPanels::new(&pool.features_of(atoms)?, &self.centroid);
        let gamma = self.gamma_under(&self.covariance, &deltas);
        match gamma.iter().zip(atoms).find(|(gamma, _)| !gamma.is_finite()) {
            Some((&found, &atom)) => Err(GradeError::Distance { atom, element, slot, found }.into()),
            None => Ok(gamma),
        }
    }

    /// γ of atoms under another covariance, `[atoms]`.
    fn gamma_under(&self, covariance: &Covariance, deltas: &DeltaPanels) -> Vec<f64> {
        let mut values = covariance.inverse.squared_norms(deltas);
        values.iter_mut().for_each(|value| *value = (*value + DISTANCE_FLOOR).sqrt() / self.threshold);
        values
    }

    fn new_covariance(&self, matrix: Vec<f64>) -> Result<Covariance, SelectionError> {
        let &Self { element, slot, .. } = self;
        Covariance::new(matrix, self.centroid.len()).map_err(|source| SelectionError::Linear {
            element,
            slot,
            source,
        })
    }
}

impl Covariance {
    fn new(matrix: Vec<f64>, dimension: usize) -> Result<Self, LinearError> {
        let inverse = match regularised_factor(&matrix, dimension)? {
            Some(factor) => InverseFactor::of_lower(&factor),
            None => InverseFactor::of_spectrum(&matrix, dimension)?,
        };
        Ok(Self { matrix, inverse })
    }
}

impl ComponentAtoms {
    fn new(pool: &Pool, atoms: &[usize], place: usize, component: &LearnedComponent) -> io::Result<Self> {
        let dimension = component.centroid.len();
        let mut rows = pool.features_of(atoms)?;
        let deltas = DeltaPanels::new(&rows, &component.centroid);
        for row in rows.chunks_exact_mut(dimension) {
            row.iter_mut().zip(&component.centroid).for_each(|(z, centre)| *z -= centre);
        }
        let rows = view(&rows, atoms.len(), dimension);
        let mut covariance = symmetrised(product(rows.transpose(), rows).as_ref());
        covariance.iter_mut().for_each(|value| *value /= atoms.len() as f64);
        Ok(Self { place, deltas, covariance })
    }
}

/// f with γ ≤ fγ_S, where γ belongs to the covariance C and γ_S to the inverse S that a mixture has, possibly in single precision.
///
/// With C + εI = LLᵀ and **δ** = L**y**, σ² = |**y**|² and σ_S² = **y**ᵀLᵀSL**y** ≥ (1 − e)|**y**|², where e is the Frobenius norm of
/// LᵀSL − I. Without L, or if e is not below 1, f = ∞.
fn bound_factor(covariance: &[f64], inverse: &[f64], dimension: usize) -> Result<f64, LinearError> {
    let Some(factor) = regularised_factor(covariance, dimension)? else { return Ok(f64::INFINITY) };
    let lower = Mat::from_fn(
        dimension,
        dimension,
        |row, column| if row < column { 0.0 } else { factor[(row, column)] },
    );
    let right = product(view(inverse, dimension, dimension), lower.as_ref());
    let mut difference = product(lower.transpose(), right.as_ref());
    (0..dimension).for_each(|k| difference[(k, k)] -= 1.0);
    let error = difference.norm_l2();
    Ok(if error < 1.0 { 1.0 / (1.0 - error).sqrt() } else { f64::INFINITY })
}
