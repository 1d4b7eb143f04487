//! The components of a mixture and labelled atoms in the plane of the first two principal components of the data behind the mixture, one
//! plane for each element (paper, SI, clusters in the uncertainty feature space).

use std::sync::Arc;

use analysis::{PrincipalAxes, SystematicSample};
use atoms::Species;
use calm::drift::condition_number;
use calm::{Component, Mixture, moments};
use serde::Serialize;

/// Elements with a plane.
const MAX_ELEMENTS: usize = 6;
/// Atoms kept on either side of γ = 1, for each element.
pub const MAX_ATOMS: usize = 1024;

/// The planes of several elements.
pub struct FeaturePlanes {
    /// With the element index.
    planes: Vec<(usize, FeaturePlane)>,
}

/// The plane of an element.
#[derive(Clone, Debug, Serialize)]
pub struct FeaturePlane {
    /// The element.
    pub element: String,
    /// Share of the variance of the data along either axis.
    pub shares: [f64; 2],
    /// The components with data.
    pub components: Vec<ProjectedComponent>,
    /// The largest condition number of a covariance; `None` beyond double precision.
    pub condition_number: Option<f64>,
    /// Number of labelled atoms with γ ≤ 1 and with γ > 1.
    pub atoms: [u64; 2],
    /// Where they are, those with γ ≤ 1 first.
    #[serde(skip)]
    pub samples: [SystematicSample<[f64; 2]>; 2],
    #[serde(skip)]
    axes: PrincipalAxes,
}

/// A component in the plane.
#[derive(Clone, Debug, Serialize)]
pub struct ProjectedComponent {
    /// Number of environments in its data.
    pub count: f64,
    pub centroid: [f64; 2],
    /// xx, xy, yy.
    pub covariance: [f64; 3],
}

impl FeaturePlanes {
    /// Of the first of the elements `shown` whose components have statistics. `elements` are those of the model.
    pub fn new(mixture: &Mixture, elements: &[Species], shown: &[Species]) -> Self {
        let plane = |species: &Species| {
            let index = elements.iter().position(|element| element == species)?;
            Some((index, FeaturePlane::new(species.to_string(), mixture.components(index)?)?))
        };
        Self { planes: shown.iter().filter_map(plane).take(MAX_ELEMENTS).collect() }
    }

    /// Adds labelled atoms: the element index of each, their features, `[atoms × D]`, and their γ. Atoms
    /// whose γ is not finite are left out.
    pub fn add(&mut self, elements: &[usize], features: &[f64], gamma: &[f64]) {
        let dimension = features.len().checked_div(elements.len()).unwrap_or(0);
        if dimension == 0 {
            return;
        }
        for ((element, row), gamma) in elements.iter().zip(features.chunks_exact(dimension)).zip(gamma) {
            if let Some((_, plane)) = self.planes.iter_mut().find(|(index, _)| index == element) {
                plane.add(row, *gamma);
            }
        }
    }

    /// The planes, in the order of the elements.
    pub fn finish(self) -> Vec<FeaturePlane> {
        self.planes.into_iter().map(|(_, plane)| plane).collect()
    }
}

impl FeaturePlane {
    /// `None` without statistics, or if the data have no variance.
    fn new(element: String, components: &[Arc<Component>]) -> Option<Self> {
        let (mean, covariance) = moments(components)?;
        let axes = PrincipalAxes::from_covariance(mean, &covariance, 2)?;
        let project = |component: &Arc<Component>| {
            let statistics = component.statistics().filter(|of| of.effective_count > 0.0)?;
            let covariance = axes.project_covariance(&statistics.covariance());
            Some(ProjectedComponent {
                count: statistics.count,
                centroid: pair(&axes.project(component.centroid())),
                covariance: [covariance[0], covariance[1], covariance[3]],
            })
        };
        let conditions: Option<Vec<_>> =
            components.iter().map(|component| condition_number(component).ok().flatten()).collect();
        Some(Self {
            element,
            shares: pair(&axes.shares),
            components: components.iter().filter_map(project).collect(),
            condition_number: conditions.and_then(|all| all.into_iter().reduce(f64::max)),
            atoms: [0; 2],
            samples: [SystematicSample::new(MAX_ATOMS), SystematicSample::new(MAX_ATOMS)],
            axes,
        })
    }

    fn add(&mut self, features: &[f64], gamma: f64) {
        if !gamma.is_finite() {
            return;
        }
        let side = usize::from(gamma > 1.0);
        self.atoms[side] += 1;
        self.samples[side].add_with(|| pair(&self.axes.project(features)));
    }

    /// Share of the labelled atoms whose place meets a condition. Each sampled atom stands for the same number of atoms of its side.
    /// `None` without labelled atoms.
    pub fn share(&self, is_met: impl Fn(&[f64; 2]) -> bool) -> Option<f64> {
        let all = self.atoms.iter().sum::<u64>();
        let sides = self.atoms.iter().zip(&self.samples);
        let found = sides.map(|(atoms, sample)| {
            let met = sample.items().filter(|point| is_met(point)).count();
            *atoms as f64 * met as f64 / sample.items().len().max(1) as f64
        });
        (all > 0).then(|| found.sum::<f64>() / all as f64)
    }
}

/// The first two numbers, of which there must be two.
fn pair(numbers: &[f64]) -> [f64; 2] {
    [numbers[0], numbers[1]]
}

#[cfg(test)]
mod tests {
    use calm::Statistics;

    use super::*;

    /// Variances 4, 1 and 1 about (x, 0, 0).
    fn component(x: f64, count: f64) -> Arc<Component> {
        let diagonal = |values: [f64; 3]| {
            let mut matrix = vec![0.0; 9];
            matrix.iter_mut().step_by(4).zip(values).for_each(|(element, value)| *element = value);
            matrix
        };
        let scatter = diagonal([4.0, 1.0, 0.5].map(|variance| count * variance));
        let statistics = Statistics { scatter, count, effective_count: count };
        let inverse = diagonal([0.25, 1.0, 2.0]);
        Arc::new(Component::new(vec![x, 0.0, 0.0], inverse, 1.0, Some(statistics)).unwrap())
    }

    fn species() -> [Species; 2] {
        ["Mo", "W"].map(|symbol| symbol.parse().unwrap())
    }

    #[test]
    fn components_lie_along_the_axes_of_all_their_data() {
        // Means 2 and −4 with weights 2/3 and 1/3: mean 0, variance 4 + 8 along x, 1 and ½ along the others.
        let components = vec![component(2.0, 20.0), component(-4.0, 10.0)];
        let mixture = Mixture::new(0, vec![components, vec![component(0.0, 5.0)]]).unwrap();
        let mut planes = FeaturePlanes::new(&mixture, &species(), &species()[..1]);
        // Another element has no plane.
        planes.add(
            &[0, 1, 0, 0, 0],
            &[3.0, 1.0, 9.0, 7.0, 7.0, 7.0, -1.0, 0.0, 0.0, 9.0, 0.0, 0.0, 8.0, 0.0, 0.0],
            &[0.5, 0.1, 1.0, 1.5, f64::NAN],
        );
        let [plane] = &planes.finish()[..] else { panic!("one plane") };
        assert_eq!((plane.element.as_str(), plane.atoms), ("Mo", [2, 1]));
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near(&plane.shares, &[12.0 / 13.5, 1.0 / 13.5]), "{:?}", plane.shares);
        let [first, second] = &plane.components[..] else { panic!("{:?}", plane.components) };
        assert!(near(&first.centroid, &[2.0, 0.0]) && near(&second.centroid, &[-4.0, 0.0]));
        assert!(near(&first.covariance, &[4.0, 0.0, 1.0]), "{first:?}");
        assert!((plane.condition_number.unwrap() - 8.0).abs() < 1e-12);
        let within: Vec<_> = plane.samples[0].items().copied().flatten().collect();
        let beyond: Vec<_> = plane.samples[1].items().copied().flatten().collect();
        assert!(near(&within, &[3.0, 1.0, -1.0, 0.0]) && near(&beyond, &[9.0, 0.0]), "{within:?} {beyond:?}");
    }

    /// Of 5000 atoms with γ ≤ 1, at most 1024 are in the sample; of 100 with γ > 1 all.
    #[test]
    fn shares_are_those_of_all_labelled_atoms() {
        let mixture = Mixture::new(0, vec![vec![component(0.0, 5.0)]]).unwrap();
        let mut planes = FeaturePlanes::new(&mixture, &species()[..1], &species()[..1]);
        (0..5000).for_each(|_| planes.add(&[0], &[1.0, 0.0, 0.0], &[0.5]));
        (0..100).for_each(|_| planes.add(&[0], &[5.0, 0.0, 0.0], &[1.5]));
        let [plane] = &planes.finish()[..] else { panic!("one plane") };
        assert!(plane.samples[0].items().len() <= MAX_ATOMS && plane.samples[1].items().len() == 100);
        let share = plane.share(|[x, _]| x.abs() > 3.0).unwrap();
        assert!((share - 100.0 / 5100.0).abs() < 1e-12, "{share}");
        let empty = FeaturePlanes::new(&mixture, &species()[..1], &species()[..1]).finish().remove(0);
        assert_eq!(empty.share(|_| true), None);
    }

    #[test]
    fn a_mixture_without_statistics_has_no_plane() {
        let bare = component(0.0, 5.0);
        let bare = Component::new(bare.centroid().to_vec(), bare.inverse().to_vec(), 1.0, None).unwrap();
        let empty = Component::unknown_element(3);
        for component in [bare, empty] {
            let mixture = Mixture::new(0, vec![vec![Arc::new(component)]]).unwrap();
            assert!(FeaturePlanes::new(&mixture, &species()[..1], &species()).finish().is_empty());
        }
    }
}
