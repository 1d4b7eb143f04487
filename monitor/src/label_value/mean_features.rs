//! Features averaged over a structure, and how much of a structure another one leaves unknown.

use atoms::Species;
use calm::Mixture;

/// The spread of each feature within the components of a mixture, by element.
///
/// sₖ² is the mean of the variance of feature k in the components of the element, weighted by the environments that each has.
#[derive(Clone, Debug, PartialEq)]
pub struct FeatureScales {
    elements: Vec<(u8, Vec<f64>)>,
}

/// The mean features of the atoms of each element of a structure, in units of their spread.
#[derive(Clone, Debug, PartialEq)]
pub struct MeanFeatures {
    atoms: f64,
    elements: Vec<ElementMean>,
}

#[derive(Clone, Debug, PartialEq)]
struct ElementMean {
    element: u8,
    fraction: f64,
    mean: Vec<f64>,
}

impl FeatureScales {
    /// Of a mixture whose elements are these, in the order of their indices.
    pub fn new(mixture: &Mixture, elements: &[Species]) -> Self {
        let of_element = |(index, species): (usize, &Species)| {
            let components = mixture.components(index).unwrap_or_default();
            let (mut sum, mut weights) = (vec![0.0; mixture.dimension()], 0.0);
            for component in components {
                let dimension = component.dimension();
                let (weight, matrix) =
                    match component.statistics().filter(|found| found.effective_count > 0.0) {
                        Some(found) => (found.effective_count, found.covariance()),
                        // Without statistics the inverse gives the spread along a feature that the others leave.
                        None => (1.0, component.inverse().iter().map(|value| value.recip()).collect()),
                    };
                for (k, sum) in sum.iter_mut().enumerate() {
                    let variance = matrix[k * (dimension + 1)];
                    *sum += weight * if variance.is_finite() { variance.max(0.0) } else { 0.0 };
                }
                weights += weight;
            }
            let scale = |sum: f64| if weights > 0.0 { (sum / weights).sqrt() } else { 0.0 };
            (species.atomic_number(), sum.into_iter().map(scale).collect())
        };
        Self { elements: elements.iter().enumerate().map(of_element).collect() }
    }
}

impl MeanFeatures {
    /// Of the atoms `species` with these features, [n × D]. `None` if they do not fit the scales: another number of features, or an
    /// element that the mixture does not have. Features without spread are left out.
    pub fn new(species: &[Species], features: &[f64], scales: &FeatureScales) -> Option<Self> {
        let dimension = features.len().checked_div(species.len())?;
        if dimension == 0
            || dimension * species.len() != features.len()
            || features.iter().any(|x| !x.is_finite())
        {
            return None;
        }
        let atoms = species.len() as f64;
        let mut elements = Vec::new();
        for (element, number) in atoms::composition(species) {
            let (_, scale) = scales
                .elements
                .iter()
                .find(|(known, scale)| *known == element && scale.len() == dimension)?;
            let mut mean = vec![0.0; dimension];
            let own = species.iter().zip(features.chunks_exact(dimension));
            for (_, row) in own.filter(|(species, _)| species.atomic_number() == element) {
                mean.iter_mut().zip(row).for_each(|(mean, x)| *mean += x / f64::from(number));
            }
            let mean = mean.iter().zip(scale).map(|(x, scale)| if *scale > 0.0 { x / scale } else { 0.0 });
            elements.push(ElementMean { element, fraction: f64::from(number) / atoms, mean: mean.collect() });
        }
        Some(Self { atoms, elements })
    }

    /// What a label of `other` leaves of the value of a label of this structure: 0 if both have the same mean features, towards
    /// 1 the more they differ,
    ///
    /// ```text
    /// t / (1 + t),   t = ½ n d²,   d² = (1/E) Σₑ xₑ (1/D) Σₖ (zₑₖ − z'ₑₖ)² / sₑₖ²
    /// ```
    ///
    /// where zₑₖ is the mean of feature k over the atoms of element e of E, sₑₖ its spread ([`FeatureScales`]), xₑ the mean of both
    /// fractions of the element and n the harmonic mean of both numbers of atoms. Two structures whose atoms are drawn
    /// independently from one component have t = 1 on average. A structure says nothing about one of other elements.
    pub fn novelty(&self, other: &Self) -> f64 {
        let same_elements = self.elements.len() == other.elements.len();
        let mut squared = 0.0;
        for (own, theirs) in self.elements.iter().zip(&other.elements) {
            if !same_elements || own.element != theirs.element || own.mean.len() != theirs.mean.len() {
                return 1.0;
            }
            let distance: f64 = own.mean.iter().zip(&theirs.mean).map(|(a, b)| (a - b).powi(2)).sum();
            squared += 0.5 * (own.fraction + theirs.fraction) * distance / own.mean.len() as f64;
        }
        if !same_elements {
            return 1.0;
        }
        let atoms = 2.0 * self.atoms * other.atoms / (self.atoms + other.atoms);
        let t = 0.5 * atoms * squared / self.elements.len() as f64;
        if t.is_finite() { t / (1.0 + t) } else { 1.0 }
    }
}
