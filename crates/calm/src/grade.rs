//! σ, γ and the gradient of γ with respect to the feature vector.

use crate::component::ComponentView;
use crate::linear::{dot, squared_distance, symmetric_product};
use crate::mixture::Mixture;

/// Added under the square root of σ.
pub const DISTANCE_FLOOR: f64 = 1e-8;

/// The least threshold that γ is divided by.
pub const THRESHOLD_FLOOR: f64 = 1e-10;

/// Grades of the atoms of a structure, with buffers that are reused from call to call.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Grades {
    /// Mahalanobis distance σ = √(**δ**ᵀS**δ** + 10⁻⁸) to the nearest component, `[atoms]`.
    pub sigma: Vec<f64>,
    /// Extrapolation grade γ = σ/θ, `[atoms]`.
    pub gamma: Vec<f64>,
    /// Index of the nearest component among those of the atom's element, `[atoms]`.
    pub component: Vec<usize>,
    delta: Vec<f64>,
    product: Vec<f64>,
}

/// Why a grade could not be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GradeError {
    /// Features or gradient that do not fit the atoms.
    #[error("{what} has {found} numbers; {atoms} atoms of {dimension} features need {}", atoms * dimension)]
    Length {
        /// Which array.
        what: &'static str,
        /// Numbers found.
        found: usize,
        /// Atoms in the structure.
        atoms: usize,
        /// Feature dimension of the mixture.
        dimension: usize,
    },
    /// An element that the mixture does not have.
    #[error("atom {atom} has element index {element}, the mixture has {elements} elements")]
    Element {
        /// Atom index.
        atom: usize,
        /// Its element index.
        element: usize,
        /// Number of elements in the mixture.
        elements: usize,
    },
    /// σ² is negative or not finite.
    #[error(
        "σ² of atom {atom} (element {element}, component {slot}) is {found}: either its features are not finite \
         or the inverse covariance is not positive; check the structure first, then the artifact"
    )]
    Distance {
        /// Atom index.
        atom: usize,
        /// Its element index.
        element: usize,
        /// Its nearest component.
        slot: usize,
        /// The squared distance.
        found: f64,
    },
}

impl Grades {
    /// Grades every atom, and if asked writes ∂γ_a/∂**z**_a, `[atoms × D]`.
    ///
    /// `elements` holds an element index for each atom, `features` is `[atoms × D]`. The nearest component and θ
    /// are held fixed in the gradient (paper, Methods), S**δ**/(σθ); γ jumps where the nearest component changes.
    /// An atom's result does not depend on the other atoms of the call, to the last bit.
    ///
    /// # Errors
    /// Lengths that do not fit, an unknown element, σ² negative or not finite. The content is then of no use.
    pub fn evaluate(
        &mut self,
        mixture: &Mixture,
        elements: &[usize],
        features: &[f64],
        gradient: Option<&mut [f64]>,
    ) -> Result<(), GradeError> {
        let (atoms, dimension) = (elements.len(), mixture.dimension());
        let fits = |what, found| {
            if atoms.checked_mul(dimension) == Some(found) {
                Ok(())
            } else {
                Err(GradeError::Length { what, found, atoms, dimension })
            }
        };
        fits("features", features.len())?;
        if let Some(gradient) = gradient.as_deref() {
            fits("gradient", gradient.len())?;
        }
        self.clear(dimension);
        let mut rows = gradient.map(|gradient| gradient.chunks_exact_mut(dimension));
        for (atom, (&element, z)) in elements.iter().zip(features.chunks_exact(dimension)).enumerate() {
            let row = rows.as_mut().and_then(Iterator::next);
            self.push(mixture, atom, element, z, row)?;
        }
        Ok(())
    }

    fn clear(&mut self, dimension: usize) {
        self.sigma.clear();
        self.gamma.clear();
        self.component.clear();
        self.delta.resize(dimension, 0.0);
        self.product.resize(dimension, 0.0);
    }

    fn push(
        &mut self,
        mixture: &Mixture,
        atom: usize,
        element: usize,
        z: &[f64],
        gradient: Option<&mut [f64]>,
    ) -> Result<(), GradeError> {
        let unknown = || GradeError::Element { atom, element, elements: mixture.element_count() };
        let components = mixture.components(element).ok_or_else(unknown)?;
        let slot = nearest(components.iter().map(|component| component.centroid()), z);
        let component = components.get(slot).ok_or_else(unknown)?.view();
        let squared = squared_mahalanobis(component, z, &mut self.delta, &mut self.product);
        let sigma = (squared + DISTANCE_FLOOR).sqrt();
        if !(sigma.is_finite() && sigma > 0.0) {
            return Err(GradeError::Distance { atom, element, slot, found: squared });
        }
        let threshold = component.threshold.max(THRESHOLD_FLOOR);
        if let Some(gradient) = gradient {
            let scale = 1.0 / (sigma * threshold);
            gradient.iter_mut().zip(&self.product).for_each(|(out, value)| *out = scale * value);
        }
        self.sigma.push(sigma);
        self.gamma.push(sigma / threshold);
        self.component.push(slot);
        Ok(())
    }

    /// The largest γ; 0 without atoms.
    pub fn maximum(&self) -> f64 {
        maximum(&self.gamma)
    }
}

/// The largest of some grades; 0 for none.
pub fn maximum(gamma: &[f64]) -> f64 {
    gamma.iter().copied().fold(0.0, f64::max)
}

/// Index of the centroid nearest to **z** by Euclidean distance, the first of equals (paper, Methods).
///
/// The sentinel centroids of unused slots (all 10¹⁰) are never the nearest beside a real one.
pub fn nearest<'a>(centroids: impl Iterator<Item = &'a [f64]>, z: &[f64]) -> usize {
    let (mut best, mut least) = (0, f64::INFINITY);
    for (slot, centroid) in centroids.enumerate() {
        let distance = squared_distance(z, centroid);
        if distance < least {
            (best, least) = (slot, distance);
        }
    }
    best
}

/// **δ**ᵀS**δ** with **δ** = **z** − **μ**; leaves **δ** and S**δ** in the buffers (`[D]` each).
pub fn squared_mahalanobis(
    component: ComponentView<'_>,
    z: &[f64],
    delta: &mut [f64],
    product: &mut [f64],
) -> f64 {
    for (out, (z, centre)) in delta.iter_mut().zip(z.iter().zip(component.centroid)) {
        *out = z - centre;
    }
    quadratic_form(component.inverse, delta, product)
}

/// **δ**ᵀS**δ**; leaves S**δ** in the buffer.
pub(crate) fn quadratic_form(inverse: &[f64], delta: &[f64], product: &mut [f64]) -> f64 {
    symmetric_product(inverse, delta, product);
    dot(delta, product)
}
