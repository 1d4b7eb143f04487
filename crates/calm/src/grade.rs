//! σ, γ and the gradient of γ with respect to the feature vector.

use crate::component::Component;
use crate::linear::{VECTORS_PER_PASS, dot, squared_distance, symmetric_products};
use crate::mixture::Mixture;

/// Added under the square root of σ.
pub const DISTANCE_FLOOR: f64 = 1e-8;

/// Lower limit of the threshold that γ is divided by.
pub const THRESHOLD_FLOOR: f64 = 1e-10;

/// Grades of the atoms of a structure, with buffers that are reused between calls.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Grades {
    /// Mahalanobis distance σ = √(**δ**ᵀS**δ** + 10⁻⁸) to the nearest component, `[atoms]`.
    pub sigma: Vec<f64>,
    /// Extrapolation grade γ = σ/θ, `[atoms]`.
    pub gamma: Vec<f64>,
    /// Index of the nearest component among those of the atom's element, `[atoms]`.
    pub component: Vec<usize>,
    /// The atoms, sorted by component.
    order: Vec<usize>,
    delta: Vec<f64>,
    product: Vec<f64>,
}

/// Why a grade could not be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GradeError {
    /// Arrays whose length does not match the atoms.
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

impl GradeError {
    /// Translates the atom index from a batch of atoms to the whole structure.
    pub(crate) fn with_atom_indices(mut self, atoms: &[u32]) -> Self {
        match &mut self {
            Self::Length { .. } => {}
            Self::Element { atom, .. } | Self::Distance { atom, .. } => *atom = atoms[*atom] as usize,
        }
        self
    }

    /// The atom that caused the error, if one did.
    pub(crate) fn atom(&self) -> Option<usize> {
        match self {
            Self::Length { .. } => None,
            Self::Element { atom, .. } | Self::Distance { atom, .. } => Some(*atom),
        }
    }
}

impl Grades {
    /// Grades every atom and, on request, writes ∂γ_a/∂**z**_a, `[atoms × D]`.
    ///
    /// `elements` has the element index of each atom, `features` is `[atoms × D]`. The gradient S**δ**/(σθ)
    /// holds the nearest component and θ fixed (paper, Methods); γ jumps where the nearest component changes.
    /// The bits of an atom's result do not depend on the other atoms of the call.
    ///
    /// # Errors
    /// Wrong lengths, an unknown element, σ² negative or not finite. The contents are then unspecified.
    pub fn evaluate(
        &mut self,
        mixture: &Mixture,
        elements: &[usize],
        features: &[f64],
        mut gradient: Option<&mut [f64]>,
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
        self.assign(mixture, elements, features)?;
        self.measure(mixture, elements, features, gradient.as_deref_mut());
        self.scale(mixture, elements, gradient)
    }

    /// Finds the nearest component of each atom.
    fn assign(&mut self, mixture: &Mixture, elements: &[usize], features: &[f64]) -> Result<(), GradeError> {
        self.component.clear();
        let rows = features.chunks_exact(mixture.dimension());
        for (atom, (&element, z)) in elements.iter().zip(rows).enumerate() {
            let unknown = || GradeError::Element { atom, element, elements: mixture.element_count() };
            let components = mixture.components(element).ok_or_else(unknown)?;
            self.component.push(nearest(components.iter().map(|component| component.centroid()), z));
        }
        Ok(())
    }

    /// Writes **δ**ᵀS**δ** of each atom to `sigma` and S**δ** to the gradient.
    ///
    /// Processes several atoms of a component at a time, so that its matrix is read once for all of them.
    fn measure(
        &mut self,
        mixture: &Mixture,
        elements: &[usize],
        features: &[f64],
        mut gradient: Option<&mut [f64]>,
    ) {
        let dimension = mixture.dimension();
        let Self { sigma, component: slots, order, delta, product, .. } = self;
        let place = |atom: usize| (elements[atom], slots[atom]);
        sigma.clear();
        sigma.resize(elements.len(), 0.0);
        order.clear();
        order.extend(0..elements.len());
        order.sort_unstable_by_key(|&atom| (place(atom), atom));
        for atoms in
            order.chunk_by(|&a, &b| place(a) == place(b)).flat_map(|atoms| atoms.chunks(VECTORS_PER_PASS))
        {
            let component = component(mixture, place(atoms[0]));
            delta.clear();
            for atom in atoms {
                let z = &features[atom * dimension..][..dimension];
                delta.extend(z.iter().zip(component.centroid()).map(|(z, centre)| z - centre));
            }
            product.resize(delta.len(), 0.0);
            symmetric_products(component.inverse(), dimension, delta, product);
            let rows = delta.chunks_exact(dimension).zip(product.chunks_exact(dimension));
            for (&atom, (delta, product)) in atoms.iter().zip(rows) {
                sigma[atom] = dot(delta, product);
                if let Some(gradient) = gradient.as_deref_mut() {
                    gradient[atom * dimension..][..dimension].copy_from_slice(product);
                }
            }
        }
    }

    /// Converts **δ**ᵀS**δ** to σ and γ, and S**δ** to ∂γ/∂**z**.
    fn scale(
        &mut self,
        mixture: &Mixture,
        elements: &[usize],
        gradient: Option<&mut [f64]>,
    ) -> Result<(), GradeError> {
        self.gamma.clear();
        let mut rows = gradient.map(|gradient| gradient.chunks_exact_mut(mixture.dimension()));
        let places = elements.iter().zip(&self.component);
        for (atom, (sigma, (&element, &slot))) in self.sigma.iter_mut().zip(places).enumerate() {
            let squared = std::mem::replace(sigma, (*sigma + DISTANCE_FLOOR).sqrt());
            if !(sigma.is_finite() && *sigma > 0.0) {
                return Err(GradeError::Distance { atom, element, slot, found: squared });
            }
            let threshold = component(mixture, (element, slot)).threshold().max(THRESHOLD_FLOOR);
            self.gamma.push(*sigma / threshold);
            if let Some(row) = rows.as_mut().and_then(Iterator::next) {
                let scale = 1.0 / (*sigma * threshold);
                row.iter_mut().for_each(|value| *value *= scale);
            }
        }
        Ok(())
    }

    /// The largest γ; 0 without atoms.
    pub fn maximum(&self) -> f64 {
        maximum(&self.gamma)
    }
}

/// The largest of these grades; 0 without any.
pub fn maximum(gamma: &[f64]) -> f64 {
    gamma.iter().copied().fold(0.0, f64::max)
}

/// Index of the centroid nearest to **z** by Euclidean distance, the first if several are equally near (paper,
/// Methods).
///
/// The sentinel centroids of unused slots (all 10¹⁰) are never the nearest if there is a real one.
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

/// A component whose index is known to be valid.
fn component(mixture: &Mixture, (element, slot): (usize, usize)) -> &Component {
    mixture.component(element, slot).expect("the nearest component is one of the mixture")
}
