//! The mean and the covariance of the data behind several components.

use std::sync::Arc;

use crate::Component;

/// Mean and covariance of the data of several components, `[D]` and `[D × D]`, with the centroids as means. `None` without statistics or
/// data.
pub fn moments(components: &[Arc<Component>]) -> Option<(Vec<f64>, Vec<f64>)> {
    let statistics: Vec<_> =
        components.iter().map(|component| component.statistics()).collect::<Option<_>>()?;
    let total: f64 = statistics.iter().map(|of| of.effective_count).sum();
    let dimension = components.first()?.dimension();
    if total <= 0.0 || dimension < 2 {
        return None;
    }
    let mut mean = vec![0.0; dimension];
    for (component, of) in components.iter().zip(&statistics) {
        let weight = of.effective_count / total;
        mean.iter_mut().zip(component.centroid()).for_each(|(mean, x)| *mean += weight * x);
    }
    let mut covariance = vec![0.0; dimension * dimension];
    for (component, of) in components.iter().zip(&statistics) {
        let weight = of.effective_count / total;
        let offset: Vec<_> = component.centroid().iter().zip(&mean).map(|(x, mean)| x - mean).collect();
        let rows = covariance.chunks_exact_mut(dimension).zip(of.scatter.chunks_exact(dimension));
        for ((sums, scatter), x) in rows.zip(&offset) {
            for ((sum, scatter), y) in sums.iter_mut().zip(scatter).zip(&offset) {
                *sum += scatter / total + weight * x * y;
            }
        }
    }
    Some((mean, covariance))
}
