//! Farthest points: structures whose atoms are far from all that was picked.

use std::collections::HashMap;

use super::SelectionError;
use super::lazy_heap::{Bound, LazyHeap};
use super::pool::Pool;
use super::rows::FeatureRows;
use crate::grade::GradeError;
use crate::linear::{LinearError, cholesky, eigen, squared_distance, view};
use crate::mixture::Mixture;

/// Picked atoms to which an atom is compared at a time.
const CHUNK: usize = 64;

/// What distances are.
#[derive(Debug, Clone, Copy)]
pub enum Metric<'a> {
    /// Between atoms within the window of one element, of features that the mixture whitens: Lᵀ(**z** − **μ**) of the nearest
    /// component with the inverse covariance S = LLᵀ. Within a component this is the Mahalanobis distance.
    Whitened(&'a Mixture),
    /// Between the features of any two atoms.
    Plain,
}

/// Picks atoms, each the farthest from its nearest picked atom (Gonzalez, Theoretical Computer Science 1985), and with them their
/// structures, in the order in which the first of their atoms is picked.
///
/// An atom of an element without a picked atom is infinitely far; of several, that with the largest γ comes first.
#[derive(Debug)]
pub struct FarthestPoints<'a> {
    pool: &'a Pool,
    /// Rows that distances are between, of the atoms that may be picked.
    points: FeatureRows,
    /// Row of each of these atoms, and its group, whose centres it is compared to.
    rows: Vec<(usize, usize)>,
    /// The picked atoms of each group, `[centres × D]`.
    centres: Vec<Vec<f64>>,
    /// Of the squared distance of an atom that may be picked to the nearest centre of its group: its version is the number of centres
    /// that the atom was compared to, and the γ of those that were compared to none is their preference.
    bounds: LazyHeap,
    taken: Vec<bool>,
}

/// A structure that was picked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FarthestPoint {
    /// Its index in the pool.
    pub structure: usize,
    /// Distance of its atom to the nearest one picked before; infinite if there is none.
    pub distance: f64,
}

impl<'a> FarthestPoints<'a> {
    /// Prepares the picks. Atoms of structures that were `picked` before count as picked: with [`Metric::Whitened`] those within
    /// the window, otherwise all that the pool has.
    ///
    /// # Errors
    /// A pool that belongs to another mixture, an inverse covariance without a factor, a file that cannot be read or written.
    pub fn new(
        pool: &'a Pool,
        metric: Metric<'_>,
        picked: impl IntoIterator<Item = usize>,
    ) -> Result<Self, SelectionError> {
        let (points, rows) = (pool.features().empty_like(), Vec::new());
        let taken = vec![false; pool.len()];
        let mut found = Self { pool, points, rows, centres: Vec::new(), bounds: LazyHeap::default(), taken };
        picked.into_iter().for_each(|structure| found.taken[structure] = true);
        let mut factors = HashMap::new();
        for (index, atom) in pool.atoms().iter().enumerate() {
            let mut point = Vec::with_capacity(pool.features().dimension());
            let group = match metric {
                Metric::Whitened(_) if !pool.window().has(atom.gamma) => continue,
                Metric::Whitened(mixture) => {
                    let (element, slot) = (usize::from(atom.element), usize::from(atom.slot));
                    let factor = match factors.entry((element, slot)) {
                        std::collections::hash_map::Entry::Occupied(known) => known.into_mut(),
                        std::collections::hash_map::Entry::Vacant(place) => {
                            place.insert(Whitening::new(mixture, element, slot)?)
                        }
                    };
                    let mut features = Vec::with_capacity(point.capacity());
                    pool.features().read(index..index + 1, &mut features)?;
                    factor.apply(&features, &mut point);
                    element
                }
                Metric::Plain => {
                    pool.features().read(index..index + 1, &mut point)?;
                    0
                }
            };
            found.add(index, group, &point)?;
        }
        Ok(found)
    }

    fn add(&mut self, atom: usize, group: usize, point: &[f64]) -> Result<(), SelectionError> {
        if self.centres.len() <= group {
            self.centres.resize(group + 1, Vec::new());
        }
        let known = &self.pool.atoms()[atom];
        if self.taken[known.structure as usize] {
            self.centres[group].extend_from_slice(point);
            return Ok(());
        }
        let index = self.rows.len();
        self.rows.push((atom, group));
        self.points.push(point)?;
        self.bounds.push(Bound { value: f64::INFINITY, preference: known.gamma, index, version: 0 });
        Ok(())
    }

    /// Picks atoms until one belongs to a new structure, which is returned. `None` when every atom left coincides with a picked
    /// one.
    ///
    /// # Errors
    /// A temporary file that cannot be read.
    pub fn pick(&mut self) -> Result<Option<FarthestPoint>, SelectionError> {
        let (dimension, mut point) = (self.points.dimension(), Vec::new());
        while let Some(mut top) = self.bounds.pop() {
            let (atom, group) = self.rows[top.index];
            let behind = &self.centres[group][top.version * dimension..];
            point.clear();
            self.points.read(top.index..top.index + 1, &mut point)?;
            if !behind.is_empty() {
                let distances =
                    behind.chunks_exact(dimension).take(CHUNK).map(|centre| squared_distance(centre, &point));
                top.value = distances.fold(top.value, f64::min);
                top.preference = 0.0;
                top.version += CHUNK.min(behind.len() / dimension);
                self.bounds.push(top);
                continue;
            }
            if top.value <= 0.0 {
                return Ok(None);
            }
            self.centres[group].extend_from_slice(&point);
            let structure = self.pool.atoms()[atom].structure as usize;
            if !std::mem::replace(&mut self.taken[structure], true) {
                return Ok(Some(FarthestPoint { structure, distance: top.value.sqrt() }));
            }
        }
        Ok(None)
    }
}

/// **μ** and L of a component, S = LLᵀ.
#[derive(Debug)]
struct Whitening {
    centroid: Vec<f64>,
    /// Lᵀ, row-major.
    transposed: Vec<f64>,
}

impl Whitening {
    fn new(mixture: &Mixture, element: usize, slot: usize) -> Result<Self, SelectionError> {
        let unknown = GradeError::Element { atom: 0, element, elements: mixture.element_count() };
        let component = mixture.component(element, slot).ok_or(unknown)?;
        let dimension = component.dimension();
        let transposed = match cholesky(component.inverse(), dimension) {
            Some(factor) => (0..dimension * dimension)
                .map(|k| (k / dimension, k % dimension))
                .map(|(row, column)| if column >= row { factor[(column, row)] } else { 0.0 })
                .collect(),
            None => root(component.inverse(), dimension).map_err(|source| SelectionError::Linear {
                element,
                slot,
                source,
            })?,
        };
        Ok(Self { centroid: component.centroid().to_vec(), transposed })
    }

    fn apply(&self, z: &[f64], out: &mut Vec<f64>) {
        let delta: Vec<f64> = z.iter().zip(&self.centroid).map(|(z, centre)| z - centre).collect();
        let rows = self.transposed.chunks_exact(delta.len());
        out.extend(rows.map(|row| crate::linear::dot(row, &delta)));
    }
}

/// √w Uᵀ of S = U w Uᵀ, row-major, for an S that is only positive semidefinite: eigenvalues below zero are rounding.
fn root(inverse: &[f64], dimension: usize) -> Result<Vec<f64>, LinearError> {
    let found = eigen(view(inverse, dimension, dimension))?;
    let rows = found.values.iter().enumerate();
    Ok(rows
        .flat_map(|(k, value)| {
            let scale = value.max(0.0).sqrt();
            let vectors = &found.vectors;
            (0..dimension).map(move |row| scale * vectors[(row, k)])
        })
        .collect())
}
