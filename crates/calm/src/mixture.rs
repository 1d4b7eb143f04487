//! The mixture: the components of every element, with a version number.

use std::sync::Arc;

use crate::bytes::ComponentBytesError;
use crate::component::Component;

/// The components of every element of a model. A clone copies one reference per element, not matrices.
#[derive(Debug, Clone, PartialEq)]
pub struct Mixture {
    version: u64,
    dimension: usize,
    /// Consecutive versions share the elements that did not change.
    elements: Vec<Arc<Vec<Arc<Component>>>>,
}

/// A new component and the index at which it replaces another.
#[derive(Debug, Clone, PartialEq)]
pub struct ChangedComponent {
    /// Element index.
    pub element: usize,
    /// Index among the components of the element.
    pub slot: usize,
    /// The component itself.
    pub component: Arc<Component>,
}

/// Components that are not a valid mixture.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MixtureError {
    /// There are no elements.
    #[error("a mixture needs at least one element")]
    NoElement,
    /// An element without components.
    #[error("element {element} has no component")]
    NoComponent {
        /// Element index.
        element: usize,
    },
    /// A component of another feature dimension.
    #[error(
        "component {slot} of element {element} has feature dimension {found}, the mixture has {expected}"
    )]
    Dimension {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
        /// Its dimension.
        found: usize,
        /// The dimension of the mixture.
        expected: usize,
    },
    /// Stored bytes that are not a component.
    #[error("component {slot} of element {element}: {source}")]
    Bytes {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
        /// What is wrong with the bytes.
        source: ComponentBytesError,
    },
    /// An index that the mixture does not have.
    #[error("the mixture has no component {slot} of element {element}")]
    NoPlace {
        /// Element index.
        element: usize,
        /// Component index.
        slot: usize,
    },
}

impl Mixture {
    /// Version `version` of a mixture, from the components of each element.
    ///
    /// # Errors
    /// No element, an element without components, unequal feature dimensions.
    pub fn new(version: u64, elements: Vec<Vec<Arc<Component>>>) -> Result<Self, MixtureError> {
        let mut dimension = None;
        for (element, components) in elements.iter().enumerate() {
            if components.is_empty() {
                return Err(MixtureError::NoComponent { element });
            }
            for (slot, component) in components.iter().enumerate() {
                let (found, expected) =
                    (component.dimension(), *dimension.get_or_insert(component.dimension()));
                if found != expected {
                    return Err(MixtureError::Dimension { element, slot, found, expected });
                }
            }
        }
        let dimension = dimension.ok_or(MixtureError::NoElement)?;
        let elements = elements.into_iter().map(Arc::new).collect();
        Ok(Self { version, dimension, elements })
    }

    /// The next version, with some components replaced. It shares all others with this one.
    ///
    /// # Errors
    /// An invalid index, or a component of another feature dimension.
    pub fn with_changes(&self, changed: &[ChangedComponent]) -> Result<Self, MixtureError> {
        let mut next = self.clone();
        next.version += 1;
        for &ChangedComponent { element, slot, ref component } in changed {
            let found = component.dimension();
            if found != self.dimension {
                return Err(MixtureError::Dimension { element, slot, found, expected: self.dimension });
            }
            let components = next.elements.get_mut(element).map(Arc::make_mut);
            let place = components.and_then(|components| components.get_mut(slot));
            *place.ok_or(MixtureError::NoPlace { element, slot })? = Arc::clone(component);
        }
        Ok(next)
    }

    /// The same components under another version number.
    pub fn at_version(&self, version: u64) -> Self {
        Self { version, ..self.clone() }
    }

    /// The mixture of a version: this one, the original, with the stored components (element index, component index,
    /// [`Component::to_bytes`]), which are all that ever changed.
    ///
    /// # Errors
    /// Bytes that are no component, and components that do not match the mixture.
    pub fn restored<'a>(
        &self,
        version: u64,
        stored: impl IntoIterator<Item = (usize, usize, &'a [u8])>,
    ) -> Result<Self, MixtureError> {
        let component = |(element, slot, bytes)| match Component::from_bytes(bytes) {
            Ok(component) => Ok(ChangedComponent { element, slot, component: Arc::new(component) }),
            Err(source) => Err(MixtureError::Bytes { element, slot, source }),
        };
        let changed = stored.into_iter().map(component).collect::<Result<Vec<_>, _>>()?;
        Ok(self.with_changes(&changed)?.at_version(version))
    }

    /// Version number; the artifact as loaded is version 0.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// Feature dimension D.
    pub fn dimension(&self) -> usize {
        self.dimension
    }

    /// Number of elements.
    pub fn element_count(&self) -> usize {
        self.elements.len()
    }

    /// The components of an element; `None` for an element the model does not have.
    pub fn components(&self, element: usize) -> Option<&[Arc<Component>]> {
        self.elements.get(element).map(|components| components.as_slice())
    }

    /// One component.
    pub fn component(&self, element: usize, slot: usize) -> Option<&Arc<Component>> {
        self.elements.get(element)?.get(slot)
    }

    /// Every component as (element, slot, component), in order.
    pub fn iter(&self) -> impl Iterator<Item = (usize, usize, &Arc<Component>)> {
        self.elements.iter().enumerate().flat_map(|(element, components)| {
            components.iter().enumerate().map(move |(slot, component)| (element, slot, component))
        })
    }

    /// Whether every component has the statistics that an update needs.
    pub fn can_be_updated(&self) -> bool {
        self.iter().all(|(_, _, component)| component.statistics().is_some())
    }
}
