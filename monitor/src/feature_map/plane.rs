//! The mathematics of the map: axes from training data and collected atoms, and both along them.

use std::sync::Arc;

use analysis::{PrincipalAxes, row_moments};
use calm::{Component, moments};

use super::{MapComponent, MapPlane, MapPoint};

/// The atoms of one element of a structure, in feature space.
pub(super) struct FeaturePoint {
    /// Features of the atom with the largest γ₀.
    pub at: Vec<f64>,
    /// Mean of the features.
    pub mean: Vec<f64>,
    /// The rest; its places are not known yet.
    pub point: MapPoint,
}

/// A component with its element and number.
pub(super) type NumberedComponent = (&'static str, usize, Arc<Component>);

/// The plane of `points`. `rows` are features of sampled atoms, `[n × D]`. `None` if nothing differs, or with fewer than two features.
pub(super) fn plane(
    element: Option<&'static str>,
    components: &[NumberedComponent],
    rows: &[f64],
    dimension: usize,
    points: &[&FeaturePoint],
) -> Option<MapPlane> {
    let collected = row_moments(rows, dimension)?;
    let bare: Vec<_> = components.iter().map(|(.., component)| Arc::clone(component)).collect();
    let known = moments(&bare).filter(|(mean, _)| mean.len() == dimension);
    let has_statistics = known.is_some();
    let (mean, covariance) = match known {
        Some(known) => halves(&known, &collected),
        None => collected,
    };
    let axes = PrincipalAxes::from_covariance(mean, &covariance, 2)?;
    let components = if has_statistics { components } else { &[] };
    Some(MapPlane {
        element,
        shares: [axes.shares[0], axes.shares[1]],
        sampled_atoms: rows.len() / dimension,
        components: components.iter().filter_map(|component| projected(&axes, component)).collect(),
        points: points.iter().map(|point| point.placed(&axes)).collect(),
    })
}

/// Mean and covariance of a set of which either half has the given ones.
fn halves(a: &(Vec<f64>, Vec<f64>), b: &(Vec<f64>, Vec<f64>)) -> (Vec<f64>, Vec<f64>) {
    let apart: Vec<_> = a.0.iter().zip(&b.0).map(|(a, b)| a - b).collect();
    let dimension = apart.len();
    let between = |k: usize| 0.25 * apart[k / dimension] * apart[k % dimension];
    let covariance = a.1.iter().zip(&b.1).enumerate().map(|(k, (a, b))| 0.5 * (a + b) + between(k));
    (a.0.iter().zip(&b.0).map(|(a, b)| 0.5 * (a + b)).collect(), covariance.collect())
}

fn projected(axes: &PrincipalAxes, (element, number, component): &NumberedComponent) -> Option<MapComponent> {
    let statistics = component.statistics().filter(|of| of.effective_count > 0.0)?;
    let covariance = axes.project_covariance(&statistics.covariance());
    let centre = axes.project(component.centroid());
    Some(MapComponent {
        element,
        component: *number,
        environments: statistics.count,
        centre: [centre[0], centre[1]],
        covariance: [covariance[0], covariance[1], covariance[3]],
    })
}

impl FeaturePoint {
    fn placed(&self, axes: &PrincipalAxes) -> MapPoint {
        let place = |features: &[f64]| {
            let along = axes.project(features);
            [along[0] as f32, along[1] as f32]
        };
        MapPoint { at: place(&self.at), mean: place(&self.mean), ..self.point.clone() }
    }
}

#[cfg(test)]
mod tests {
    use calm::Statistics;

    use super::*;

    /// A component about (x, 0, 0) with variances 4, 1 and ½.
    fn component(x: f64, count: f64) -> Arc<Component> {
        let diagonal = |values: [f64; 3]| {
            let mut matrix = vec![0.0; 9];
            matrix.iter_mut().step_by(4).zip(values).for_each(|(element, value)| *element = value);
            matrix
        };
        let scatter = diagonal([4.0, 1.0, 0.5].map(|variance| count * variance));
        let statistics = Statistics { scatter, count, effective_count: count };
        Arc::new(
            Component::new(vec![x, 0.0, 0.0], diagonal([0.25, 1.0, 2.0]), 1.0, Some(statistics)).unwrap(),
        )
    }

    fn point(at: [f64; 3], mean: [f64; 3]) -> FeaturePoint {
        let point = MapPoint {
            structure: 0,
            element: "Mo",
            atom: 0,
            at: [0.0; 2],
            mean: [0.0; 2],
            gamma: Some(2.0),
            gamma_current: None,
            force_error: None,
        };
        FeaturePoint { at: at.to_vec(), mean: mean.to_vec(), point }
    }

    fn near(a: &[f64], b: &[f64]) -> bool {
        a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6)
    }

    /// The data behind the component have mean 0 and variances 4, 1, ½; the atoms lie at (0, 6 ± 2, 0). Both together: mean (0, 3, 0) and
    /// variances ½·4, ½(1 + 4) + ¼·6², ¼: 2, 11.5, 0.25.
    #[test]
    fn training_data_and_collected_atoms_have_equal_parts_in_the_axes() {
        let rows = [0.0, 8.0, 0.0, 0.0, 4.0, 0.0];
        let points = [point([0.0, 8.0, 0.0], [0.0, 6.0, 0.0])];
        let all: Vec<_> = points.iter().collect();
        let components = [("Mo", 0, component(0.0, 20.0))];
        let found = plane(Some("Mo"), &components, &rows, 3, &all).unwrap();
        assert!(near(&found.shares, &[11.5 / 13.75, 2.0 / 13.75]), "{:?}", found.shares);
        let [ellipse] = &found.components[..] else { panic!("{:?}", found.components) };
        assert!(near(&ellipse.centre, &[-3.0, 0.0]) && near(&ellipse.covariance, &[1.0, 0.0, 4.0]));
        assert_eq!((ellipse.element, ellipse.environments), ("Mo", 20.0));
        let [placed] = &found.points[..] else { panic!("{:?}", found.points) };
        assert_eq!((placed.at, placed.mean, placed.gamma), ([5.0, 0.0], [3.0, 0.0], Some(2.0)));
    }

    #[test]
    fn without_statistics_the_axes_are_those_of_the_atoms() {
        let rows = [3.0, 0.0, 0.0, -3.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, -1.0, 0.0];
        let bare = component(7.0, 5.0);
        let bare = Component::new(bare.centroid().to_vec(), bare.inverse().to_vec(), 1.0, None).unwrap();
        let found = plane(None, &[("Mo", 0, Arc::new(bare))], &rows, 3, &[]).unwrap();
        assert!(near(&found.shares, &[0.9, 0.1]) && found.components.is_empty(), "{found:?}");
        assert_eq!(found.sampled_atoms, 4);
        assert!(plane(None, &[], &[1.0, 2.0, 1.0, 2.0], 2, &[]).is_none(), "atoms that do not differ");
        assert!(plane(None, &[], &[], 3, &[]).is_none());
        assert!(plane(None, &[], &[1.0, 2.0, 3.0], 1, &[]).is_none(), "one feature");
    }

    /// Features of another model do not fit the components.
    #[test]
    fn components_of_another_dimension_are_left_out() {
        let rows = [3.0, 0.0, -3.0, 0.0, 0.0, 1.0];
        let found = plane(None, &[("Mo", 0, component(0.0, 5.0))], &rows, 2, &[]).unwrap();
        assert!(found.components.is_empty());
    }
}
