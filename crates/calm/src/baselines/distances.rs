//! Euclidean distances: to the nearest centroid, and to the k-th nearest training atom.

use std::collections::BinaryHeap;

use super::error::{BaselineError, check_element};
use super::groups::{AtomGroups, for_each_group, subtract};
use super::max_vol::multiply_transposed;
use super::settings::BaselineSettings;
use crate::build::random_key;
use crate::linear::{dot, row_dots, squared_distance};
use crate::mixture::Mixture;

/// Atoms, and training atoms, of one matrix product.
const BLOCK_ROWS: usize = 256;

/// Distance to the nearest centroid of the element, min_k |**z** − **μ**_k|.
#[derive(Debug, Clone, PartialEq)]
pub struct Euclidean {
    pub(super) groups: AtomGroups,
}

impl Euclidean {
    pub(super) fn new(mixture: &Mixture) -> Self {
        Self { groups: AtomGroups::of_components(mixture) }
    }

    /// D
    pub fn dimension(&self) -> usize {
        self.groups.dimension()
    }

    pub(super) fn score(&self, elements: &[usize], features: &[f64]) -> Result<Vec<f64>, BaselineError> {
        let groups = self.groups.assign(elements, features)?;
        let rows = features.chunks_exact(self.dimension()).zip(groups);
        let distance = |(z, group)| {
            let centroid = self.groups.centroid(group);
            centroid.map_or(f64::INFINITY, |centroid| squared_distance(z, centroid).sqrt())
        };
        Ok(rows.map(distance).collect())
    }
}

/// Distance to the k-th nearest training atom of the element, from a sample of them.
#[derive(Debug, Clone, PartialEq)]
pub struct KNearest {
    pub(super) dimension: usize,
    /// k
    pub(super) neighbours: usize,
    pub(super) elements: Vec<ElementSample>,
}

/// Training atoms of an element.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct ElementSample {
    /// Their mean **m**, `[D]`.
    mean: Vec<f64>,
    /// **z** − **m**, `[n × D]`: products of small numbers keep the digits of distances.
    rows: Vec<f64>,
    /// |**z** − **m**|²
    squares: Vec<f64>,
}

impl ElementSample {
    /// Of features `[n × D]`.
    pub fn new(dimension: usize, mut rows: Vec<f64>) -> Self {
        let count = rows.len() / dimension;
        let mut mean = vec![0.0; dimension];
        for row in rows.chunks_exact(dimension) {
            mean.iter_mut().zip(row).for_each(|(sum, z)| *sum += z);
        }
        mean.iter_mut().for_each(|sum| *sum /= count.max(1) as f64);
        subtract(&mut rows, &mean);
        Self::from_parts(mean, rows)
    }

    /// Of their mean **m** and **z** − **m**.
    pub fn from_parts(mean: Vec<f64>, rows: Vec<f64>) -> Self {
        let mut squares = Vec::new();
        row_dots(&rows, &rows, mean.len(), &mut squares);
        Self { mean, rows, squares }
    }

    /// **m**, `[D]`.
    pub fn mean(&self) -> &[f64] {
        &self.mean
    }

    /// **z** − **m**, `[n × D]`.
    pub fn rows(&self) -> &[f64] {
        &self.rows
    }

    /// Number of training atoms.
    pub fn count(&self) -> usize {
        self.squares.len()
    }

    /// Distances of rows `[n × D]` to their k-th nearest, or to the furthest of fewer.
    fn score(&self, dimension: usize, neighbours: usize, rows: &mut [f64]) -> Vec<f64> {
        subtract(rows, &self.mean);
        let mut scores = Vec::new();
        for block in rows.chunks(BLOCK_ROWS * dimension) {
            let mut nearest = vec![BinaryHeap::new(); block.len() / dimension];
            for (number, of_sample) in self.rows.chunks(BLOCK_ROWS * dimension).enumerate() {
                self.nearer(dimension, neighbours, block, (number * BLOCK_ROWS, of_sample), &mut nearest);
            }
            for (row, heap) in block.chunks_exact(dimension).zip(nearest) {
                let exact = heap.iter().map(|found: &NearestAtom| {
                    squared_distance(row, &self.rows[found.index * dimension..][..dimension])
                });
                let furthest = exact.fold(f64::NEG_INFINITY, f64::max);
                scores.push(if furthest < 0.0 { f64::INFINITY } else { furthest.sqrt() });
            }
        }
        scores
    }

    /// Keeps the nearest of one more block of the sample.
    fn nearer(
        &self,
        dimension: usize,
        neighbours: usize,
        block: &[f64],
        (first, of_sample): (usize, &[f64]),
        nearest: &mut [BinaryHeap<NearestAtom>],
    ) {
        let products = multiply_transposed(block, of_sample, dimension);
        let count = of_sample.len() / dimension;
        let rows = block.chunks_exact(dimension).zip(products.chunks_exact(count));
        for ((row, products), heap) in rows.zip(nearest) {
            let length = dot(row, row);
            for (offset, (product, square)) in products.iter().zip(&self.squares[first..]).enumerate() {
                let squared = (length - 2.0 * product + square).max(0.0);
                let found = NearestAtom { squared, index: first + offset };
                if heap.len() < neighbours {
                    heap.push(found);
                } else if heap.peek().is_some_and(|furthest| found < *furthest) {
                    heap.pop();
                    heap.push(found);
                }
            }
        }
    }
}

/// A training atom, ordered by distance, then by index.
#[derive(Debug, Clone, Copy, PartialEq)]
struct NearestAtom {
    squared: f64,
    index: usize,
}

impl Eq for NearestAtom {}

impl PartialOrd for NearestAtom {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for NearestAtom {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.squared.total_cmp(&other.squared).then(self.index.cmp(&other.index))
    }
}

impl KNearest {
    /// D
    pub fn dimension(&self) -> usize {
        self.dimension
    }

    pub(super) fn score(&self, elements: &[usize], features: &[f64]) -> Result<Vec<f64>, BaselineError> {
        for (atom, &element) in elements.iter().enumerate() {
            check_element(atom, element, self.elements.len())?;
        }
        let mut scores = vec![f64::INFINITY; elements.len()];
        for_each_group(elements, self.dimension, features, |element, atoms, rows| {
            let found = self.elements[element].score(self.dimension, self.neighbours, rows);
            atoms.iter().zip(found).for_each(|(atom, score)| scores[*atom] = score);
        });
        Ok(scores)
    }
}

/// Keeps a sample of the atoms of each element: those with the smallest keys, which are functions of the random seed,
/// element and the atom's number.
#[derive(Debug, Clone)]
pub(super) struct KNearestBuilder {
    dimension: usize,
    settings: BaselineSettings,
    elements: Vec<Reservoir>,
}

#[derive(Debug, Clone, Default)]
struct Reservoir {
    /// Key, and place of the row in `rows`; the largest key first.
    keys: BinaryHeap<(u64, usize)>,
    rows: Vec<f64>,
    seen: u64,
}

impl KNearestBuilder {
    pub fn new(settings: &BaselineSettings, dimension: usize, elements: usize) -> Self {
        Self { dimension, settings: settings.clone(), elements: vec![Reservoir::default(); elements] }
    }

    pub fn add(&mut self, elements: &[usize], features: &[f64]) -> Result<(), BaselineError> {
        let count = self.elements.len();
        for (atom, (&element, row)) in elements.iter().zip(features.chunks_exact(self.dimension)).enumerate()
        {
            check_element(atom, element, count)?;
            let reservoir = &mut self.elements[element];
            let key = random_key(&[self.settings.seed, element as u64, reservoir.seen]);
            reservoir.add(key, row, self.settings.sample);
        }
        Ok(())
    }

    pub fn finish(self) -> Result<KNearest, BaselineError> {
        if self.elements.iter().all(|reservoir| reservoir.rows.is_empty()) {
            return Err(BaselineError::NoData);
        }
        let elements = self.elements.into_iter().map(|found| ElementSample::new(self.dimension, found.rows));
        Ok(KNearest {
            dimension: self.dimension,
            neighbours: self.settings.neighbours,
            elements: elements.collect(),
        })
    }
}

impl Reservoir {
    fn add(&mut self, key: u64, row: &[f64], capacity: usize) {
        self.seen += 1;
        if self.keys.len() < capacity {
            self.keys.push((key, self.keys.len()));
            self.rows.extend_from_slice(row);
        } else if let Some(mut largest) = self.keys.peek_mut()
            && key < largest.0
        {
            let place = largest.1;
            *largest = (key, place);
            self.rows[place * row.len()..][..row.len()].copy_from_slice(row);
        }
    }
}
