//! Features of sampled atoms, by element.

use std::collections::BTreeMap;

use analysis::{PrincipalAxes, SystematicSample};
use atoms::Species;
use wire::Origin;

/// Largest number of elements. Those with the most atoms are kept.
pub const MAX_ELEMENTS: usize = 6;
/// Largest number of atoms kept of each element and origin.
const MAX_ATOMS: usize = 4096;

/// Features of atoms, by element.
pub struct FeaturesByElement(BTreeMap<Species, [FeatureSample; 2]>);

/// Features of one element and origin.
pub struct FeatureSample {
    atoms: SystematicSample<Vec<f64>>,
    /// Mean over the atoms of each structure.
    centroids: Vec<Vec<f64>>,
}

/// Atoms of one element, projected onto the first two principal components of both origins together.
pub struct Plane {
    /// The element.
    pub element: Species,
    /// Share of the variance along each component.
    pub shares: [f64; 2],
    /// Biased walks.
    pub biased: ProjectedPoints,
    /// Control walks.
    pub control: ProjectedPoints,
}

/// Projected points.
#[derive(Default)]
pub struct ProjectedPoints {
    /// Number of atoms before sampling.
    pub seen: u64,
    /// Atoms.
    pub atoms: Vec<[f64; 2]>,
    /// Means of structures.
    pub centroids: Vec<[f64; 2]>,
}

impl FeaturesByElement {
    /// Starts empty, for these elements.
    pub fn new(elements: &[Species]) -> Self {
        let sample = || FeatureSample { atoms: SystematicSample::new(MAX_ATOMS), centroids: Vec::new() };
        Self(elements.iter().map(|element| (*element, [sample(), sample()])).collect())
    }

    /// The elements with the most atoms, of both origins together.
    pub fn most_frequent(biased: &BTreeMap<Species, u64>, control: &BTreeMap<Species, u64>) -> Vec<Species> {
        let mut counts = biased.clone();
        for (element, number) in control {
            *counts.entry(*element).or_default() += number;
        }
        let mut elements: Vec<_> = counts.into_iter().collect();
        elements.sort_by_key(|(element, number)| (std::cmp::Reverse(*number), *element));
        elements.into_iter().take(MAX_ELEMENTS).map(|(element, _)| element).collect()
    }

    /// Adds the features of a structure's atoms, [n × D].
    pub fn add(&mut self, origin: Origin, species: &[Species], features: &[f64]) {
        let dimension = features.len().checked_div(species.len()).unwrap_or(0);
        if dimension == 0 {
            return;
        }
        for (element, samples) in &mut self.0 {
            let sample = &mut samples[usize::from(origin == Origin::Control)];
            let rows = species.iter().zip(features.chunks_exact(dimension));
            let rows: Vec<_> = rows.filter(|(of, _)| *of == element).map(|(_, row)| row.to_vec()).collect();
            if !rows.is_empty() {
                sample.centroids.push(mean(&rows));
                rows.into_iter().for_each(|row| sample.atoms.add(row));
            }
        }
    }

    /// The projection of each element that has enough atoms.
    pub fn planes(&self) -> Vec<Plane> {
        self.0.iter().filter_map(|(element, samples)| Plane::fit(*element, samples)).collect()
    }
}

impl Plane {
    fn fit(element: Species, [biased, control]: &[FeatureSample; 2]) -> Option<Self> {
        let first = biased.atoms.items().chain(control.atoms.items()).next()?;
        let rows = biased.atoms.items().chain(control.atoms.items());
        let rows: Vec<_> = rows.filter(|row| row.len() == first.len()).flatten().copied().collect();
        let axes = PrincipalAxes::fit(&rows, first.len(), 2)?;
        let shares = [axes.shares[0], axes.shares[1]];
        let place = |row: &Vec<f64>| -> [f64; 2] {
            let along = axes.project(row);
            [along[0], along[1]]
        };
        let points = |sample: &FeatureSample| ProjectedPoints {
            seen: sample.atoms.total(),
            atoms: sample.atoms.items().map(place).collect(),
            centroids: sample.centroids.iter().map(place).collect(),
        };
        Some(Self { element, shares, biased: points(biased), control: points(control) })
    }
}

fn mean(rows: &[Vec<f64>]) -> Vec<f64> {
    let mut mean = vec![0.0; rows.first().map_or(0, Vec::len)];
    for row in rows {
        mean.iter_mut().zip(row).for_each(|(mean, x)| *mean += x / rows.len() as f64);
    }
    mean
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_have_planes_of_their_own() {
        let [al, mg]: [Species; 2] = ["Al", "Mg"].map(|symbol| symbol.parse().unwrap());
        let counts = |al_atoms, mg_atoms| BTreeMap::from([(al, al_atoms), (mg, mg_atoms)]);
        assert_eq!(FeaturesByElement::most_frequent(&counts(1, 5), &counts(3, 0)), [mg, al]);
        let mut features = FeaturesByElement::new(&[al, mg]);
        for k in 0..20 {
            let (x, y) = (f64::from(k), f64::from(k % 2));
            // Aluminium differs along (1, 0), magnesium not at all.
            features.add(Origin::Biased, &[al, mg], &[x, y, 7.0, 7.0]);
        }
        features.add(Origin::Control, &[al, al], &[0.0, 0.0, 2.0, 0.0]);
        let planes = features.planes();
        assert_eq!(planes.len(), 1, "atoms that do not differ have no plane");
        let plane = &planes[0];
        assert_eq!((plane.element, plane.biased.seen, plane.control.seen), (al, 20, 2));
        assert_eq!((plane.biased.centroids.len(), plane.control.centroids.len()), (20, 1));
        assert!(plane.shares[0] > 0.95 && (plane.shares[0] + plane.shares[1] - 1.0).abs() < 1e-12);
        let [left, right] = [plane.control.atoms[0], plane.control.atoms[1]];
        let centre = plane.control.centroids[0];
        assert!(
            (0.5 * (left[0] + right[0]) - centre[0]).abs() < 1e-12,
            "a mean of places is the place of a mean"
        );
    }
}
